"""What bounds are worth: whether they held what they promise, whether they are of use, and bounds from whole records.

Calibrated bounds take the errors of whole stretches as exchangeable, never rows: a free run that is wrong is wrong for
long. The half-width for the largest error of a further record is an order statistic of the records' largest errors
(Stankeviciute et al. 2021); that for one of its samples weighs each record alike, and a further one as infinite (Lee,
Barber and Willett 2023). At 90 % either needs nine records. They are exchangeable with records of the same kind alone:
beyond the set-points of these there is no bound, and on motions unlike these the coverage is what it turns out to be:
no guarantee (Barber et al. 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector

from ..models._model import Model
from ..models._validity import has_validity, tolerance_of
from ._scored_rows import Rows

LEVEL = 0.9
#: Records at least for a bound at 90 %: nine of ten are below the largest of nine and a tenth.
LEAST_RECORDS = 9
# Wider than this part of what was measured a bound says nothing that the range of the data does not.
_USEFUL = 0.5
# Of the range of the set-points: what is no further beyond it is not another motion.
_SLACK = 0.01
# What set membership promises is all of it; this much less is rounding and outliers [%].
_PROMISED = 99.0


def useful_parts(rows: Rows, lower: Matrix, upper: Matrix) -> tuple[Matrix, Matrix]:
    """Return the bounds (time, outputs), NaN where they are wider than the range of what was measured."""
    too_wide = ~(upper - lower <= _range(rows))
    return np.where(too_wide, np.nan, lower), np.where(too_wide, np.nan, upper)


def judged_bounds(
    rows: Rows, coverage: dict[str, float] | None, width: dict[str, float] | None, *, promised: bool
) -> tuple[dict[str, float | None] | None, list[str]]:
    """Return the mean widths without those that nobody can use, and what there is to say, one line each.

    Args:
        rows: those judged.
        coverage, width: of `coverage_tables`.
        promised: whether the bounds promise to hold all samples, as set membership does.
    """
    if coverage is None or width is None:
        return None, []
    unit = rows.robot.outputs.display_unit
    shown: dict[str, float | None] = dict(width)
    said = []
    for (name, wide), span in zip(width.items(), _range(rows), strict=True):
        range_ = rows.shown(float(span))
        if wide > range_:
            shown[name] = None
            said.append(
                f"no useful bound in {name}: it would be wider than all that was measured ({range_:.3g} {unit})"
            )
        elif wide > _USEFUL * range_:
            said.append(
                f"no useful bound in {name}: {wide:.3g} {unit} wide in the mean, more than half of what was measured "
                f"({range_:.3g} {unit})"
            )
        if promised and coverage[name] < _PROMISED:
            said.append(
                f"the bounds of {name} promise all samples and held {coverage[name]:.0f} %: their assumption (noise "
                "within epsilon, a slope of at most gamma) does not hold on these rows"
            )
    return shown, said


def calibrated_bounds(rows: Rows, errors: Matrix) -> dict[str, Any]:
    """Return half-widths at 90 % around a free run, from whole stretches, and what each held on stretches left out.

    `pointwise` is for any one sample of a further record of this kind, `path` for all of its samples at once.

    Args:
        rows: those judged.
        errors: (time, outputs) measured less free run; NaN where not judged.

    Returns:
        Level, number of records, the range of their set-points (`domain`, in SI) beyond which there is no bound, and
        for each of both axis -> half-width, what it held on records left out within the domain of the others, and how
        much of them lay beyond that (`outside_pct`); or the reason why there is none.
    """
    numbers = [number for number in range(int(rows.stretch[-1]) + 1)
               if np.isfinite(errors[rows.stretch == number]).all(axis=1).any()]  # fmt: skip
    records = [errors[rows.stretch == number] for number in numbers]
    motors = [rows.set_points[rows.stretch == number] for number in numbers]
    found: dict[str, Any] = {"level_pct": 100.0 * LEVEL, "records": len(records), "reason": None}
    if len(records) < LEAST_RECORDS:
        reason = f"{len(records)} record(s): bounds at {100 * LEVEL:g} % need {LEAST_RECORDS} that are exchangeable"
        return {**found, "reason": reason}
    found["domain"] = dict(zip(("min", "max"), (end.tolist() for end in _range_of(motors)), strict=True))
    inside = [_within(own, [*motors[:number], *motors[number + 1 :]]) for number, own in enumerate(motors)]
    reasons = []
    for what, half_width in (("pointwise", _pointwise), ("path", _path)):
        found[what] = {}
        for i, name in enumerate(rows.names):
            there = [np.isfinite(record[:, i]) for record in records]
            parts = [np.abs(record[seen, i]) for record, seen in zip(records, there, strict=True)]
            half = half_width(parts)
            if 2.0 * half > _USEFUL * float(_range(rows)[i]):
                reasons.append(f"no useful {what} bound in {name}: wider than half of what was measured")
                continue
            known = [near[seen] for near, seen in zip(inside, there, strict=True)]
            found[what][name] = {
                "half_width": rows.shown(half),
                "coverage_pct": _left_out(parts, known, half_width, what),
                "outside_pct": 100.0 * float(np.mean(~np.concatenate(known))),
            }
    return {**found, "reason": "; ".join(reasons) or None}


def _path(parts: Sequence[Vector]) -> float:
    """Return what the largest error of a further record stays below with 90 %."""
    largest = np.sort([part.max() for part in parts])
    rank = int(np.ceil(LEVEL * (len(parts) + 1) - 1e-9))
    return float(largest[rank - 1]) if rank <= len(parts) else float("inf")


def _pointwise(parts: Sequence[Vector]) -> float:
    """Return what one error of a further record stays below with 90 %: each record weighs alike, a further one too."""
    values = np.concatenate(parts)
    weights = np.concatenate([np.full(part.size, 1.0 / (part.size * (len(parts) + 1))) for part in parts])
    order = np.argsort(values)
    reached = np.flatnonzero(np.cumsum(weights[order]) >= LEVEL - 1e-9)
    return float(values[order][reached[0]]) if reached.size else float("inf")


def _left_out(parts: Sequence[Vector], known: Sequence[np.ndarray], half_width: Any, what: str) -> float | None:
    """Return what share [%] of each record, or of records as a whole, the bound of all the others holds.

    Only where there is one: `known` says which samples lie within their domain; a whole path takes all of them.
    """
    if len(parts) <= LEAST_RECORDS:
        return None
    held = []
    for number, (part, near) in enumerate(zip(parts, known, strict=True)):
        inside = part <= half_width([*parts[:number], *parts[number + 1 :]])
        if near.all() if what == "path" else near.any():
            held.append(inside[near].mean() if what == "pointwise" else inside.all())
    return 100.0 * float(np.mean(held)) if held else None


def _range_of(motors: Sequence[Matrix]) -> tuple[Vector, Vector]:
    """Return the least and the largest set-point of each motor (motors,) over records (time, motors)."""
    return np.min([own.min(axis=0) for own in motors], axis=0), np.max([own.max(axis=0) for own in motors], axis=0)


def _within(own: Matrix, others: Sequence[Matrix]) -> np.ndarray:
    """Return (time,) whether all set-points of a record lie within those of the others, but for a hundredth."""
    low, high = _range_of(others)
    slack = _SLACK * (high - low)
    return np.asarray(((own >= low - slack) & (own <= high + slack)).all(axis=1))


def _range(rows: Rows) -> Vector:
    """Return the range of what was measured (outputs,); NaN where nothing was."""
    return np.array([np.ptp(y[np.isfinite(y)]) if np.isfinite(y).any() else np.nan for y in rows.measured.T])


_BINS = 10


def judged_validity(model: Model, rows: Rows, free: Matrix) -> dict[str, Any] | None:
    """Return what the validity of a free run was, and how that compares with how often the error stayed within.

    The Brier score is the mean squared distance between the probability and what happened, 0 at best (Brier 1950);
    `brier_base_rate` is that of who knows how often these rows stay within the tolerance and nothing else.

    Args:
        model: whose free run it is.
        rows: those judged.
        free: (time, n_out) the free run with all outputs of the model.

    Returns:
        least, mean, held (share of the rows with all errors within the tolerance), brier, brier_base_rate, and
        reliability: predicted, held and rows for each tenth of the probability. None where the model has no validity
        or nothing is judged.
    """
    allowed = tolerance_of(model)
    if not has_validity(model) or allowed is None or free.shape[1] <= allowed.size:
        return None
    there = np.isfinite(rows.measured).all(axis=1) & np.isfinite(free[:, -1])
    if not there.any():
        return None
    predicted = free[there, -1]
    # An error that is no number is not within.
    held = np.asarray((np.abs(rows.measured - free[:, : allowed.size])[there] <= allowed).all(axis=1))
    share = float(held.mean())
    return {
        "least": float(predicted.min()),
        "mean": float(predicted.mean()),
        "held": share,
        "brier": float(np.mean((predicted - held) ** 2)),
        "brier_base_rate": share * (1.0 - share),
        "reliability": reliability(predicted, held),
    }


def reliability(predicted: np.ndarray, held: np.ndarray) -> list[dict[str, float]]:
    """Return for each tenth of the probability that occurs: its mean, how often that happened, and the rows."""
    bins = np.minimum((predicted * _BINS).astype(int), _BINS - 1)
    return [
        {
            "predicted": float(predicted[bins == b].mean()),
            "held": float(held[bins == b].mean()),
            "rows": int((bins == b).sum()),
        }
        for b in np.unique(bins)
    ]
