"""What columns without names tell by their data: time, rates, what follows what, and which axis answers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._redefinition import redefine
from ._clocks import velocity_period
from ._layout import Column

# Enough rows to tell, whatever the length of the log.
_ROWS = 20_000
# Samples by which a motor may trail its set-point, and the platform its motors, at 20 ms: 0.2 s and 0.5 s.
_DRIVE_LAG = 10
_NECK_LAG = 25
# Beyond this correlation one column tells of the motion of another.
FOLLOWS = 0.8
_ANSWERS = 0.5
_RATE = 0.9
# A command leads what it moves: the motors' later motions leave clearly less of it unexplained than the earlier ones,
# by this factor. In three logs of the lab's arm commands had 0.3 to 0.85, and angles 0.75 and more.
_CLEARLY = 0.6
_ROUNDING = 1e-4
# Columns whose correlations differ by less answer alike; of these the one that moves most is taken, as long as it may
# be in the unit of the other angle: a factor of 10 apart it is a current or a count.
_ALIKE, _ONE_UNIT = 0.1, 10.0
# A motor that moves by less of what its neighbours do stands still: its encoder's last digit, or a drive that is off.
_STILL = 0.01
# Poles of a drive a sample, for what it makes of its set-point: time constants to 0.4 s at 20 ms.
_DRIVE_POLES = (0.0, 0.5, 0.75, 0.85, 0.9, 0.95)
# Rows for fits that are made hundreds of times.
_FEW_ROWS = 4000

Columns = Mapping[Column, Vector]
Triple = tuple[Column, Column, Column]


def shortened(columns: Columns) -> dict[Column, Vector]:
    """Return the first rows of the columns that move, with missed samples at the column's mean."""
    found: dict[Column, Vector] = {}
    for name, values in columns.items():
        head = values[:_ROWS]
        seen = np.isfinite(head)
        # Sums of fourth powers of numbers beyond 1e60 would overflow; no log holds such.
        if seen.any() and np.ptp(head[seen]) > 0 and np.abs(head[seen]).max() < 1e60:
            found[name] = np.where(seen, head, head[seen].mean())
    return found


def clock(columns: Columns) -> Column | None:
    """Return the column that rises by equal steps, but for restarts; the first of several."""
    for name, values in columns.items():
        step = np.diff(values[:_ROWS])
        if step.size < 3 or not np.isfinite(step).all() or not (step > 0).any():
            continue
        typical = float(np.median(step[step > 0]))
        even = np.abs(step - typical) < 0.5 * typical
        # A ramp that something else logged would bend somewhere.
        if even.mean() > 0.9 and (step <= 0).mean() < 0.02:
            return name
    return None


def triples(columns: Columns) -> list[Triple]:
    """Return all three neighbouring columns."""
    names = list(columns)
    return [(names[k], names[k + 1], names[k + 2]) for k in range(len(names) - 2)]


def rates(columns: Columns, run: np.ndarray) -> tuple[Triple, Triple, float] | None:
    """Return three neighbours and three others that are their rates, and how well they agree at least.

    One of the three may stand still, where no three agree.
    """
    agree = {
        (x, v): velocity_period(columns[x], columns[v], run)[1]
        for x, v in itertools.permutations(columns, 2)
    }  # fmt: skip
    for most_still in (0, 1):
        best, found = _RATE, None
        for position, velocity in itertools.product(triples(columns), repeat=2):
            stands = still(columns, position)
            if set(position) & set(velocity) or len(stands) != most_still or stands != still(columns, velocity):
                continue
            worst = min(agree[pair] for k, pair in enumerate(zip(position, velocity, strict=True)) if k not in stands)
            if worst > best:
                best, found = worst, (position, velocity, worst)
        if found is not None:
            return found
    return None


def still(columns: Columns, triple: Sequence[Column]) -> list[int]:
    """Return which of some columns stand still beside the others."""
    spans = np.array([np.ptp(columns[name]) for name in triple])
    return np.flatnonzero(spans < _STILL * spans.max()).tolist()


def correlation(x: Vector, y: Vector, lag: int = 0) -> float:
    """Return the correlation of x and of y `lag` samples later; 0 where one stands still."""
    a, b = (x[: x.size - lag], y[lag:]) if lag >= 0 else (x[-lag:], y[: y.size + lag])
    a, b = a - a.mean(), b - b.mean()
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / float(np.sqrt(power)) if power > 0 else 0.0


