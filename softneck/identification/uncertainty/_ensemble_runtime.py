"""The median of several plants, with the least and the largest of them as bounds.

Each member runs free on its own outputs; a median of bounded numbers is bounded.
"""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, rest
from softneck.runtime._members_runtime import member_count, member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed


class EnsembleArrays(Arrays):
    """Those of the members follow."""

    history = array("1", "H: how many samples of each signal are kept")
    memory = array("1", "samples after which a held start has settled")


class EnsembleState(StateVector):
    """The members' states follow, in their order."""

    random = cells("6", "generator of the output noise")
    members = rest("states of the members")


def state_size(p: EnsembleArrays) -> int:
    """Return the length of the state vector."""
    size = EnsembleState.size(p)
    for i in range(member_count()):
        size += member_size(p, i)
    return size


def initialise(p: EnsembleArrays, parameters: np.ndarray, x: EnsembleState, outputs: np.ndarray) -> None:
    """Rest: as the members rest."""
    own = np.zeros(9)
    at = 0
    members = x.members
    random_seed(x.random, parameters[4])
    for i in range(member_count()):
        size = member_size(p, i)
        member_initialise(p, i, parameters, members[at : at + size], own)
        at += size
    # Members start alike: what the last one says holds for all.
    outputs[:5] = own[:5]
    outputs[5:7] = own[0]
    outputs[7:9] = own[1]


def step(p: EnsembleArrays, parameters: np.ndarray, x: EnsembleState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of pitch and roll follow the motor positions in `outputs`."""
    # Parameter 3 is `noise_std`: noise comes once, on the median, and from this kind's generator.
    quiet = parameters.copy()
    quiet[3] = 0.0
    count = member_count()
    angles = np.empty((2, count))
    own = np.zeros(9)
    at = 0
    members = x.members
    for i in range(count):
        size = member_size(p, i)
        member_step(p, i, quiet, members[at : at + size], inputs, own)
        angles[0, i] = own[0]
        angles[1, i] = own[1]
        # Motors are not averaged: the first member's drives stand for all.
        if i == 0:
            outputs[2:5] = own[2:5]
        at += size
    for axis in range(2):
        inorder = np.sort(angles[axis])
        # Of an even number the mean of the middle two.
        outputs[axis] = 0.5 * (inorder[(count - 1) // 2] + inorder[count // 2])
        outputs[5 + 2 * axis] = inorder[0]
        outputs[6 + 2 * axis] = inorder[count - 1]
    if parameters[3] > 0.0:
        outputs[0] += parameters[3] * random_normal(x.random)
        outputs[1] += parameters[3] * random_normal(x.random)
