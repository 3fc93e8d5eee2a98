"""A linear state space around an operating point, of robots whose outputs are not zero at rest.

x(k+1) = A x(k) + B u(k - delay) + K (y(k) - offset - C x(k)),    y = C x + offset
"""

import numpy as np

from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays, lss_observe
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_rest
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class AffineArrays(StateSpaceArrays):
    """Those of the state space, and where it stands without inputs."""

    offset = array("outputs", "outputs where states and inputs are zero")


def initialise(p: AffineArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
    for j in range(p.H):
        for axis in range(p.outputs):
            x.y[j, axis] -= p.offset[axis]


def step(p: AffineArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    lss_observe(p, parameters, x, inputs)
    states = x.y
    e = np.empty(p.outputs)
    for axis in range(p.outputs):
        e[axis] = x.angles[axis] - p.offset[axis] - states[axis]
    ahead = np.zeros(p.n)
    # Motor positions stand H samples of all motors behind set-points.
    back = int(p.delay[0]) + p.H * int(p.delay[1])
    for i in range(p.n):
        value = 0.0
        for axis in range(p.outputs):
            value += p.K[i, axis] * e[axis]
        for j in range(p.n):
            value += p.A[i, j] * states[j]
        for j in range(p.motors):
            value += p.B[i, j] * x.u[back, j]
        ahead[i] = (value + REST) - REST
    states[: p.n] = ahead
    for axis in range(p.outputs):
        ahead[axis] += p.offset[axis]
    narx_forward(p, parameters, x, ahead, outputs)
