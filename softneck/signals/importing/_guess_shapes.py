"""The part of a guess that uses the data: for files without a header or without telling names."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, SET_POINTS, redefine
from ._clocks import velocity_period
from ._draft import Draft, Pick
from ._layout import Column, Term
from ._odd_clocks import find_split_stamp, find_uneven_clock

# Enough rows for a decision, whatever the length of the log.
_MAX_ROWS = 20_000
# Longest lag of a motor behind its set-point and of the platform behind its motors [samples]: 0.2 s and 0.5 s at 20 ms.
_DRIVE_LAG = 10
_NECK_LAG = 25
# Smallest correlations of a motor with its set-point, of an output with its motors, of a rate with its position.
_MIN_FOLLOW_CORRELATION = 0.8
_MIN_OUTPUT_CORRELATION = 0.5
_MIN_RATE_CORRELATION = 0.9
# A command leads what it moves: the motors' later motions leave clearly less of it unexplained than the earlier ones,
# by this factor. In three logs of the lab's arm it was 0.3 to 0.85 for commands, and 0.75 or more for angles.
_LEAD_RATIO = 0.6
_VARIANCE_ROUNDING = 1e-4
# Columns with smaller differences in correlation count as equal; the one that moves most is taken, if it may be in the
# unit of the other angle: beyond a factor of 10 it is a current or a count.
_EQUAL_CORRELATION, _SAME_UNIT_RATIO = 0.1, 10.0
# A motor that moves by a smaller share of its neighbours' motion is at rest: encoder noise, or a drive that is off.
_STILL_RATIO = 0.01
# Poles of a drive per sample: time constants up to 0.4 s at 20 ms.
_DRIVE_POLES = (0.0, 0.5, 0.75, 0.85, 0.9, 0.95)
# Fewer rows for fits that are made hundreds of times.
_FEW_ROWS = 4000

Columns = Mapping[Column, Vector]
Triple = tuple[Column, Column, Column]


def find_clock(columns: Columns) -> Column | None:
    """Return the first column that rises by equal steps, except at restarts."""
    for name, values in columns.items():
        step = np.diff(values[:_MAX_ROWS])
        if step.size < 3 or not np.isfinite(step).all() or not (step > 0).any():
            continue
        typical = float(np.median(step[step > 0]))
        even = np.abs(step - typical) < 0.5 * typical
        # A logged ramp of another quantity would bend somewhere.
        if even.mean() > 0.9 and (step <= 0).mean() < 0.02:
            return name
    return None


def triples(columns: Columns) -> list[Triple]:
    """Return all triples of neighbouring columns."""
    names = list(columns)
    return [(names[k], names[k + 1], names[k + 2]) for k in range(len(names) - 2)]


def find_rates(columns: Columns, run: np.ndarray) -> tuple[Triple, Triple, float] | None:
    """Return three neighbouring columns, three others that are their rates, and the smallest correlation.

    One of the three may be at rest if no other triple fits.
    """
    agree = {(x, v): velocity_period(columns[x], columns[v], run)[1] for x, v in itertools.permutations(columns, 2)}
    for most_still in (0, 1):
        best, found = _MIN_RATE_CORRELATION, None
        for position, velocity in itertools.product(triples(columns), repeat=2):
            at_rest = find_still(columns, position)
            if set(position) & set(velocity) or len(at_rest) != most_still or at_rest != find_still(columns, velocity):
                continue
            worst = min(agree[pair] for k, pair in enumerate(zip(position, velocity, strict=True)) if k not in at_rest)
            if worst > best:
                best, found = worst, (position, velocity, worst)
        if found is not None:
            return found
    return None


def find_still(columns: Columns, triple: Sequence[Column]) -> list[int]:
    """Return the indices of columns that hardly move compared with the others."""
    spans = np.array([np.ptp(columns[name]) for name in triple])
    return np.flatnonzero(spans < _STILL_RATIO * spans.max()).tolist()


def correlation(x: Vector, y: Vector, lag: int = 0) -> float:
    """Return the correlation of x and of y `lag` samples later; 0 for a constant."""
    a, b = (x[: x.size - lag], y[lag:]) if lag >= 0 else (x[-lag:], y[: y.size + lag])
    a, b = a - a.mean(), b - b.mean()
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / float(np.sqrt(power)) if power > 0 else 0.0


def max_correlation(x: Vector, y: Vector, longest: int) -> tuple[float, int]:
    """Return the largest correlation (with its sign) of x with a later y, and its lag in samples."""
    longest = min(longest, x.size // 4)
    return max(((correlation(x, y, lag), lag) for lag in range(longest + 1)), key=lambda pair: abs(pair[0]))


def find_followed(columns: Columns, positions: Sequence[Column], free: Sequence[Column]) -> tuple[Triple, float] | None:
    """Return three neighbours of `free` that the positions follow, and the smallest correlation."""
    best, found, at_rest = _MIN_FOLLOW_CORRELATION, None, find_still(columns, positions)
    for triple in triples({name: columns[name] for name in free}):
        worst = min(
            max_correlation(columns[s], columns[p], _DRIVE_LAG)[0]
            for k, (s, p) in enumerate(zip(triple, positions, strict=True))
            if k not in at_rest
        )
        if worst > best:
            best, found = worst, (triple, worst)
    return found


def find_sums(
    columns: Columns, positions: Sequence[Column], free: Sequence[Column]
) -> tuple[tuple[Column, ...], Matrix, float]:
    """Return two neighbours of `free` whose sums are all positions, the factors (2, motors), and the smallest R2.

    Drives lag behind their set-points, so each sum is delayed and passes a first-order lag. Without it, columns that
    move with the positions, as the platform does, would fit better than the set-points.
    """
    P = np.column_stack([columns[name][:_FEW_ROWS] for name in positions])
    best, pair, factors = 0.0, (), np.zeros((2, len(positions)))
    for names, pole in itertools.product(itertools.pairwise(free), _DRIVE_POLES):
        U = np.column_stack([_low_pass(columns[name][:_FEW_ROWS], pole) for name in names])
        for lag in range(min(_DRIVE_LAG, len(P) // 4) + 1):
            u, y = U[: len(U) - lag], P[lag:]
            u, y = u - u.mean(axis=0), y - y.mean(axis=0)
            theta = np.linalg.lstsq(u, y, rcond=None)[0]
            power = np.maximum((y * y).sum(axis=0), 1e-300)
            R2 = float((1.0 - ((y - u @ theta) ** 2).sum(axis=0) / power).min())
            if best + 1e-6 < R2:
                best, pair, factors = R2, names, theta
    return pair, factors, best


def _low_pass(u: Vector, pole: float) -> Vector:
    """Filter by `x(k+1) = pole x(k) + (1 - pole) u(k+1)`, from rest at u(0)."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], u - u[0])) + u[0]


