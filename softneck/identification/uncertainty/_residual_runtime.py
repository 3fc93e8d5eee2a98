"""Set membership on what the free run of any plant leaves over (see `_residual`).

The base is the one member. What the set adds is never fed back, and what is measured moves the base alone, by what it
is above that: the free run is as stable as the base's, and the set adds at most its own range.
"""

import math

import numpy as np

from softneck.identification.models._histories_runtime import narx_push
from softneck.identification.models._validity_runtime import GroundArrays
from softneck.identification.set_membership._nlsm_parts_runtime import nlsm_near
from softneck.identification.set_membership._principal_tree_runtime import slant_bounds, slant_slopes
from softneck.identification.uncertainty._composed_runtime import composed_motors, composed_outputs, composed_validity
from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._layout import StateVector, array, cells, rest, value
from softneck.runtime._members_runtime import member_initialise, member_size, member_step
from softneck.runtime._random_runtime import random_normal, random_seed


class ResidualArrays(GroundArrays):
    """The set; the arrays of the base follow."""

    history = array("sizes", "H: how many samples of each signal are kept; and outputs and motors, if not a neck's")
    memory = array("1", "samples after which a held start has settled")
    table = array("n, 3", "regressors: source (2 motors, 3 the base's outputs), channel and lag of each")
    scale = array("n", "what each regressor is multiplied by")
    points = array("outputs, n, rows", "regressors of the record, for each axis")
    values = array("outputs, rows", "what the base left over there [rad]")
    bounds = array("outputs, 2", "gamma [rad] and epsilon [rad] of each axis (Eq. 15-17)")
    nodes = array("outputs, branches, columns", "tree over the points (see `_principal_tree_runtime`)")
    frame = array("outputs, directions, n", "directions of the tree")
    H = value("history", 0)
    outputs = value("history", function=composed_outputs, written=True)
    motors = value("history", function=composed_motors, written=True)


class ResidualState(StateVector):
    """Histories, newest first, and what holds now; the base's state follows."""

    m = cells("H, motors", "motor positions [rad]")
    y = cells("H, outputs", "outputs of the base [rad]")
    motors = cells("motors", "motor positions of now [rad]")
    angles = cells("outputs", "outputs of the base of now [rad]")
    added = cells("outputs", "what the set adds now [rad]")
    random = cells("6", "generator of the output noise")
    slow = cells("motors", "where the motors have been held [rad]")
    base = rest("state of the base")


def state_size(p: ResidualArrays) -> int:
    """Return the length of the state vector."""
    return ResidualState.size(p) + member_size(p, 0)


def initialise(p: ResidualArrays, parameters: np.ndarray, x: ResidualState, outputs: np.ndarray) -> None:
    """Rest: as the base rests, its outputs at their start values for ever."""
    bounds = p.outputs + p.motors
    base = np.zeros(bounds + 2 * p.outputs + 1)
    x[:] = 0.0
    member_initialise(p, 0, parameters, x.base, base)
    # The histories hold the base's outputs, not what the set adds.
    for j in range(p.H):
        for axis in range(p.outputs):
            x.y[j, axis] = base[axis]
    random_seed(x.random, float(parameters[p.outputs + 2]))
    outputs[:bounds] = base[:bounds]
    for axis in range(p.outputs):
        x.angles[axis] = base[axis]
        outputs[bounds + 2 * axis] = base[axis]
        outputs[bounds + 2 * axis + 1] = base[axis]
    outputs[bounds + 2 * p.outputs] = composed_validity(p, base[p.outputs : bounds], x.slow, np.zeros(p.outputs))


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


def residual_query_slopes(
    p: ResidualArrays, axis: int, regressor: np.ndarray, low: float, high: float, slopes: np.ndarray
) -> None:
    """Fill `slopes` (2, n) with what the regressor moves the bounds of `residual_query` by."""
    near = np.empty(2)
    nlsm_near(low, high, p.bounds[axis, 1], near)
    gamma = p.bounds[axis, 0]
    slant_slopes(p.points[axis], p.values[axis], p.nodes[axis], p.frame[axis], gamma, regressor, near, slopes)


def residual_observe(p: ResidualArrays, x: ResidualState, given: np.ndarray, measured: bool) -> None:
    """Push motors and base outputs of now into the histories: measured where they are."""
    if measured:
        for axis in range(p.outputs):
            if math.isfinite(given[p.motors + axis]):
                x.angles[axis] = given[p.motors + axis]
        for j in range(p.motors):
            if math.isfinite(given[p.motors + p.outputs + j]):
                x.motors[j] = given[p.motors + p.outputs + j]
    narx_push(x.m, x.motors)
    narx_push(x.y, x.angles)


def residual_regressor(p: ResidualArrays, x: ResidualState, regressor: np.ndarray) -> None:
    """Fill the regressor that all axes share."""
    for i in range(p.n):
        back = int(p.table[i, 2]) - 1
        channel = int(p.table[i, 1])
        value = x.m[back, channel] if p.table[i, 0] == 2 else x.y[back, channel]
        regressor[i] = value * p.scale[i]


def step(p: ResidualArrays, parameters: np.ndarray, x: ResidualState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of the outputs follow the motor positions in `outputs`."""
    # The noise is added once, at the end, by this kind's own generator.
    quiet = parameters.copy()
    quiet[p.outputs + 1] = 0.0
    # Base and set together are to meet the measurement: the base is told the rest of it. NaN stays NaN.
    given = inputs.copy()
    for axis in range(p.outputs):
        given[p.motors + axis] -= x.added[axis]
    # Behind the starts of the outputs stands `use_measurement`.
    residual_observe(p, x, given, float(parameters[p.outputs]) > 0.5)
    bounds = p.outputs + p.motors
    base = np.zeros(bounds + 2 * p.outputs + 1)
    member_step(p, 0, quiet, x.base, given, base)
    for axis in range(p.outputs):
        x.angles[axis] = base[axis]
    for j in range(p.motors):
        x.motors[j] = base[p.outputs + j]
        outputs[p.outputs + j] = base[p.outputs + j]
    # From histories that end at t_k: y(k+1) of the base, which is known by now, is not among them.
    regressor = np.empty(p.n)
    half = np.empty(p.outputs)
    residual_regressor(p, x, regressor)
    for axis in range(p.outputs):
        low, high = residual_query(p, axis, regressor)
        x.added[axis] = 0.5 * (low + high)  # Eq. 18
        outputs[axis] = base[axis] + 0.5 * (low + high)
        outputs[bounds + 2 * axis] = base[axis] + low
        outputs[bounds + 2 * axis + 1] = base[axis] + high
        half[axis] = 0.5 * (high - low)
    outputs[bounds + 2 * p.outputs] = composed_validity(p, base[p.outputs : bounds], x.slow, half)
    if parameters[p.outputs + 1] > 0.0:
        for axis in range(p.outputs):
            outputs[axis] += parameters[p.outputs + 1] * random_normal(x.random)
