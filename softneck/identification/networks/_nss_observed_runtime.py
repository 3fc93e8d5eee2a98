"""Neural state space whose state is corrected by what is measured: x(k) + gain (y - C x - c) goes into the map.

For robots whose past is not forgotten within the warm-up of a free run, so that their state must be found in it. There
is no echo: y(k+1) is that of the map, within `range`.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import stalling_drives
from softneck.identification.models._histories_runtime import narx_forward, narx_observe, narx_rest
from softneck.identification.networks._nss_map_runtime import nss_inputs
from softneck.identification.networks._nss_parts_runtime import NssArrays, NssState, nss_advance, nss_output
from softneck.runtime._layout import array


class ObservedNssArrays(NssArrays):
    """Behind those of kind `nss`."""

    gain = array("n, outputs", "of the errors of the outputs, for the state")


def observed_advance(p: ObservedNssArrays, x: np.ndarray, y: np.ndarray, v: np.ndarray) -> None:
    """Correct the state `x` of the map by the outputs `y`, NaN where not measured, and move it on."""
    errors = np.zeros(p.outputs)
    for axis in range(p.outputs):
        if np.isfinite(y[axis]):
            errors[axis] = y[axis] - p.c[axis]
            for i in range(p.n):
                errors[axis] -= p.C[axis, i] * x[i]
    for i in range(p.n):
        for axis in range(p.outputs):
            x[i] += p.gain[i, axis] * errors[axis]
    nss_advance(p, x, v)


def initialise(p: ObservedNssArrays, parameters: np.ndarray, x: NssState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the state that of outputs which have been at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
    v = np.zeros(p.B.shape[1])
    for _ in range(int(p.memory[0])):
        observed_advance(p, x.x, parameters[: p.outputs], v)


def step(p: ObservedNssArrays, parameters: np.ndarray, x: NssState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    load_advance(p.load, x.m[0], x.q)
    v = np.empty(p.B.shape[1])
    nss_inputs(p.redefinition, p.widths, x.m[int(p.delay[0])], x.plays, v)
    y = np.empty(p.outputs)
    measured = parameters[p.outputs] > 0.5  # a Boolean parameter as a number
    for axis in range(p.outputs):
        y[axis] = inputs[p.motors + axis] if measured else np.nan
    observed_advance(p, x.x, y, v)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = nss_output(p, x.x, axis)
    narx_forward(p, parameters, x, ahead, outputs)
    stalling_drives(p, p.load, x.q, x, outputs)
