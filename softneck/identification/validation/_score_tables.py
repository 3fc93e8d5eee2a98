"""The tables of scores that a `Validation` holds; and when a free run predicts nothing any more.

How sure a fit is: bootstrap over blocks of rows, as errors and motions of a neck last many samples.

The interval is for another experiment of this kind and length. On AR(1) errors and motions it held the true fit in 84
to 93 % of experiments (tests): with few correlation times in a record, read it as a lower bound of the doubt.

Moving blocks that wrap inside their run (Politis and Romano 1992, "A circular block-resampling procedure"): every row
is drawn equally often and no block joins two runs. A fit needs only sums over rows, so blocks are drawn as sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector, to_si
from softneck.robot import Robot, Scaling

from ..models._arrays import BOUNDED, trained_range
from ..models._model import Model
from ..models._scores import nrmse_fit, r_squared, rmse, worst_error
from ..set_membership._set_membership import can_detect_extrapolation, is_extrapolating
from ._scored_rows import Rows, ScoredStretch

RESAMPLES = 1000
# Blocks are at least so many time constants long, 1 s of the neck, ...
_LEAST_TIME_CONSTANTS = 5.0
# ... and so many correlation times, so that what joins two blocks is little of each (5 and 8 covered no better); ...
_TIMES = 3.0
# ... but fewer blocks than this say nothing about how blocks differ.
_FEWEST_BLOCKS = 8


def fit_intervals(
    measured: list[Matrix], predicted: list[Matrix], stretch: np.ndarray, time_constant: float
) -> list[list[list[float] | None]]:
    """Return for each prediction and axis the 95 % interval [low, high] of its fit [%].

    None where nothing is measured or moves, or the rows are fewer than eight blocks of five time constants.

    Args:
        measured, predicted: one pair of (time, 2) for each horizon; NaN in `measured` where not judged.
        stretch: (time,) number of the stretch of rows; sorted.
        time_constant: [samples]; 0 where the robot gives none.
    """
    from scipy.sparse import csr_array

    errors = [y - yhat for y, yhat in zip(measured, predicted, strict=True)]
    length = block_length(np.column_stack([*errors, measured[0]]), stretch, time_constant)
    if length is None:
        return [[None] * measured[0].shape[1] for _ in measured]
    table = np.column_stack([_terms(y, e) for y, e in zip(measured, errors, strict=True)])
    sums = _block_sums(table, stretch, length)
    if not len(sums):  # no error is a number: the predictions are beyond all bounds
        return [[None] * measured[0].shape[1] for _ in measured]
    axes = measured[0].shape[1]
    # The same blocks for every horizon and axis, and the same every time.
    drawn = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, -(-len(sums) // length)))
    picks = csr_array((np.ones(drawn.size), drawn.ravel(), np.arange(RESAMPLES + 1) * drawn.shape[1]),
                      shape=(RESAMPLES, len(sums)))  # fmt: skip
    totals = (picks @ sums).reshape(RESAMPLES, len(measured), axes, 4)
    return [[_interval(totals[:, h, axis]) for axis in range(axes)] for h in range(len(measured))]


def block_length(signals: Matrix, stretch: np.ndarray, time_constant: float) -> int | None:
    """Return the samples of a block: three correlation times of the slowest of the signals (time, n).

    The correlation time is the first lag at which the autocorrelation is below 1/e. At least five time constants
    [samples] and never more than an eighth of the rows; None where both cannot be.
    """
    rows = len(signals)
    least, most = round(_LEAST_TIME_CONSTANTS * time_constant), rows // _FEWEST_BLOCKS
    if most < max(least, 1):
        return None
    slowest = max(_correlation_time(e, stretch, most) for e in signals.T)
    return int(min(max(_TIMES * slowest, least, 1), most))


def _correlation_time(signal: Vector, stretch: np.ndarray, most: int) -> int:
    there = np.isfinite(signal)
    if not there.any():
        return 0
    # Rows between those that are judged hold what is around them.
    e = np.interp(np.arange(signal.size), np.flatnonzero(there), signal[there] - signal[there].mean())
    covariance = np.zeros(most + 1)
    for part in np.split(e, np.flatnonzero(np.diff(stretch)) + 1):
        spectrum = np.abs(np.fft.rfft(part, 2 * part.size)) ** 2
        c = np.fft.irfft(spectrum)[: min(part.size, most + 1)]
        covariance[: c.size] += c
    below = covariance < covariance[0] / np.e
    return int(np.argmax(below)) if below.any() else most


def _terms(measured: Matrix, errors: Matrix) -> Matrix:
    """Return what a fit is made of, per row: 1, y, y^2 and e^2 of each axis (time, 8); 0 where not judged."""
    columns = []
    for y, e in zip(measured.T, errors.T, strict=True):
        there = np.isfinite(y) & np.isfinite(e)
        z = np.where(there, y - (y[there].mean() if there.any() else 0.0), 0.0)
        columns += [there.astype(float), z, z**2, np.where(there, e, 0.0) ** 2]
    return np.column_stack(columns)


def _block_sums(table: Matrix, stretch: np.ndarray, length: int) -> Matrix:
    """Return the sums over the block that starts at each row (rows, n), of the stretches with anything judged."""
    parts = []
    for part in np.split(table, np.flatnonzero(np.diff(stretch)) + 1):
        # Rows at its ends that no horizon judges (the warm-up) belong to no block.
        judged = np.flatnonzero((part != 0.0).any(axis=1))
        if not judged.size:
            continue
        rows = part[judged[0] : judged[-1] + 1]
        wrapped = np.resize(rows, (len(rows) + length - 1, rows.shape[1]))
        total = np.vstack([np.zeros(rows.shape[1]), np.cumsum(wrapped, axis=0)])
        parts.append(total[length:] - total[:-length])
    return np.concatenate([np.zeros((0, table.shape[1])), *parts])


def _interval(totals: Matrix) -> list[float] | None:
    count, first, second, error = totals.T
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = second - first**2 / count
        fits = 100.0 * (1.0 - np.sqrt(error / spread))
    # A sum of squares about its own mean: less than this is rounding of a signal that does not move.
    if not np.isfinite(fits).all() or (spread <= 1e-12 * second).any():
        return None
    return [float(value) for value in np.quantile(fits, (0.025, 0.975))]


# Three ranges from the middle is six amplitudes: no gain that is wrong by a factor of two gets there.
RANGES = 3.0
# Where scaled outputs hardly moved, noise is all there is to compare with; within 15 deg no model has run away.
_LEAST_RANGE = np.radians(5.0)


def divergence(rows: Rows, simulated: Matrix) -> list[float | None]:
    """Return for each segment the time [s] at which its simulation (time, outputs) left the data's range, or None.

    Left is: further than three times the measured range (the largest of the outputs', at least 5 deg of the scaled
    ones) from its middle, an angle further than half a turn from zero, or no finite number.
    """
    unit = Scaling.of(rows.robot, set_points=None, outputs=rows.measured).output_unit
    middle, width = _range(rows.measured / unit)
    turn = np.pi if to_si(rows.robot.outputs.unit)[1] == "rad" else np.inf
    inside = (np.abs(simulated / unit - middle) <= RANGES * width) & (np.abs(simulated) < turn)
    gone = ~inside.all(axis=1)
    first = [np.flatnonzero(gone & (rows.stretch == number)) for number in range(int(rows.stretch[-1]) + 1)]
    return [float(rows.time[found[0]]) if found.size else None for found in first]


def _range(measured: Matrix) -> tuple[Vector, float]:
    middle, widths = np.zeros(measured.shape[1]), [_LEAST_RANGE]
    for axis, y in enumerate(measured.T):
        there = y[np.isfinite(y)]
        if there.size:
            middle[axis] = 0.5 * (there.min() + there.max())
            widths.append(float(np.ptp(there)))
    return middle, float(max(widths))


# A set-point so much of the trained range beyond it [1] is the same to any model, and to the rounding of a file.
_BEYOND = 1e-6

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


def interval_tables(
    rows: Rows, measured: dict[str, Matrix], predicted: dict[str, Matrix], sample_time: float, *, lost: bool
) -> dict[str, dict[str, list[float] | None]]:
    """Return the bootstrap's interval of each fit."""
    result: dict[str, dict[str, list[float] | None]] = {h: dict.fromkeys(rows.names) for h in measured}
    kept = [h for h in measured if not (lost and h == INFINITE)]
    if kept:
        time_constant = (rows.robot.time_constant_s or 0.0) / sample_time
        found = fit_intervals([measured[h] for h in kept], [predicted[h] for h in kept], rows.stretch, time_constant)
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
    if can_detect_extrapolation(model) and (there & np.isfinite(lower) & np.isfinite(upper)).any():
        there &= np.isfinite(lower) & np.isfinite(upper)
        flagged = is_extrapolating(model, free)
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