def find_outputs(columns: Columns, motors: Matrix, free: Sequence[Column]) -> dict[str, tuple[Column, float]]:
    """Return axis -> (column of `free` that responds to the axis of `motors` (time, 3), correlation).

    Outputs lag behind the motors: a column that leads them is a command and no output, however similar it is.
    """
    found: dict[str, tuple[Column, float]] = {}
    commands = {name for name in free if _is_command(columns[name], motors)}
    scores = {
        (axis, name): max_correlation(u, columns[name], _NECK_LAG)[0]
        for axis, u in zip(("pitch", "roll"), redefine(motors).T, strict=False)
        for name in free
        if name not in commands
    }
    for axis, name in sorted(scores, key=lambda key: -abs(scores[key])):
        other = next(iter(found.values()), None)
        if (
            abs(scores[axis, name]) > _MIN_OUTPUT_CORRELATION
            and axis not in found
            and (other is None or name != other[0])
        ):
            found[axis] = _largest(columns, {n: r for (a, n), r in scores.items() if a == axis}, name, other)
    return found


def _largest(
    columns: Columns, scores: Mapping[Column, float], best: Column, other: tuple[Column, float] | None
) -> tuple[Column, float]:
    """Return the column with the largest motion among those that correlate nearly as well as the best."""
    if other is None:
        return best, scores[best]
    span = float(np.ptp(columns[other[0]]))
    free = {name: r for name, r in scores.items() if name != other[0]}
    most = max(abs(r) for r in free.values())
    alike = [
        name
        for name, r in free.items()
        if abs(r) > most - _EQUAL_CORRELATION and np.ptp(columns[name]) < _SAME_UNIT_RATIO * span
    ]
    name = max(alike, key=lambda one: float(np.ptp(columns[one])), default=best)
    return name, free[name]


