"""The part of a guess that goes by the data: for files without a header, and names that say nothing."""

from __future__ import annotations

import numpy as np

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, SET_POINTS
from ._column_shapes import (
    FOLLOWS,
    answers,
    clock,
    correlation,
    followed,
    leads,
    motors_and_answers,
    rates,
    still,
    sums,
    triples,
)
from ._draft import Draft, Pick
from ._layout import Term

# More columns than this are a dump of something, and all pairs of them are too many.
_MOST = 40
# A term that adds less than this part of the motion is noise of the fit.
_COUNTS = 0.05
# R2 of a sum with fitted factors that is what the drives were asked for: they leave less of it than a hundredth.
_SUM = 0.99
_AXIS = {"pitch": "theta_i", "roll": "phi_i"}


# What the data alone tell is doubted, however well they agree: another column may behave alike.
_SUREST = 0.89


def _sure(agreement: float) -> float:
    """Return the confidence in a column that was taken by a correlation or an R2."""
    return min(_SUREST, abs(agreement))


def by_shapes(draft: Draft) -> None:
    """Take for what is still missing the columns whose data behave like it."""
    _clock(draft)
    _rates(draft)
    _set_points(draft)
    _motors_without_rates(draft)
    motors = draft.motors()
    if motors is None or draft.has(("pitch", "roll")) or "inclination" in draft.picks:
        return
    for axis, (column, r) in answers(draft.moving, motors, draft.free()[:_MOST]).items():
        if axis not in draft.picks:
            _answer(draft, axis, column, r)


def _answer(draft: Draft, axis: str, column: str | int, r: float) -> None:
    why = f"it answers {_AXIS[axis]} of the motors with correlation {r:.2f}; none that moves as far does so more"
    sign = -1.0 if r < 0 else 1.0
    draft.pick(
        axis,
        column,
        why + ("; turned round, so that it rises with it" if r < 0 else ""),
        sign=sign,
        confidence=_sure(r),
    )


def _clock(draft: Draft) -> None:
    if "time" in draft.picks:
        return
    free = {name: draft.moving[name] for name in draft.free()}
    column = clock(free)
    if column is None:
        return
    step = np.diff(free[column])
    draft.pick("time", column, f"it rises by equal steps of {np.median(step):.4g}", confidence=0.85)


def _rates(draft: Draft) -> None:
    if draft.has(MOTOR_POSITIONS) or draft.has(MOTOR_VELOCITIES):
        return
    free = {name: draft.moving[name] for name in draft.free()[:_MOST]}
    found = rates(free, draft.runs())
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
    free = draft.free()[:_MOST]
    if any(column not in draft.moving for column in positions):
        return
    found = followed(draft.moving, positions, free)
    if found is not None:
        for channel, column in zip(SET_POINTS, found[0], strict=True):
            draft.pick(
                channel,
                column,
                f"the position follows it (correlation {found[1]:.2f} or more)",
                confidence=_sure(found[1]),
            )
        return
    stands = still(draft.moving, positions)
    moved = [j for j in range(3) if j not in stands]
    pair, factors, R2 = sums(draft.moving, [positions[j] for j in moved], free[:12])
    if R2 < _SUM:
        return  # the positions become the inputs
    parts = np.abs(factors) * np.array([[draft.moving[name].std()] for name in pair])
    for k, j in enumerate(moved):
        counts = parts[:, k] > _COUNTS * parts[:, k].sum()
        terms = tuple(Term(name, float(f"{factors[i, k]:.4g}")) for i, name in enumerate(pair) if counts[i])
        why = f"the position follows this sum (R2 {R2:.3f} or more); its factors were fitted to the data"
        draft.picks[SET_POINTS[j]] = Pick(terms, why, draft.picks[MOTOR_POSITIONS[j]].unit, confidence=_sure(R2))
    for j in stands:
        why = "its position stands still beside the others', so nothing tells what was asked of it: taken as asked for"
        draft.pick(SET_POINTS[j], positions[j], why, confidence=0.7)


def _motors_without_rates(draft: Draft) -> None:
    """Take the three columns to which two others answer; of two such triples the leading one is the set-points."""
    if draft.has(SET_POINTS) or draft.has(MOTOR_POSITIONS):
        return
    free = draft.free()[:_MOST]
    found = motors_and_answers(draft.moving, free)
    if found is None:
        return
    first, axes = found
    taken = {*first, *(column for column, _ in axes.values())}
    rest = {name: draft.moving[name] for name in free if name not in taken}
    alike = [
        other
        for other in triples(rest)
        if min(correlation(draft.moving[a], draft.moving[b]) for a, b in zip(first, other, strict=True)) > FOLLOWS
    ]
    why = "it is one of three neighbours to which two other columns answer best"
    if alike:
        other = alike[0]
        first, other = (first, other) if leads(draft.moving, first, other) else (other, first)
        for channel, column in zip(MOTOR_POSITIONS, other, strict=True):
            draft.pick(channel, column, f"{why}, and it trails the set-point", confidence=0.7)
    for channel, column in zip(SET_POINTS, first, strict=True):
        draft.pick(channel, column, why, confidence=0.7)
    for axis, (column, r) in axes.items():
        if axis not in draft.picks:
            _answer(draft, axis, column, r)
