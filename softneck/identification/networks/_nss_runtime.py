"""Neural state space behind drives that stall under load, and a linear echo of what was measured.

The map is that of `_nss_map_runtime`. As in kind `play` the histories hold what is above y of the map, which is kept
within `range` and never fed back; the echo dies out where nothing is measured.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import narx_forward, narx_observe, narx_rest
from softneck.identification.networks._nss_map_runtime import nss_inputs
from softneck.identification.networks._nss_parts_runtime import NssArrays, NssState, nss_advance, nss_output


def initialise(p: NssArrays, parameters: np.ndarray, x: NssState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the neck settled; what the start is above that is remembered as measured."""
    narx_rest(p, parameters, x, outputs)
    v = np.zeros(p.B.shape[1])
    # Long enough: the map contracts, so that what it began with is forgotten.
    for _ in range(int(p.memory[0])):
        nss_advance(p, x.x, v)
    for axis in range(p.outputs):
        echo_rest(p, x, axis, nss_output(p, x.x, axis))


def step(p: NssArrays, parameters: np.ndarray, x: NssState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    load_advance(p.load, x.m[0], x.q)
    v = np.empty(p.B.shape[1])
    # v comes from simulated or measured motors, not set-points: the drives are outside of the map.
    nss_inputs(p.redefinition, p.widths, x.m[int(p.delay[0])], x.plays, v)
    nss_advance(p, x.x, v)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = echo_added(p, p.echo, x, axis, nss_output(p, x.x, axis))
    narx_forward(p, parameters, x, ahead, outputs)
    stalling_drives(p, p.load, x.q, x, outputs)
