"""A linear state space with an observer gain.

    x(k+1) = A x(k) + B u(k - delay) + K (y(k) - C x(k)),    C x = the first states

The first states are the outputs, a neck's pitch and roll.
"""

import numpy as np

from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays, lss_observe
from softneck.identification.models._histories_runtime import NarxState, narx_forward
from softneck.identification.models._narx_runtime import initialise as initialise
from softneck.runtime._rest_runtime import REST


def step(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    # Not `narx_observe`: `x.y` holds the states here, and no output is pushed into it.
    lss_observe(p, parameters, x, inputs)
    states = x.y
    # Zero in free run: then the angles of now are the first states.
    e = np.empty(p.outputs)
    for axis in range(p.outputs):
        e[axis] = x.angles[axis] - states[axis]
    # Beside the states, as every row needs all the old ones.
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
    narx_forward(p, parameters, x, ahead, outputs)
