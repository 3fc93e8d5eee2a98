"""A linear state space with an observer gain.

    x(k+1) = A x(k) + B u(k - delay) + K (y(k) - C x(k)),    C x = the first states

The first states are the outputs, a neck's pitch and roll.
"""

import numpy as np

from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays, lss_next, lss_observe
from softneck.identification.models._histories_runtime import NarxState, narx_forward
from softneck.identification.models._narx_runtime import initialise as initialise


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
    lss_next(p, x, e, ahead)
    states[: p.n] = ahead
    narx_forward(p, parameters, x, ahead, outputs)
