"""A linear state space whose gains and dead time may change during a run.

The gain of output i scales its row of the transfer matrix by s_i = G_i/G_i0. States stand in turns for the outputs, as
identification makes them, and state j is stepped as s_i z_j with i = j mod outputs. What is kept are the scaled states,
so that no change makes y jump. With gains and dead time as identified the state space is stepped as it is, to the bit.
"""

import numpy as np

from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays, state_space_ahead
from softneck.identification.linear._state_space_parts_runtime import initialise as initialise
from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_known, narx_push
from softneck.runtime._layout import array


class TunableStateSpaceArrays(StateSpaceArrays):
    """A linear state space, and its gains as identified."""

    identified = array("outputs", "G_0 of each output")


def step(
    p: TunableStateSpaceArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance by one sample.

    parameters: those of every plant, then G of each output, and the dead time [samples].
    """
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[: p.motors])
    narx_push(x.m, x.motors)
    first = parameters.shape[0] - 1 - p.outputs
    states = x.y  # as of the state space: no outputs are pushed into it
    z, e = states.copy(), np.empty(p.outputs)
    for j in range(p.n):
        axis = j % p.outputs
        z[j] = states[j] / (parameters[first + axis] / p.identified[axis])
    for axis in range(p.outputs):
        above = x.angles[axis] - p.offset[axis] - states[axis]
        e[axis] = above / (parameters[first + axis] / p.identified[axis])
    ahead = state_space_ahead(p, x, z, e, int(parameters[first + p.outputs] + 0.5))
    for j in range(p.n):
        axis = j % p.outputs
        ahead[j] = parameters[first + axis] / p.identified[axis] * ahead[j]
    states[: p.n] = ahead
    for axis in range(p.outputs):
        ahead[axis] += p.offset[axis]
    narx_forward(p, parameters, x, ahead, outputs)
