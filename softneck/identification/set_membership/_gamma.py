"""gamma and epsilon: what a data set allows, where the knee is, and which pair of points forbids a choice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Vector, require_one_of
from softneck.runtime import load_functions
from softneck.runtime._compile import have_numba
from softneck.signals import Recording

from ..models._fitting import in_display_unit
from ._forest import PointTree
from ._trees import tree_nodes, tree_order

_TREE_SEARCH = "softneck.identification.set_membership._gamma_runtime"
_ALL_PAIRS = "softneck.identification.set_membership._cones_runtime"
# What epsilon stands for between two points: the paper asks f_u(i) >= y(i) and f_l(i) <= y(i) of the
# estimator, Milanese and Novara (2004, Theorem 1) that one function passes within epsilon of both points.
RULES = {"paper": 1.0, "milanese_novara": 2.0}
# Of the outputs' range: from below any noise to where half of all motion counts as noise.
_SMALLEST, _LARGEST, _STEPS = 3e-4, 0.5, 32


@dataclass(frozen=True, slots=True, eq=False)
class GammaCurve:
    """The least gamma for every epsilon; what lies on or above it is consistent with the data.

    Attributes:
        epsilon: (m,) rising.
        gamma: (m,) falling and convex in epsilon; infinite where equal regressors are further apart.
        pairs: (m, 2) the two rows that decide each gamma.
        knee: index of the corner of gamma over log epsilon, furthest below its chord: left of it gamma rises
            to follow the noise, right of it what falls is the function's own slope.
    """

    epsilon: Vector
    gamma: Vector
    pairs: np.ndarray
    knee: int

    @property
    def recommended(self) -> tuple[float, float]:
        """Return (gamma, epsilon) at the knee."""
        return float(self.gamma[self.knee]), float(self.epsilon[self.knee])


def gamma_curve(points: Matrix, values: Vector, epsilon: Vector | None = None, *, rule: str = "paper") -> GammaCurve:
    """Return the whole curve gamma*(epsilon) over all pairs of points.

    Args:
        points: (n, N) scaled regressors.
        values: (N,) outputs.
        epsilon: where to look; None takes 32 steps from 3e-4 to 0.5 of the range of the outputs.
        rule: "paper" (f_u(i) >= y(i)) or "milanese_novara" (2 epsilon); see docs, "Set membership".

    Raises:
        DataError: fewer than two points, shapes that do not fit, numbers that are not finite, constant outputs.
    """
    return curve_over(*_checked(points, values), epsilon, rule=rule)


def curve_over(
    points: Matrix, values: Vector, epsilon: Vector | None = None, *, rule: str, nodes: Matrix | None = None
) -> GammaCurve:
    """Return `gamma_curve` of checked points; with `nodes`, of points in tree order."""
    require_one_of("rule", rule, tuple(RULES))
    if epsilon is None:
        span = float(np.ptp(values))
        if span == 0.0:
            raise DataError("the outputs are constant: every gamma fits them; give `epsilon`.")
        epsilon = np.geomspace(_SMALLEST, _LARGEST, _STEPS) * span
    epsilon = np.sort(np.atleast_1d(np.asarray(epsilon, dtype=np.float64)))
    if not (np.isfinite(epsilon).all() and (epsilon >= 0.0).all()):
        raise DataError("each `epsilon` must be finite and at least 0.")
    gamma, pairs = least_gammas(points, values, RULES[rule] * epsilon, nodes=nodes)
    return GammaCurve(epsilon, np.where(gamma > 1e200, np.inf, gamma), pairs, _knee(epsilon, gamma))


def offending_pair(
    points: Matrix, values: Vector, gamma: float, epsilon: float, *, rule: str = "paper"
) -> tuple[int, int] | None:
    """Return the two points that deny (gamma, epsilon) the most, or None where the data allow it (FSS not empty)."""
    require_one_of("rule", rule, tuple(RULES))
    points, values = _checked(points, values)
    least, pairs = least_gammas(points, values, np.array([RULES[rule] * epsilon]))
    # The distance and its reciprocal round once each: a gamma found here must pass here.
    return None if least[0] <= gamma * (1.0 + 1e-12) else (int(pairs[0, 0]), int(pairs[0, 1]))


def least_gammas(
    points: Matrix, values: Vector, slacks: Vector, *, nodes: Matrix | None = None
) -> tuple[Vector, np.ndarray]:
    """Return for each slack the least gamma (m,) with `|y_j - y_k| <= slack + gamma |w_j - w_k|`, and its pair (m, 2).

    Compiled by branch and bound; without numba over all pairs by numpy, some hundred times slower.
    With `nodes` (2^l, 2 n + 2) the points are in tree order already. A gamma beyond 1e200 says that equal regressors
    have outputs further apart than the slack.
    """
    rising = np.argsort(slacks, kind="stable")
    gammas, found = np.zeros(slacks.size), np.zeros((slacks.size, 2), dtype=np.int64)
    if not have_numba():
        pairs = np.zeros((slacks.size, 2))
        gammas = load_functions(_ALL_PAIRS).least_gammas(points, values, slacks, pairs)
        return gammas, pairs.astype(np.int64)
    order = None
    if nodes is None:
        order = tree_order(points)
        points, values = np.ascontiguousarray(points[:, order]), values[order]
        nodes = tree_nodes(points, values)
    search = load_functions(_TREE_SEARCH).gamma_search
    search(points, values, nodes, np.ascontiguousarray(slacks[rising]), gammas, found)
    back = np.argsort(rising)
    return gammas[back], found[back] if order is None else order[found[back]]


def _checked(points: Matrix, values: Vector) -> tuple[Matrix, Vector]:
    points = np.ascontiguousarray(points, dtype=np.float64)
    values = np.ascontiguousarray(values, dtype=np.float64)
    if points.ndim != 2 or values.shape != points.shape[1:]:
        raise DataError(f"`points` must be (n, N) and `values` (N,); got {points.shape} and {values.shape}.")
    if values.size < 2:
        raise DataError(f"a set needs at least 2 points; got {values.size}.")
    if not (np.isfinite(points).all() and np.isfinite(values).all()):
        raise DataError("`points` and `values` must be finite; leave out rows with a missed sample.")
    return points, values


def _knee(epsilon: Vector, gamma: Vector) -> int:
    """Return the point furthest below the chord of gamma over log epsilon, among the finite ones."""
    usable = np.flatnonzero((gamma < 1e200) & (epsilon > 0.0))
    if usable.size == 0:
        return epsilon.size - 1
    x, y = np.log(epsilon[usable]), gamma[usable]
    chord = y[0] + (y[-1] - y[0]) * (x - x[0]) / max(x[-1] - x[0], 1e-300)
    return int(usable[np.argmax(chord - y)])


def require_allowed(points: PointTree, output: int, gamma: float, epsilon: float, rule: str) -> None:
    """Raise DataError, naming the pair, unless the data allow (gamma, epsilon): else no function fits (FSS empty)."""
    P, y = points.points, points.values[output]
    least, pairs = least_gammas(P, y, np.array([RULES[rule] * epsilon]), nodes=points.own_nodes(output))
    # A gamma beyond 1e200 stands for none; the distance and its reciprocal round once each.
    if least[0] <= min(gamma * (1.0 + 1e-12), 1e200):
        return
    j, k = sorted(pairs[0], key=lambda column: points.ages[column])
    distance, rise = float(np.linalg.norm(P[:, j] - P[:, k])), float(abs(y[j] - y[k]))
    who = f"rows {int(points.ages[j])} and {int(points.ages[k])} of `X` and `Y`"
    raise DataError(denial(who, f"output {output} is {rise:.6g} apart", distance, (gamma, epsilon), float(least[0])))


def denial(who: str, rise: str, distance: float, tried: tuple[float, float], least: float) -> str:
    """Return the sentence about a pair: who they are, how far apart, what would do."""
    gamma, epsilon = tried
    if least > 1e200:
        return (
            f"epsilon {epsilon:.6g} is below the noise: {who} have equal regressors and {rise}, so no function fits "
            "both (the FSS is empty). Set `epsilon` higher, or leave one of the two out."
        )
    return (
        f"gamma {gamma:.6g} with epsilon {epsilon:.6g} is contradicted by the data (the FSS is empty): between {who} "
        f"the regressor moves by {distance:.6g} and {rise}. With this epsilon gamma must be at least {least:.6g}; else "
        "set `epsilon` higher, or leave one of the two out."
    )


def require_feasible(
    recording: Recording, table: Matrix, data: Sequence[tuple[Matrix, Vector]], gamma: Vector, epsilon: Vector
) -> None:
    """Raise DataError, naming two samples of the recording, where equal regressors deny epsilon whatever gamma is.

    Args:
        recording: what the set was made of.
        table: the regressor, rows (source, channel, lag).
        data: scaled regressors (n, N) and targets (N,) of each axis, in the recording's order.
        gamma: (outputs,) the least; beyond 1e100 there is none.
        epsilon: (outputs,) [rad].
    """
    if gamma.max() <= 1e100:
        return
    axis = int(np.argmax(gamma))
    points, values = data[axis]
    j, k = sorted(least_gammas(points, values, epsilon[axis : axis + 1])[1][0].tolist())
    rows = _rows_of(recording, table, axis, values.size)
    name, unit = recording.robot.outputs.names[axis], recording.robot.outputs.display_unit
    tried = in_display_unit(recording.robot, epsilon)
    rise = float(in_display_unit(recording.robot, np.abs(values[j] - values[k])))
    where = f"samples {j} and {k} of the set"
    if rows is not None:
        where = " and ".join(
            f"row {row} (run {recording.run[row]}, {recording.time[row]:.6g} s)" for row in (rows[j], rows[k])
        )
    raise DataError(
        f"epsilon {tried.round(4).tolist()} {unit} is below the noise: equal regressors have outputs "
        f"further apart, so no function fits the data. {where} differ by {rise:.4g} {unit} in {name} and by nothing in "
        "the regressor. Set `epsilon` higher."
    )


def _rows_of(recording: Recording, table: Matrix, axis: int, count: int) -> np.ndarray | None:
    """Return the recording's row (count,) of each sample of the set, or None where that cannot be told."""
    lags = table[:, 2].astype(int)
    # Form `residual` (source 3) waits for its base to settle.
    skip = (2 if (table[:, 0] == 3).any() else 1) * int(lags.max())
    runs, start, found = recording.runs(), 0, []
    for run in runs:
        own = sorted({0, *lags[table[:, 0] == 0]})
        there = np.array(
            [all(np.isfinite(run.outputs[k - lag, axis]) for lag in own) for k in range(skip, len(run))], dtype=bool
        )
        found.append(start + skip + np.flatnonzero(there))
        start += len(run)
    rows = np.concatenate(found)
    return rows if rows.size == count else None
