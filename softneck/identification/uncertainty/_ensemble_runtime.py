"""The median of several plants, with the least and the largest of them as bounds.

Arrays: H (1), memory (1); then those of the members. State: random generator (6); then the members' states.
Each member runs free on its own outputs; a median of bounded numbers is bounded.
"""

import numpy as np

from softneck.runtime._members_runtime import member_count, member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed

OWN_ARRAYS = 2
OWN_STATES = 6


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    size = OWN_STATES
    for i in range(member_count()):
        size += member_size(arrays, i)
    return size


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: as the members rest."""
    own = np.zeros(9)
    at = OWN_STATES
    random_seed(state[:OWN_STATES], parameters[4])
    for i in range(member_count()):
        size = member_size(arrays, i)
        member_initialise(arrays, i, parameters, state[at : at + size], own)
        at += size
    outputs[:5] = own[:5]
    outputs[5:7] = own[0]
    outputs[7:9] = own[1]


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample; the bounds of pitch and roll follow the motor positions in `outputs`."""
    quiet = parameters.copy()
    quiet[3] = 0.0
    count = member_count()
    angles = np.empty((2, count))
    own = np.zeros(9)
    at = OWN_STATES
    for i in range(count):
        size = member_size(arrays, i)
        member_step(arrays, i, quiet, state[at : at + size], inputs, own)
        angles[0, i] = own[0]
        angles[1, i] = own[1]
        if i == 0:
            outputs[2:5] = own[2:5]
        at += size
    for axis in range(2):
        inorder = np.sort(angles[axis])
        outputs[axis] = 0.5 * (inorder[(count - 1) // 2] + inorder[count // 2])
        outputs[5 + 2 * axis] = inorder[0]
        outputs[6 + 2 * axis] = inorder[count - 1]
    if parameters[3] > 0.0:
        outputs[0] += parameters[3] * random_normal(state[:OWN_STATES])
        outputs[1] += parameters[3] * random_normal(state[:OWN_STATES])
