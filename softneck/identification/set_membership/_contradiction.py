"""What the data deny, said by naming the two rows that deny it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.signals import Recording

from ._forest import PointTree
from ._gamma import RULES, least_gammas


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
        gamma: (2,) the least; beyond 1e100 there is none.
        epsilon: (2,) [rad].
    """
    if gamma.max() <= 1e100:
        return
    axis = int(np.argmax(gamma))
    points, values = data[axis]
    j, k = sorted(least_gammas(points, values, epsilon[axis : axis + 1])[1][0].tolist())
    rows = _rows_of(recording, table, axis, values.size)
    name, rise = ("pitch", "roll")[axis], float(np.degrees(abs(values[j] - values[k])))
    where = f"samples {j} and {k} of the set"
    if rows is not None:
        where = " and ".join(
            f"row {row} (run {recording.run[row]}, {recording.time[row]:.6g} s)" for row in (rows[j], rows[k])
        )
    raise DataError(
        f"epsilon {np.degrees(epsilon).round(4).tolist()} deg is below the noise: equal regressors have outputs "
        f"further apart, so no function fits the data. {where} differ by {rise:.4g} deg in {name} and by nothing in "
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
