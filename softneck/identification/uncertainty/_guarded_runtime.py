"""Several models of one kind, and a base that takes over where they disagree or the motors leave the training range.

    y = (1 - w) base + w median(members)
    w -> sigma^2 / (sigma^2 + agreement s^2 + (slope d)^2)

Weights by inverse variance: sigma is the base's error on rows that it was not trained on, s the members' mean distance
from their median, d how far the base's motors are from where any were in training. w moves at a limited rate, and every
model runs free on its own outputs: only outputs are blended, nothing feeds back (Murray-Smith and Johansen 1997).
"""

import math

import numpy as np

from softneck.identification.models._histories_runtime import narx_outputs
from softneck.identification.models._validity_runtime import GroundArrays, ground_outside
from softneck.runtime._layout import StateVector, array, cells, rest, value
from softneck.runtime._members_runtime import member_count, member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed


def guarded_motors(history: np.ndarray) -> int:
    """Return the number of motors: the neck's three where none is said."""
    return int(history[2]) if history.shape[0] > 2 else 3


class GuardedArrays(GroundArrays):
    """Those of the base follow, then those of the members."""

    history = array("sizes = 1 | 3", "H, samples of each signal that are kept; and outputs and motors, if not 2 and 3")
    memory = array("1", "samples after which a held start has settled")
    sigma = array("outputs", "the base's error on rows that it was not trained on [rad]")
    slope = array("outputs", "how the members' error grows with the distance from what was seen [rad/rad]")
    fading = array("2", "agreement: weight of the members' spread; most that w moves in a sample")
    seen = array("points, motors", "motor positions of the training: each was within `reach` of one of them [rad]")
    reach = array("1", "[rad]")
    outputs = value("history", function=narx_outputs, written=True)
    motors = value("history", function=guarded_motors, written=True)


def guarded_median(inorder: np.ndarray) -> float:
    """Return the median of numbers in order; of an even number of them the mean of the middle two."""
    count = inorder.shape[0]
    return float(0.5 * (inorder[(count - 1) // 2] + inorder[count // 2]))


def guarded_validity(p: GroundArrays, motors: np.ndarray, slow: np.ndarray, spread: np.ndarray) -> float:
    """Return the validity of outputs whose members are apart by `spread` (outputs,); 0 where it is not known."""
    if p.ground.shape[0] == 0:
        return 0.0
    outside = ground_outside(p, motors, slow)
    worst = 0.0
    for axis in range(spread.shape[0]):
        apart = spread[axis]
        worst = max(worst, p.doubt[axis, 0] + p.doubt[axis, 1] * outside + p.doubt[axis, 2] * apart * apart)
    return 1.0 / (1.0 + worst)


class GuardedState(StateVector):
    """The state of the blend; the base's and the members' states follow, in their order."""

    random = cells("6", "generator of the output noise")
    weight = cells("", "w of the members now")
    spread = cells("outputs", "s: mean distance of the members from their median [rad]")
    distance = cells("", "d: how far the base's motors are from what was seen [rad]")
    slow = cells("motors", "where the motors have been held [rad]")
    members = rest("states of the base and the members")


def state_size(p: GuardedArrays) -> int:
    """Return the length of the state vector."""
    size = GuardedState.size(p)
    for i in range(member_count()):
        size += member_size(p, i)
    return size


def initialise(p: GuardedArrays, parameters: np.ndarray, x: GuardedState, outputs: np.ndarray) -> None:
    """Rest: as base and members rest, where they agree."""
    bounds = p.outputs + p.motors
    own = np.zeros(bounds + 2 * p.outputs + 1)
    at = 0
    members = x.members
    x.weight = 1.0
    x.distance = 0.0
    for axis in range(p.outputs):
        x.spread[axis] = 0.0
    random_seed(x.random, float(parameters[p.outputs + 2]))
    for i in range(member_count()):
        size = member_size(p, i)
        member_initialise(p, i, parameters, members[at : at + size], own)
        at += size
    for i in range(bounds):
        outputs[i] = own[i]
    outputs[bounds] = guarded_validity(p, own[p.outputs : bounds], x.slow, x.spread)


def guarded_distance(seen: np.ndarray, reach: float, motors: np.ndarray) -> float:
    """Return the distance of motors (motors,) from the training range [rad]."""
    least = math.inf
    for i in range(seen.shape[0]):
        total = 0.0
        for j in range(seen.shape[1]):
            gap = seen[i, j] - motors[j]
            total += gap * gap
        least = min(least, total)
    return max(math.sqrt(least) - reach, 0.0)


def guarded_weight(
    sigma: np.ndarray, slope: np.ndarray, agreement: float, spread: np.ndarray, distance: float
) -> float:
    """Return the weight that the members deserve now, on the output of the most doubt."""
    doubt = 0.0
    for axis in range(sigma.shape[0]):
        apart = spread[axis]
        unseen = slope[axis] * distance
        # Over the base's variance: w = 1 / (1 + doubt).
        doubt = max(doubt, (agreement * apart * apart + unseen * unseen) / (sigma[axis] * sigma[axis]))
    return 1.0 / (1.0 + doubt)


def step(p: GuardedArrays, parameters: np.ndarray, x: GuardedState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the base, member 0, gives the motor positions."""
    # Behind `use_measurement` stands `noise_std`: noise comes once, on the blend, from this kind's generator.
    quiet = parameters.copy()
    quiet[p.outputs + 1] = 0.0
    count = member_count() - 1
    bounds = p.outputs + p.motors
    angles = np.empty((p.outputs, count))
    own = np.zeros(bounds + 2 * p.outputs + 1)
    at = 0
    members = x.members
    for i in range(count + 1):
        size = member_size(p, i)
        member_step(p, i, quiet, members[at : at + size], inputs, own)
        if i == 0:
            for j in range(bounds):
                outputs[j] = own[j]
        else:
            for axis in range(p.outputs):
                angles[axis, i - 1] = own[axis]
        at += size
    x.distance = guarded_distance(p.seen, p.reach[0], outputs[p.outputs : bounds])
    agreed = np.empty(p.outputs)
    for axis in range(p.outputs):
        inorder = np.sort(angles[axis])
        agreed[axis] = guarded_median(inorder)
        total = 0.0
        for i in range(count):
            total += abs(inorder[i] - agreed[axis])
        x.spread[axis] = total / count
    move = guarded_weight(p.sigma, p.slope, p.fading[0], x.spread, x.distance) - x.weight
    x.weight += min(max(move, -p.fading[1]), p.fading[1])
    for axis in range(p.outputs):
        # In this form a weight of 1 or 0 gives one side to the bit.
        outputs[axis] = (1.0 - x.weight) * outputs[axis] + x.weight * agreed[axis]
        if parameters[p.outputs + 1] > 0.0:
            outputs[axis] += parameters[p.outputs + 1] * random_normal(x.random)
    outputs[bounds] = guarded_validity(p, outputs[p.outputs : bounds], x.slow, x.spread)
