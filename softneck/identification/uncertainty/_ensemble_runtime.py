"""The median of several plants, with the least and the largest of them as bounds.

Each member runs free on its own outputs; a median of bounded numbers is bounded.
"""

import numpy as np

from softneck.identification.uncertainty._composed_runtime import ComposedArrays, composed_median, composed_validity
from softneck.runtime._layout import StateVector, cells, rest
from softneck.runtime._members_runtime import member_count, member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed


class EnsembleState(StateVector):
    """The members' states follow, in their order."""

    random = cells("6", "generator of the output noise")
    slow = cells("motors", "where the motors have been held [rad]")
    members = rest("states of the members")


def state_size(p: ComposedArrays) -> int:
    """Return the length of the state vector."""
    size = EnsembleState.size(p)
    for i in range(member_count()):
        size += member_size(p, i)
    return size


def initialise(p: ComposedArrays, parameters: np.ndarray, x: EnsembleState, outputs: np.ndarray) -> None:
    """Rest: as the members rest."""
    bounds = p.outputs + p.motors
    own = np.zeros(bounds + 2 * p.outputs + 1)
    at = 0
    members = x.members
    random_seed(x.random, float(parameters[p.outputs + 2]))
    for i in range(member_count()):
        size = member_size(p, i)
        member_initialise(p, i, parameters, members[at : at + size], own)
        at += size
    # Members start alike: what the last one says holds for all.
    outputs[:bounds] = own[:bounds]
    for axis in range(p.outputs):
        outputs[bounds + 2 * axis] = own[axis]
        outputs[bounds + 2 * axis + 1] = own[axis]
    outputs[bounds + 2 * p.outputs] = composed_validity(p, own[p.outputs : bounds], x.slow, np.zeros(p.outputs))


def step(p: ComposedArrays, parameters: np.ndarray, x: EnsembleState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of the outputs follow the motor positions in `outputs`."""
    # Behind `use_measurement` stands `noise_std`: noise comes once, on the median, from this kind's generator.
    quiet = parameters.copy()
    quiet[p.outputs + 1] = 0.0
    count = member_count()
    bounds = p.outputs + p.motors
    angles = np.empty((p.outputs, count))
    spread = np.empty(p.outputs)
    own = np.zeros(bounds + 2 * p.outputs + 1)
    at = 0
    members = x.members
    for i in range(count):
        size = member_size(p, i)
        member_step(p, i, quiet, members[at : at + size], inputs, own)
        for axis in range(p.outputs):
            angles[axis, i] = own[axis]
        # Motors are not averaged: the first member's drives stand for all.
        if i == 0:
            outputs[p.outputs : bounds] = own[p.outputs : bounds]
        at += size
    for axis in range(p.outputs):
        inorder = np.sort(angles[axis])
        outputs[axis] = composed_median(inorder)
        outputs[bounds + 2 * axis] = inorder[0]
        outputs[bounds + 2 * axis + 1] = inorder[count - 1]
        spread[axis] = 0.5 * (inorder[count - 1] - inorder[0])
    outputs[bounds + 2 * p.outputs] = composed_validity(p, outputs[p.outputs : bounds], x.slow, spread)
    if parameters[p.outputs + 1] > 0.0:
        for axis in range(p.outputs):
            outputs[axis] += parameters[p.outputs + 1] * random_normal(x.random)
