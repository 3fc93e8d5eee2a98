"""Set membership (Eq. 18-20, Algorithm 1), alone or on a linear base.

An empty base is the paper's Eq. 21, fed back what it puts out. With one, the histories hold the base's outputs: what
the set adds to them is never fed back, and what is measured moves the base alone.
"""

import numpy as np

from softneck.identification.linear._arx_runtime import arx_output
from softneck.identification.models._feedforward_runtime import echo_rest
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_observe,
    narx_regressor,
    narx_rest,
)
from softneck.identification.set_membership._principal_tree_runtime import slant_bounds, slant_slopes
from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._layout import array

# Thousands of times the rounding of angles and of sums as long as a regressor: numpy adds in another order.
NLSM_ROUNDING = 1e-12


class NlsmArrays(NarxArrays):
    """The set, then its linear base, which is empty without one."""

    table = array("n, 3", "regressors: source, channel and lag of each (see `narx_regressor`)")
    scale = array("n", "what each regressor is multiplied by")
    points = array("outputs, n, rows", "W: scaled regressors of the record, for each axis")
    values = array("outputs, rows", "y(k+1) there, less the base [rad]")
    bounds = array("outputs, 2", "gamma [rad] and epsilon [rad] of each axis (Eq. 15-17)")
    nodes = array("outputs, branches, columns", "tree over the points (see `_principal_tree_runtime`)")
    frame = array("outputs, directions, n", "directions of the tree")
    redefinition = array("c, motors", "T of Eq. 9-11, for the base")
    a = array("outputs, na", "of the base's outputs, newest first")
    b = array("outputs, nb", "of its redefined inputs, newest first")
    delay = array("outputs", "dead time of each axis [samples]")


def nlsm_rest(p: NlsmArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(p, parameters, x, outputs)
    bounds = p.outputs + p.motors
    for axis in range(p.outputs):  # they hold nothing but the start yet
        outputs[bounds + 2 * axis] = parameters[axis]
        outputs[bounds + 2 * axis + 1] = parameters[axis]


def nlsm_bounds(
    points: np.ndarray, values: np.ndarray, gamma: float, epsilon: float, w: np.ndarray
) -> tuple[float, float]:
    """Return f_l(w), f_u(w) (Eq. 19-20) over `points` (n, N), scaled, and their `values` (N,)."""
    squared = np.zeros(points.shape[1])
    # One regressor after the other: what is allocated is one row long, not the whole table.
    for i in range(points.shape[0]):
        gap = points[i] - w[i]
        squared += gap * gap
    cone = gamma * np.sqrt(squared)  # gamma |x - w(k)| of Eq. 19 and 20
    # Eq. 20 and Eq. 19; epsilon is the same in all cones, so that it is added once.
    return np.max(values - cone) - epsilon, np.min(values + cone) + epsilon


def nlsm_query(p: NlsmArrays, axis: int, epsilon: float, w: np.ndarray) -> tuple[float, float]:
    """Return f_l(w), f_u(w) of one axis: by the tree where loops are fast, else over all points by numpy."""
    gamma = p.bounds[axis, 0]
    if COMPILED:
        low, high = slant_bounds(p.points[axis], p.values[axis], p.nodes[axis], p.frame[axis], gamma, w)
        return low - epsilon, high + epsilon  # epsilon moves all cones alike: the tree does without
    return nlsm_bounds(p.points[axis], p.values[axis], gamma, epsilon, w)


def nlsm_query_slopes(
    p: NlsmArrays, axis: int, epsilon: float, w: np.ndarray, low: float, high: float, slopes: np.ndarray
) -> None:
    """Fill `slopes` (2, n) with the derivatives of the bounds `low` and `high` of `nlsm_query`."""
    near = np.empty(2)
    nlsm_near(low, high, epsilon, near)
    slant_slopes(p.points[axis], p.values[axis], p.nodes[axis], p.frame[axis], p.bounds[axis, 0], w, near, slopes)


def nlsm_near(low: float, high: float, epsilon: float, near: np.ndarray) -> None:
    """Fill `near` with bounds that are looser than those of the cones by more than rounding."""
    near[0] = low + epsilon - NLSM_ROUNDING * (1.0 + abs(low) + epsilon)
    near[1] = high - epsilon + NLSM_ROUNDING * (1.0 + abs(high) + epsilon)


def initialise(p: NlsmArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    nlsm_rest(p, parameters, x, outputs)
    # Of another robot than a neck the base is zero at rest and the outputs need not be: the set adds where they are.
    if p.nb > 0 and p.c == p.outputs:
        for axis in range(p.outputs):
            total = 0.0
            for k in range(p.rows):
                total += p.values[axis, k]
            echo_rest(p, x, axis, total / p.rows)


def step(p: NlsmArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the bounds of the outputs follow the motor positions in `outputs`."""
    narx_observe(p, parameters, x, inputs)
    regressor = np.empty(p.n)
    ahead = np.empty(p.outputs)
    bounds = p.outputs + p.motors
    for axis in range(p.outputs):
        narx_regressor(p, p.table, x, axis, regressor)  # Eq. 21, or the lags asked for
        w = regressor * p.scale
        low, high = nlsm_query(p, axis, p.bounds[axis, 1], w)
        # Without a base a and b are empty and this is zero.
        base = arx_output(p, p.redefinition, p.a[axis], p.b[axis], int(p.delay[axis]), x, axis)
        # The central estimate (Eq. 18).
        middle = 0.5 * (low + high)
        ahead[axis] = base + middle
        outputs[bounds + 2 * axis] = base + low
        outputs[bounds + 2 * axis + 1] = base + high
        # `narx_observe` takes this off again: with a base the histories hold the base alone.
        if p.nb > 0:
            x.added[axis] = middle
    narx_forward(p, parameters, x, ahead, outputs)
