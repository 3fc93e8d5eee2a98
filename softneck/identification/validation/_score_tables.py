"""The tables of scores that a `Validation` holds; and when a free run predicts nothing any more."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot

from ..models._model import Model
from ..models._ports import BOUNDED, trained_range
from ..models._scores import nrmse_fit, r_squared, rmse, worst_error
from ..set_membership._set_membership import knows_what_it_saw, outside_seen
from ._bootstrap import fit_intervals
from ._scored_rows import Rows, ScoredStretch

# Three ranges from the middle is six amplitudes: no gain that is wrong by a factor of two gets there.
RANGES = 3.0
# Where the neck hardly moved, noise is all there is to compare with; within 15 deg no model has run away.
_LEAST_RANGE = np.radians(5.0)


def divergence(
    time: Vector, stretch: np.ndarray, free_run: Matrix, measured: Matrix, *, neck: bool = True
) -> list[float | None]:
    """Return for each stretch the time [s] at which its free run left the data's range, or None.

    Left is: further than three times the measured range (the larger of the two axes', at least 5 deg) from its
    middle, further than half a turn from zero, or no finite number.

    Args:
        time: (time,) [s].
        stretch: (time,) number of the stretch.
        free_run: (time, 2) [rad].
        measured: (time, 2) [rad]; NaN where missed or not scored.
        neck: whether these are angles; of other robots any number of outputs in any unit, with neither 5 deg nor turns.
    """
    middle, reach = _range(measured, _LEAST_RANGE if neck else 0.0)
    inside = (np.abs(free_run - middle) <= RANGES * reach) & (np.abs(free_run) < (np.pi if neck else np.inf))
    gone = ~inside.all(axis=1)
    first = [np.flatnonzero(gone & (stretch == number)) for number in range(int(stretch[-1]) + 1)]
    return [float(time[rows[0]]) if rows.size else None for rows in first]


def _range(measured: Matrix, least: float) -> tuple[Vector, float]:
    middle, widths = np.zeros(measured.shape[1]), [least]
    for axis, y in enumerate(measured.T):
        there = y[np.isfinite(y)]
        if there.size:
            middle[axis] = 0.5 * (there.min() + there.max())
            widths.append(float(np.ptp(there)))
    return middle, float(max(widths))


# A set-point so much of the trained range beyond it [1] is the same to any model, and to the rounding of a file.
_BEYOND = 1e-6
# Blocks over which the spread of a fit is shown: eight say how they differ, and 2 s are ten time constants of a neck.
_MOST_BLOCKS, _LEAST_BLOCK = 8, 100

#: The name of the free run among the horizons of a validation.
INFINITE = "inf"


def score_tables(
    rows: Rows, time: Vector, measured: dict[str, Matrix], predicted: dict[str, Matrix], *, lost: bool
) -> dict[str, Any]:
    """Return the tables of scores by their names in `Validation`; a lost free run has none.

    Args:
        rows: whose outputs these are.
        time: (time,) [s].
        measured, predicted: horizon -> (time, outputs).
        lost: whether the free run diverged.
    """
    tables: dict[str, Any] = {name: {} for name in ("fits", "rmse_deg", "r2", "worst_deg", "worst_time")}
    for h, y in measured.items():
        for table in tables.values():
            table[h] = dict.fromkeys(rows.names)
        if lost and h == INFINITE:
            continue
        for i, axis in enumerate(rows.names):
            pair = (y[:, i], predicted[h][:, i])
            worst, row = worst_error(*pair)
            tables["fits"][h][axis] = _number(nrmse_fit(*pair))
            tables["rmse_deg"][h][axis] = _number(rows.shown(rmse(*pair)))
            tables["r2"][h][axis] = _number(r_squared(*pair))
            tables["worst_deg"][h][axis] = _number(rows.shown(worst))
            tables["worst_time"][h][axis] = float(time[row]) if row >= 0 else None
    return tables


def run_tables(
    stretches: Sequence[ScoredStretch],
    rows_of_all: Rows,
    measured: dict[str, Matrix],
    predicted: dict[str, Matrix],
    lost: list[float | None],
) -> list[dict[str, Any]]:
    """Return the same tables for each stretch by itself, beside what tells it apart."""
    entries = []
    for number, stretch in enumerate(stretches):
        rows = rows_of_all.stretch == number
        scores = score_tables(
            rows_of_all,
            rows_of_all.time[rows],
            {h: y[rows] for h, y in measured.items()},
            {h: y[rows] for h, y in predicted.items()},
            lost=lost[number] is not None,
        )
        scores["worst_time_s"] = scores.pop("worst_time")
        entries.append(
            {
                "stretch": number,
                "run": stretch.run,
                "start_s": float(stretch.recording.time[0]),
                "rows_scored": int(stretch.scored.sum()),
                "diverged": lost[number],
                **scores,
            }
        )
    return entries


def spread_tables(rows: Rows, free: Matrix, parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return between which fits [%] the free run lies: over the stretches judged, and over blocks of equal length.

    A block's error is compared with the motion of all rows, as one that stands still has none of its own.

    Args:
        rows: those judged.
        free: (time, outputs) the free run.
        parts: of `run_tables`.
    """
    runs = {axis: [part["fits"][INFINITE][axis] for part in parts] for axis in rows.names}
    squares = (rows.measured - free) ** 2
    there = np.flatnonzero(np.isfinite(squares).any(axis=1))
    blocks = (
        np.array_split(there, min(_MOST_BLOCKS, there.size // _LEAST_BLOCK)) if there.size >= 2 * _LEAST_BLOCK else []
    )
    spread = [float(np.nanstd(y)) if np.isfinite(y).any() else 0.0 for y in rows.measured.T]
    found = {
        axis: [
            100.0 * (1.0 - float(np.sqrt(np.nanmean(squares[block, i]))) / spread[i])
            for block in blocks
            if spread[i] > 0.0 and np.isfinite(squares[block, i]).any()
        ]
        for i, axis in enumerate(rows.names)
    }
    return {
        "runs": {axis: _ends(fits) for axis, fits in runs.items()},
        "blocks": {axis: _ends(fits) for axis, fits in found.items()},
    }


def _ends(fits: Sequence[float | None]) -> list[float] | None:
    """Return the least and the largest; None of fewer than two, or where one diverged."""
    known = [fit for fit in fits if fit is not None]
    return [min(known), max(known)] if len(known) == len(fits) > 1 else None


def interval_tables(
    rows: Rows, measured: dict[str, Matrix], predicted: dict[str, Matrix], sample_time: float, *, lost: bool
) -> dict[str, dict[str, list[float] | None]]:
    """Return the bootstrap's interval of each fit."""
    result: dict[str, dict[str, list[float] | None]] = {h: dict.fromkeys(rows.names) for h in measured}
    kept = [h for h in measured if not (lost and h == INFINITE)]
    if kept:
        found = fit_intervals([measured[h] for h in kept], [predicted[h] for h in kept], rows.stretch, sample_time)
        result |= {h: dict(zip(rows.names, pair, strict=True)) for h, pair in zip(kept, found, strict=True)}
    return result


def free_run_bounds(kind: str, free: Matrix, robot: Robot) -> tuple[Matrix, Matrix]:
    """Return the lower and upper bounds (time, outputs) among a model's outputs; NaN where its kind has none.

    Bounds of set membership follow the outputs and motors, lower and upper of one output after the other.
    """
    outputs = len(robot.outputs.names)
    if kind not in BOUNDED or free.shape[1] == outputs:  # that many where there is no free run
        nothing = np.full((len(free), outputs), np.nan)
        return nothing, nothing
    bounds = free[:, outputs + len(robot.motors.names) :][:, : 2 * outputs]
    return bounds[:, ::2], bounds[:, 1::2]


def coverage_tables(
    rows: Rows, measured: Matrix, lower: Matrix, upper: Matrix
) -> tuple[dict[str, float] | None, dict[str, float] | None]:
    """Return how many measured samples lie within the bounds [%], and how wide these are [deg]."""
    there = np.isfinite(measured) & np.isfinite(lower) & np.isfinite(upper)
    if not there.any():
        return None, None
    inside = (measured >= lower) & (measured <= upper) & there
    count = np.maximum(there.sum(axis=0), 1)
    width = np.where(there, upper - lower, 0.0).sum(axis=0) / count
    coverage = 100.0 * inside.sum(axis=0) / count
    widths = [rows.shown(value) for value in width]
    return dict(zip(rows.names, coverage.tolist(), strict=True)), dict(zip(rows.names, widths, strict=True))


def outside_table(model: Model, rows: Rows, free: Matrix) -> dict[str, float] | None:
    """Return how many measured samples [%] lie outside what a model has seen; None where it does not know.

    Set membership says so by its bounds; of any other kind those count whose set-points were not trained on.
    """
    lower, upper = free_run_bounds(model.kind, free, model.robot)
    there = np.isfinite(rows.measured)
    if knows_what_it_saw(model) and (there & np.isfinite(lower) & np.isfinite(upper)).any():
        there &= np.isfinite(lower) & np.isfinite(upper)
        flagged = outside_seen(model, free)
    else:
        trained = trained_range(model.findings)
        if trained is None or not there.any():
            return None
        least, most = trained
        slack = _BEYOND * (most - least)
        beyond = (rows.set_points < least - slack) | (rows.set_points > most + slack)
        flagged = np.repeat(beyond.any(axis=1, keepdims=True), there.shape[1], axis=1)
    share = 100.0 * (flagged & there).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return dict(zip(model.robot.outputs.names, share.tolist(), strict=True))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
