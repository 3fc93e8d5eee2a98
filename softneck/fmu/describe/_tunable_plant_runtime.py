"""First-order transfer functions of all axes whose gain, time constant and dead time may change during a run.

    y(k+1) = p y(k) + (G/G_0) (1 - p)/(1 - p_0) (b_0 u(k-d) + b_1 u(k-d-1) + ...),    p = exp(-Ts/T)

G_0, p_0 and b are as identified; with their values the coefficients of the model are used, to the bit. The state is y
and past inputs, so that no change makes y jump.
"""

import math

import numpy as np

from softneck.identification.linear._arx_runtime import ArxArrays, arx_output
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_observe
from softneck.identification.models._narx_runtime import initialise as initialise
from softneck.runtime._layout import array


class TunablePlantArrays(ArxArrays):
    """Arrays of the transfer functions, and their parameters as identified."""

    source = array("1", "1 takes motor positions for u, 0 set-points")
    identified = array("outputs, 2", "G_0 and T_0 [s] of each output")
    period = array("1", "sample time [s]")


def step(p: TunablePlantArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample.

    parameters: those of every plant, then G, T [s] and d [samples] of each output.
    """
    narx_observe(p, parameters, x, inputs)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        first = parameters.shape[0] - 3 * p.outputs + 3 * axis
        gain, lag = parameters[first], parameters[first + 1]
        a, b = p.a[axis].copy(), p.b[axis].copy()
        scale = 1.0
        if lag != p.identified[axis, 1]:
            a[0] = -math.exp(-p.period[0] / lag)
            scale = (1.0 + a[0]) / (1.0 + p.a[axis, 0])
        if gain != p.identified[axis, 0]:
            scale = scale * gain / p.identified[axis, 0]
        for j in range(b.shape[0]):
            b[j] = scale * b[j]
        # As for `oe`: positions of motors stand H samples behind their set-points.
        delay = int(parameters[first + 2] + 0.5) + p.H * int(p.source[0])
        ahead[axis] = arx_output(p, p.redefinition, a, b, delay, x, axis)
    narx_forward(p, parameters, x, ahead, outputs)