def _is_command(x: Vector, motors: Matrix) -> bool:
    """Return whether a column depends on later motions of the motors rather than on earlier ones."""
    x, motors = x[:_FEW_ROWS], motors[:_FEW_ROWS]
    longest = min(_NECK_LAG, x.size // 4)
    before = max(_explained_share(x[lag:], motors[: x.size - lag]) for lag in range(longest + 1))
    after = max((_explained_share(x[: x.size - lag], motors[lag:]) for lag in range(1, longest + 1)), default=0.0)
    # The offset removes the rounding of a sensor without noise.
    return 1.0 - after + _VARIANCE_ROUNDING < _LEAD_RATIO * (1.0 - before + _VARIANCE_ROUNDING)


def _explained_share(y: Vector, X: Matrix) -> float:
    """Return the share of the variance of y that a linear fit on X explains."""
    y, X = y - y.mean(), X - X.mean(axis=0)
    power = float(y @ y)
    left = y - X @ np.linalg.lstsq(X, y, rcond=1e-6)[0]
    return 1.0 - float(left @ left) / power if power > 0 else 0.0


def find_motors_and_outputs(
    columns: Columns, free: Sequence[Column]
) -> tuple[Triple, dict[str, tuple[Column, float]]] | None:
    """Return the three neighbours to which two other columns respond best, and those two."""
    best, found = 0.0, None
    for triple in triples({name: columns[name] for name in free}):
        motors = np.column_stack([columns[name] for name in triple])
        axes = find_outputs(columns, motors, [name for name in free if name not in triple])
        score = min((abs(r) for _, r in axes.values()), default=0.0)
        if len(axes) == 2 and score > best:
            best, found = score, (triple, axes)
    return found


def is_leading(columns: Columns, one: Triple, other: Triple) -> bool:
    """Return whether the triple `one` moves before the triple `other`."""
    after = sum(max_correlation(columns[a], columns[b], _DRIVE_LAG)[0] for a, b in zip(one, other, strict=True))
    before = sum(max_correlation(columns[b], columns[a], _DRIVE_LAG)[0] for a, b in zip(one, other, strict=True))
    return after >= before


# A table with more columns is no log, and would have too many pairs of columns.
_MAX_COLUMNS = 40
# A term with a smaller share of the motion is noise of the fit.
_MIN_TERM_SHARE = 0.05
# Smallest R2 of a fitted sum that may be a set-point: drives follow theirs to within a hundredth.
_MIN_SUM_R2 = 0.99
_AXIS = {"pitch": "theta_i", "roll": "phi_i"}

# Data alone give no certainty: another column may behave alike.
_MAX_CONFIDENCE = 0.89


def _confidence(agreement: float) -> float:
    """Return the confidence in a column chosen by a correlation or an R2."""
    return min(_MAX_CONFIDENCE, abs(agreement))


def by_shapes(draft: Draft) -> None:
    """Choose the columns that are still missing by their data."""
    pick_clock(draft)
    _rates(draft)
    _set_points(draft)
    _motors_without_rates(draft)
    motors = draft.motors()
    if motors is None or draft.has(("pitch", "roll")) or "inclination" in draft.picks:
        return
    for axis, (column, r) in find_outputs(draft.moving, motors, draft.free()[:_MAX_COLUMNS]).items():
        if axis not in draft.picks:
            _pick_output(draft, axis, column, r)


def _pick_output(draft: Draft, axis: str, column: str | int, r: float) -> None:
    inverted = "; inverted, so that it rises with it" if r < 0 else ""
    why = f"it follows {_AXIS[axis]} of the motors (correlation {r:.2f}), best of the columns with as large a motion"
    draft.pick(axis, column, why + inverted, sign=-1.0 if r < 0 else 1.0, confidence=_confidence(r))


def pick_clock(draft: Draft) -> None:
    """Choose the column of time by its data if no title names it."""
    if "time" in draft.picks:
        return
    free = {name: draft.moving[name] for name in draft.free()}
    whole = {name: draft.sniffed.columns[name] for name in draft.free()}
    if (stamp := find_split_stamp({n: v for n, v in whole.items() if np.isfinite(v).all()})) is not None:
        terms = (Term(stamp[0]), Term(stamp[1], 1e-9))
        draft.picks["time"] = Pick(
            terms, "whole seconds and the nanoseconds behind them, as in ROS 2", "s", confidence=0.85
        )
        return
    column = find_clock(free)
    if column is None:
        column = find_uneven_clock({name: values for name, values in whole.items() if np.isfinite(values).all()})
        if column is not None:
            draft.pick(
                "time", column, "it rises in every row, by uneven steps, as no other column does", confidence=0.7
            )
        return
    step = np.diff(free[column])
    draft.pick("time", column, f"it rises by equal steps of {np.median(step):.4g}", confidence=0.85)


def _rates(draft: Draft) -> None:
    if draft.has(MOTOR_POSITIONS) or draft.has(MOTOR_VELOCITIES):
        return
    free = {name: draft.moving[name] for name in draft.free()[:_MAX_COLUMNS]}
    found = find_rates(free, draft.runs())
    if found is None:
        return
    positions, velocities, agree = found
    for names, columns, what in (
        (MOTOR_POSITIONS, positions, "has three rates beside it"),
        (MOTOR_VELOCITIES, velocities, "is one"),
    ):
        for channel, column in zip(names, columns, strict=True):
            draft.pick(
                channel, column, f"of three like columns it {what}: differences agree with correlation {agree:.2f}"
            )


def _set_points(draft: Draft) -> None:
    if draft.has(SET_POINTS) or not draft.has(MOTOR_POSITIONS):
        return
    positions = [draft.picks[name].terms[0].column for name in MOTOR_POSITIONS]
    free = draft.free()[:_MAX_COLUMNS]
    if any(column not in draft.moving for column in positions):
        return
    found = find_followed(draft.moving, positions, free)
    if found is not None:
        why = f"the position follows it (correlation {found[1]:.2f} or more)"
        for channel, column in zip(SET_POINTS, found[0], strict=True):
            draft.pick(channel, column, why, confidence=_confidence(found[1]))
        return
    at_rest = find_still(draft.moving, positions)
    moved = [j for j in range(3) if j not in at_rest]
    pair, factors, R2 = find_sums(draft.moving, [positions[j] for j in moved], free[:12])
    if R2 < _MIN_SUM_R2:
        return  # `use_positions_as_inputs` makes the positions the inputs
    parts = np.abs(factors) * np.array([[draft.moving[name].std()] for name in pair])
    for k, j in enumerate(moved):
        counts = parts[:, k] > _MIN_TERM_SHARE * parts[:, k].sum()
        terms = tuple(Term(name, float(f"{factors[i, k]:.4g}")) for i, name in enumerate(pair) if counts[i])
        why = f"the position follows this sum (R2 {R2:.3f} or more); its factors were fitted to the data"
        draft.picks[SET_POINTS[j]] = Pick(terms, why, draft.picks[MOTOR_POSITIONS[j]].unit, confidence=_confidence(R2))
    for j in at_rest:
        why = "its position is constant while the others move, so its set-point is unknown: its position is used"
        draft.pick(SET_POINTS[j], positions[j], why, confidence=0.7)


def _motors_without_rates(draft: Draft) -> None:
    """Take the three columns to which two others respond; of two such triples the leading one is the set-points."""
    if draft.has(SET_POINTS) or draft.has(MOTOR_POSITIONS):
        return
    free = draft.free()[:_MAX_COLUMNS]
    found = find_motors_and_outputs(draft.moving, free)
    if found is None:
        return
    first, axes = found
    taken = {*first, *(column for column, _ in axes.values())}
    rest = {name: draft.moving[name] for name in free if name not in taken}
    alike = [
        other
        for other in triples(rest)
        if min(correlation(draft.moving[a], draft.moving[b]) for a, b in zip(first, other, strict=True))
        > _MIN_FOLLOW_CORRELATION
    ]
    why = "it is one of three neighbours to which two other columns respond best"
    if alike:
        other = alike[0]
        first, other = (first, other) if is_leading(draft.moving, first, other) else (other, first)
        for channel, column in zip(MOTOR_POSITIONS, other, strict=True):
            draft.pick(channel, column, f"{why}, and it trails the set-point", confidence=0.7)
    for channel, column in zip(SET_POINTS, first, strict=True):
        draft.pick(channel, column, why, confidence=0.7)
    for axis, (column, r) in axes.items():
        if axis not in draft.picks:
            _pick_output(draft, axis, column, r)
