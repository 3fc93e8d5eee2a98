"""A linear state space with an observer gain, around where its robot rests; see `_state_space_parts_runtime`."""

import numpy as np

from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays, state_space_ahead
from softneck.identification.linear._state_space_parts_runtime import initialise as initialise
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_known, narx_push


def step(p: StateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    # Not `narx_observe`: `x.y` holds the states here, and no output is pushed into it.
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[: p.motors])
    narx_push(x.m, x.motors)
    states = x.y
    # Zero in a simulation, where the present outputs are the first states.
    e = np.empty(p.outputs)
    for axis in range(p.outputs):
        e[axis] = x.angles[axis] - p.offset[axis] - states[axis]
    ahead = state_space_ahead(p, x, states, e, int(p.delay[0]))
    states[: p.n] = ahead
    for axis in range(p.outputs):
        ahead[axis] += p.offset[axis]
    narx_forward(p, parameters, x, ahead, outputs)
