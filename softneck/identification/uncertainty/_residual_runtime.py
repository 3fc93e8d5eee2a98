"""Set membership on what the free run of any plant leaves over (see `_residual`).

The base is the one member. What the set adds is never fed back, and what is measured moves the base alone, by what it
is above that: the free run is as stable as the base's, and the set adds at most its own range.
"""

import math

import numpy as np

from softneck.identification.models._histories_runtime import narx_push
from softneck.identification.set_membership._principal_tree_runtime import slant_bounds
from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._layout import Arrays, StateVector, array, cells, rest, value
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed


class ResidualArrays(Arrays):
    """The set; the arrays of the base follow."""

    history = array("1", "H: how many samples of each signal are kept")
    memory = array("1", "samples after which a held start has settled")
    table = array("n, 3", "regressors: source (2 motors, 3 the base's outputs), channel and lag of each")
    scale = array("n", "what each regressor is multiplied by")
    points = array("2, n, rows", "regressors of the record, for each axis")
    values = array("2, rows", "what the base left over there [rad]")
    bounds = array("2, 2", "gamma [rad] and epsilon [rad] of each axis (Eq. 15-17)")
    nodes = array("2, branches, columns", "tree over the points (see `_principal_tree_runtime`)")
    frame = array("2, directions, n", "directions of the tree")
    H = value("history", 0)


class ResidualState(StateVector):
    """Histories, newest first, and what holds now; the base's state follows."""

    m = cells("H, 3", "motor positions [rad]")
    y = cells("H, 2", "outputs of the base [rad]")
    motors = cells("3", "motor positions of now [rad]")
    angles = cells("2", "outputs of the base of now [rad]")
    added = cells("2", "what the set adds now [rad]")
    random = cells("6", "generator of the output noise")
    base = rest("state of the base")


def state_size(p: ResidualArrays) -> int:
    """Return the length of the state vector."""
    return ResidualState.size(p) + member_size(p, 0)


def initialise(p: ResidualArrays, parameters: np.ndarray, x: ResidualState, outputs: np.ndarray) -> None:
    """Rest: as the base rests, its outputs at their start values for ever."""
    base = np.zeros(9)
    x[:] = 0.0
    member_initialise(p, 0, parameters, x.base, base)
    # The histories hold the base's outputs, not what the set adds.
    for j in range(p.H):
        for axis in range(2):
            x.y[j, axis] = base[axis]
    for axis in range(2):
        x.angles[axis] = base[axis]
    random_seed(x.random, parameters[4])
    outputs[:5] = base[:5]
    outputs[5:7] = base[0]
    outputs[7:9] = base[1]


def residual_query(p: ResidualArrays, axis: int, regressor: np.ndarray) -> tuple[float, float]:
    """Return the bounds of one axis (Eq. 19-20): by the tree where loops are fast, else over all points by numpy."""
    gamma = p.bounds[axis, 0]
    epsilon = p.bounds[axis, 1]
    if COMPILED:
        low, high = slant_bounds(p.points[axis], p.values[axis], p.nodes[axis], p.frame[axis], gamma, regressor)
        return low - epsilon, high + epsilon  # epsilon moves all cones alike: the tree does without
    squared = np.zeros(p.rows)
    for i in range(p.points.shape[1]):
        gap = p.points[axis, i] - regressor[i]
        squared += gap * gap
    cone = gamma * np.sqrt(squared)  # gamma |x - w(k)| of Eq. 19 and 20
    return np.max(p.values[axis] - cone) - epsilon, np.min(p.values[axis] + cone) + epsilon  # Eq. 20, Eq. 19


def residual_observe(p: ResidualArrays, x: ResidualState, given: np.ndarray, measured: bool) -> None:
    """Push motors and base outputs of now into the histories: measured where they are."""
    if measured:
        for axis in range(2):
            if math.isfinite(given[3 + axis]):
                x.angles[axis] = given[3 + axis]
        for j in range(3):
            if math.isfinite(given[5 + j]):
                x.motors[j] = given[5 + j]
    narx_push(x.m, x.motors)
    narx_push(x.y, x.angles)


def residual_regressor(p: ResidualArrays, x: ResidualState, regressor: np.ndarray) -> None:
    """Fill the regressor that both axes share."""
    for i in range(p.n):
        back = int(p.table[i, 2]) - 1
        channel = int(p.table[i, 1])
        value = x.m[back, channel] if p.table[i, 0] == 2 else x.y[back, channel]
        regressor[i] = value * p.scale[i]


def step(p: ResidualArrays, parameters: np.ndarray, x: ResidualState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of pitch and roll follow the motor positions in `outputs`."""
    # The noise is added once, at the end, by this kind's own generator.
    quiet = parameters.copy()
    quiet[3] = 0.0
    # Base and set together are to meet the measurement: the base is told the rest of it. NaN stays NaN.
    given = inputs.copy()
    for axis in range(2):
        given[3 + axis] -= x.added[axis]
    residual_observe(p, x, given, parameters[2] > 0.5)  # parameter 2 is `use_measurement`
    base = np.zeros(9)
    member_step(p, 0, quiet, x.base, given, base)
    for axis in range(2):
        x.angles[axis] = base[axis]
    for j in range(3):
        x.motors[j] = base[2 + j]
        outputs[2 + j] = base[2 + j]
    # From histories that end at t_k: y(k+1) of the base, which is known by now, is not among them.
    regressor = np.empty(p.n)
    residual_regressor(p, x, regressor)
    for axis in range(2):
        low, high = residual_query(p, axis, regressor)
        x.added[axis] = 0.5 * (low + high)  # Eq. 18
        outputs[axis] = base[axis] + 0.5 * (low + high)
        outputs[5 + 2 * axis] = base[axis] + low
        outputs[6 + 2 * axis] = base[axis] + high
    if parameters[3] > 0.0:
        outputs[0] += parameters[3] * random_normal(x.random)
        outputs[1] += parameters[3] * random_normal(x.random)