def lagged(x: Vector, y: Vector, longest: int) -> tuple[float, int]:
    """Return the largest correlation (with its sign) of x with a later y, and its lag in samples."""
    longest = min(longest, x.size // 4)
    return max(((correlation(x, y, lag), lag) for lag in range(longest + 1)), key=lambda pair: abs(pair[0]))


def followed(columns: Columns, positions: Sequence[Column], free: Sequence[Column]) -> tuple[Triple, float] | None:
    """Return three neighbours of `free` that the positions follow, and how well at least."""
    best, found, stands = FOLLOWS, None, still(columns, positions)
    for triple in triples({name: columns[name] for name in free}):
        worst = min(
            lagged(columns[s], columns[p], _DRIVE_LAG)[0]
            for k, (s, p) in enumerate(zip(triple, positions, strict=True)) if k not in stands
        )  # fmt: skip
        if worst > best:
            best, found = worst, (triple, worst)
    return found


def sums(
    columns: Columns, positions: Sequence[Column], free: Sequence[Column]
) -> tuple[tuple[Column, ...], Matrix, float]:
    """Return two neighbours of `free` of which all positions are sums, the factors (2, 3), and the least R2 of them.

    Drives trail their set-points: each sum is delayed and passes a first-order lag. Without these what moves with the
    positions, as the platform does, would fit better than what they were asked for.
    """
    P = np.column_stack([columns[name][:_FEW_ROWS] for name in positions])
    best, pair, factors = 0.0, (), np.zeros((2, len(positions)))
    for names, pole in itertools.product(itertools.pairwise(free), _DRIVE_POLES):
        U = np.column_stack([_lag(columns[name][:_FEW_ROWS], pole) for name in names])
        for lag in range(min(_DRIVE_LAG, len(P) // 4) + 1):
            u, y = U[: len(U) - lag], P[lag:]
            u, y = u - u.mean(axis=0), y - y.mean(axis=0)
            theta = np.linalg.lstsq(u, y, rcond=None)[0]
            power = np.maximum((y * y).sum(axis=0), 1e-300)
            R2 = float((1.0 - ((y - u @ theta) ** 2).sum(axis=0) / power).min())
            if best + 1e-6 < R2:
                best, pair, factors = R2, names, theta
    return pair, factors, best


def _lag(u: Vector, pole: float) -> Vector:
    """Return `x(k+1) = pole x(k) + (1 - pole) u(k+1)` from rest at u(0)."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], u - u[0])) + u[0]


def answers(columns: Columns, motors: Matrix, free: Sequence[Column]) -> dict[str, tuple[Column, float]]:
    """Return pitch and roll: which of `free` answers theta_i and phi_i of `motors` (time, 3), and the correlation.

    Outputs trail the motors: what leads them is a command and answers nothing, however alike it is.
    """
    found: dict[str, tuple[Column, float]] = {}
    commands = {name for name in free if _is_command(columns[name], motors)}
    scores = {
        (axis, name): lagged(u, columns[name], _NECK_LAG)[0]
        for axis, u in zip(("pitch", "roll"), redefine(motors).T, strict=False)
        for name in free
        if name not in commands
    }
    for axis, name in sorted(scores, key=lambda key: -abs(scores[key])):
        other = next(iter(found.values()), None)
        if abs(scores[axis, name]) > _ANSWERS and axis not in found and (other is None or name != other[0]):
            found[axis] = _largest(columns, {n: r for (a, n), r in scores.items() if a == axis}, name, other)
    return found


def _largest(
    columns: Columns, scores: Mapping[Column, float], best: Column, other: tuple[Column, float] | None
) -> tuple[Column, float]:
    """Return what moves most of the columns that answer like the best, but for the other angle."""
    if other is None:
        return best, scores[best]
    span = float(np.ptp(columns[other[0]]))
    free = {name: r for name, r in scores.items() if name != other[0]}
    most = max(abs(r) for r in free.values())
    alike = [name for name, r in free.items() if abs(r) > most - _ALIKE and np.ptp(columns[name]) < _ONE_UNIT * span]
    name = max(alike, key=lambda one: float(np.ptp(columns[one])), default=best)
    return name, free[name]


def _is_command(x: Vector, motors: Matrix) -> bool:
    """Return whether a column is a sum of what the motors do later, rather than of what they did."""
    x, motors = x[:_FEW_ROWS], motors[:_FEW_ROWS]
    longest = min(_NECK_LAG, x.size // 4)
    before = max(_share(x[lag:], motors[: x.size - lag]) for lag in range(longest + 1))
    after = max((_share(x[: x.size - lag], motors[lag:]) for lag in range(1, longest + 1)), default=0.0)
    # What rounding leaves of a sensor without noise tells nothing.
    return 1.0 - after + _ROUNDING < _CLEARLY * (1.0 - before + _ROUNDING)


def _share(y: Vector, X: Matrix) -> float:
    """Return the share of the variance of y that a sum of the columns of X explains."""
    y, X = y - y.mean(), X - X.mean(axis=0)
    power = float(y @ y)
    left = y - X @ np.linalg.lstsq(X, y, rcond=1e-6)[0]
    return 1.0 - float(left @ left) / power if power > 0 else 0.0


def motors_and_answers(
    columns: Columns, free: Sequence[Column]
) -> tuple[Triple, dict[str, tuple[Column, float]]] | None:
    """Return the three neighbours to which two other columns answer best, and those."""
    best, found = 0.0, None
    for triple in triples({name: columns[name] for name in free}):
        motors = np.column_stack([columns[name] for name in triple])
        axes = answers(columns, motors, [name for name in free if name not in triple])
        score = min((abs(r) for _, r in axes.values()), default=0.0)
        if len(axes) == 2 and score > best:
            best, found = score, (triple, axes)
    return found


def leads(columns: Columns, one: Triple, other: Triple) -> bool:
    """Return whether `one` moves first."""
    after = sum(lagged(columns[a], columns[b], _DRIVE_LAG)[0] for a, b in zip(one, other, strict=True))
    before = sum(lagged(columns[b], columns[a], _DRIVE_LAG)[0] for a, b in zip(one, other, strict=True))
    return after >= before
