"""What columns without names tell by their data: time, rates, what follows what, and which axis answers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._redefinition import redefine
from ._layout import Column
from ._sample_time import velocity_period

# Enough rows to tell, whatever the length of the log.
_ROWS = 20_000
# Samples by which a motor may trail its set-point, and the platform its motors, at 20 ms: 0.2 s and 0.5 s.
_DRIVE_LAG = 10
_NECK_LAG = 25
# Beyond this correlation one column tells of the motion of another.
FOLLOWS = 0.8
_ANSWERS = 0.5
_RATE = 0.9

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
    """Return three neighbours and three others that are their rates, and how well they agree at least."""
    agree = {
        (x, v): velocity_period(columns[x], columns[v], run)[1]
        for x, v in itertools.permutations(columns, 2)
    }  # fmt: skip
    best, found = _RATE, None
    for position, velocity in itertools.product(triples(columns), repeat=2):
        if not set(position) & set(velocity):
            worst = min(agree[pair] for pair in zip(position, velocity, strict=True))
            if worst > best:
                best, found = worst, (position, velocity, worst)
    return found


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
    best, found = FOLLOWS, None
    for triple in triples({name: columns[name] for name in free}):
        worst = min(
            lagged(columns[s], columns[p], _DRIVE_LAG)[0] for s, p in zip(triple, positions, strict=True)
        )  # fmt: skip
        if worst > best:
            best, found = worst, (triple, worst)
    return found


def sums(
    columns: Columns, positions: Sequence[Column], free: Sequence[Column]
) -> tuple[tuple[Column, ...], Matrix, float]:
    """Return two of `free` of which all positions are sums, the factors (2, 3), and the least R2 of the three."""
    P = np.column_stack([columns[name] for name in positions])
    best, pair, factors = 0.0, (), np.zeros((2, 3))
    for names in itertools.combinations(free, 2):
        U = np.column_stack([columns[name] for name in names])
        for lag in range(min(_DRIVE_LAG, len(P) // 4) + 1):
            u, y = U[: len(U) - lag], P[lag:]
            u, y = u - u.mean(axis=0), y - y.mean(axis=0)
            theta = np.linalg.lstsq(u, y, rcond=None)[0]
            power = np.maximum((y * y).sum(axis=0), 1e-300)
            R2 = float((1.0 - ((y - u @ theta) ** 2).sum(axis=0) / power).min())
            if best + 1e-6 < R2:
                best, pair, factors = R2, names, theta
    return pair, factors, best


def answers(columns: Columns, motors: Matrix, free: Sequence[Column]) -> dict[str, tuple[Column, float]]:
    """Return pitch and roll: which of `free` answers theta_i and phi_i of `motors` (time, 3), and the correlation."""
    inputs = redefine(motors)
    scores = [
        (abs(r), axis, name, r)
        for axis, u in (("pitch", inputs[:, 0]), ("roll", inputs[:, 1]))
        for name in free
        for r, _ in (lagged(u, columns[name], _NECK_LAG),)
    ]
    found: dict[str, tuple[Column, float]] = {}
    for size, axis, name, r in sorted(scores, key=lambda score: -score[0]):
        if size > _ANSWERS and axis not in found and name not in {taken for taken, _ in found.values()}:
            found[axis] = (name, r)
    return found


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
