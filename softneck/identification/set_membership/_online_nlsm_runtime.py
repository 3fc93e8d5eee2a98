"""Set membership that learns while it runs: the set of `_nlsm_runtime`, and points that the state holds.

A point is learnt where an output is measured and a whole history of it was before. Gamma stays: where a measurement
lies beyond the bounds of before, epsilon grows by what it is beyond, so that all points stay consistent (Eq. 15-17).
"""

import math

import numpy as np

from softneck.identification.models._histories_runtime import NarxState, narx_forward, narx_observe, narx_regressor
from softneck.identification.set_membership._nlsm_parts_runtime import (
    NlsmArrays,
    nlsm_query,
    nlsm_rest,
)
from softneck.identification.set_membership._nlsm_parts_runtime import nlsm_query_slopes as nlsm_query_slopes
from softneck.runtime._layout import array, cells, value


class OnlineNlsmArrays(NlsmArrays):
    """The set that it starts from, without base, and how many points may join it."""

    learning = array("1", "capacity: how many learnt points of each axis are kept, the oldest goes first")
    capacity = value("learning", 0)


class OnlineNlsmState(NarxState):
    """What was learnt; zeros are nothing."""

    seen = cells("outputs", "samples in a row in which the output was measured")
    learnt = cells("outputs", "points ever learnt")
    widened = cells("outputs", "what epsilon has grown by [rad]")
    awaited = cells("outputs, n", "scaled regressors of the outputs to come")
    expected = cells("outputs, 2", "least and largest output there, without epsilon [rad]")
    points = cells("outputs * capacity, n", "scaled regressors learnt; of each axis in a ring")
    values = cells("outputs, capacity", "outputs there [rad]")


def initialise(p: OnlineNlsmArrays, parameters: np.ndarray, x: OnlineNlsmState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever, nothing learnt."""
    nlsm_rest(p, parameters, x, outputs)


def online_learn(p: OnlineNlsmArrays, x: OnlineNlsmState, axis: int, y: float) -> None:
    """Learn that the output awaited is `y`."""
    low = float(x.expected[axis, 0])
    high = float(x.expected[axis, 1])
    epsilon = p.bounds[axis, 1] + x.widened[axis]
    # What the measurement is beyond the bounds; epsilon grows for all points, as it bounds the noise of all.
    x.widened[axis] += max(y - (high + epsilon), (low - epsilon) - y, 0.0)
    # No cone of this point would reach beyond those that are there: it says nothing.
    if low >= y >= high:
        return
    at = int(x.learnt[axis]) % p.capacity
    for i in range(p.n):
        x.points[axis * p.capacity + at, i] = x.awaited[axis, i]
    x.values[axis, at] = y
    x.learnt[axis] += 1.0


def online_query(p: OnlineNlsmArrays, x: OnlineNlsmState, axis: int, w: np.ndarray) -> None:
    """Expect the least and largest output at `w` (n,), scaled, over all points (Eq. 19-20 without epsilon)."""
    low, high = nlsm_query(p, axis, 0.0, w)
    count = min(int(x.learnt[axis]), p.capacity)
    for k in range(count):
        squared = 0.0
        for i in range(p.n):
            gap = x.points[axis * p.capacity + k, i] - w[i]
            squared += gap * gap
        cone = p.bounds[axis, 0] * math.sqrt(squared)
        low = max(low, x.values[axis, k] - cone)
        high = min(high, x.values[axis, k] + cone)
    x.expected[axis, 0] = low
    x.expected[axis, 1] = high


def step(
    p: OnlineNlsmArrays, parameters: np.ndarray, x: OnlineNlsmState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Learn what is measured, then advance by one sample as `nlsm` does over all points."""
    for axis in range(p.outputs):
        y = float(inputs[p.motors + axis])
        # Behind the starts of the outputs stands `use_measurement`; NaN is not measured.
        if parameters[p.outputs] > 0.5 and math.isfinite(y):
            # The regressor was of measured outputs and of real set-points throughout.
            if x.seen[axis] >= p.H:
                online_learn(p, x, axis, y)
            x.seen[axis] += 1.0
        else:
            x.seen[axis] = 0.0
    narx_observe(p, parameters, x, inputs)
    regressor = np.empty(p.n)
    ahead = np.empty(p.outputs)
    bounds = p.outputs + p.motors
    for axis in range(p.outputs):
        narx_regressor(p, p.table, x, axis, regressor)
        w = regressor * p.scale
        online_query(p, x, axis, w)
        for i in range(p.n):
            x.awaited[axis, i] = w[i]
        low = float(x.expected[axis, 0])
        high = float(x.expected[axis, 1])
        epsilon = p.bounds[axis, 1] + x.widened[axis]
        outputs[bounds + 2 * axis] = low - epsilon
        outputs[bounds + 2 * axis + 1] = high + epsilon
        ahead[axis] = 0.5 * ((low - epsilon) + (high + epsilon))  # Eq. 18
    narx_forward(p, parameters, x, ahead, outputs)
