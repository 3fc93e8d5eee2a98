"""Rows that are judged, the tables of scores of a `Validation`, and when a simulation predicts nothing any more.

Intervals are by moving blocks that wrap inside their run (Politis and Romano 1992, "A circular block-resampling
procedure"), for another experiment of this kind and length. On AR(1) errors and motions they held the true fit in 84 to
93 % of experiments (tests): with few correlation times in a record, read them as a lower bound of the doubt.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector, to_si
from softneck.robot import Robot, Scaling
from softneck.runtime import Block, State
from softneck.signals import Recording

from ..models._arrays import BOUNDED, trained_range
from ..models._fitting import known_rows
from ..models._model import WARM_UP, Model, _input_rows
from ..models._scores import nrmse_fit, r_squared, rmse, worst_error
from ..set_membership._set_membership import can_detect_extrapolation, is_extrapolating

# Far predictions cost `horizon` steps for each row, and neighbours err alike: so many steps are enough. 3,000 rows,
# the paper's validation, are all predicted 25 samples ahead; of 30,000 every tenth one, which is 0.2 s after the last.
_MOST_STEPS = 75_000


@dataclass(frozen=True, slots=True, eq=False)
class ScoredSegment:
    """Rows of one run that follow each other.

    scored: (time,) which are judged: never the first 25, rows trained on, or those where neither angle was measured.
    """

    recording: Recording
    scored: np.ndarray
    run: int


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The rows of all segments, one segment after the other.

    time: (time,) [s]; segment: (time,) its number; since: (time,) samples since its start; measured: (time, 2) [rad],
    NaN where missed or not scored; set_points: (time, 3) [rad]; another robot than the neck: its own numbers, in SI.
    """

    time: Vector
    segment: np.ndarray
    since: np.ndarray
    measured: Matrix
    set_points: Matrix
    robot: Robot

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the outputs."""
        return self.robot.outputs.names

    def to_display_unit(self, value: float) -> float:
        """Return an error in the unit in which scores show it: a neck's degrees, else the robot's `display_unit`."""
        unit = self.robot.outputs.display_unit
        return float(np.degrees(value)) if unit == "deg" else value / to_si(unit)[0]

    def outputs_at(self, horizon: int | None) -> Matrix:
        """Return `measured`, NaN as well where there are not `horizon` samples of past; None is the simulation."""
        if horizon is None:
            return self.measured
        # A row with less past than the horizon was not predicted from that far back.
        past = self.since - horizon
        return np.where(((past >= 0) & (past % self.stride(horizon) == 0))[:, None], self.measured, np.nan)

    def stride(self, horizon: int) -> int:
        """Return n where only every n-th row is predicted `horizon` samples ahead: of more than 75,000 steps."""
        steps = int((self.since >= horizon).sum()) * horizon
        return 1 if horizon == 1 else max(-(-steps // _MOST_STEPS), 1)


def unseen_segments(recording: Recording, hashes: np.ndarray) -> tuple[list[ScoredSegment], int]:
    """Return the segments of rows whose hash is not in `hashes`, and how many were left out; DataError if all were."""
    segments: list[ScoredSegment] = []
    left_out = longest = 0
    for run in recording.runs():
        seen = known_rows(run, hashes) if hashes.size else np.zeros(len(run), dtype=bool)
        left_out += int(seen.sum())
        longest = max(longest, len(run))
        for start, stop in _unseen(seen):
            mask = ~seen[start:stop]
            mask[:WARM_UP] = False
            part = run.rows(start, stop)
            mask &= np.isfinite(part.outputs).any(axis=1)
            if mask.any():
                segments.append(ScoredSegment(part, mask, int(run.run[0])))
    if not segments:
        raise DataError(f"nothing is left to judge: {_why(len(recording), left_out, longest)}")
    return segments, left_out


def join_segments(segments: list[ScoredSegment]) -> Rows:
    """Return the rows of all segments."""
    outputs = [np.where(s.scored[:, None], s.recording.outputs, np.nan) for s in segments]
    return Rows(
        time=np.concatenate([s.recording.time for s in segments]),
        segment=np.repeat(np.arange(len(segments)), [len(s.recording) for s in segments]),
        since=np.concatenate([np.arange(len(s.recording)) for s in segments]),
        measured=np.concatenate(outputs),
        set_points=np.concatenate([s.recording.set_points for s in segments]),
        robot=segments[0].recording.robot,
    )


def _why(rows: int, left_out: int, longest: int) -> str:
    if longest <= WARM_UP:
        return (
            f"{longest} rows are too few, as the first {WARM_UP} of each run set the initial state and are not "
            "scored; record longer runs."
        )
    if left_out == rows:
        return f"all {left_out} rows were used to train the model; use another recording or --include-training."
    return (
        f"{left_out} of {rows} rows were used to train the model and no {WARM_UP + 1} others follow each other; "
        "use another recording or --include-training."
    )


def _unseen(seen: np.ndarray) -> list[tuple[int, int]]:
    """Return the borders of segments between long training parts; a few training rows do not split a segment."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
    long = [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a > WARM_UP]
    starts = [0, *(b for _, b in long)]
    stops = [*(a for a, _ in long), seen.size]
    return [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > WARM_UP]


# Below this many steps a second thread costs more than it saves.
_WORTH_A_THREAD = 50_000


def predict(model: Model, recordings: Sequence[Recording], horizon: int, *, motors: str, stride: int = 1) -> Matrix:
    """Return `model.predict(recording, horizon)` of each recording, one after the other.

    Far predictions cost `horizon` steps for each row. Every row is predicted apart from the others, so the rows of a
    run are shared out in parts, each from the state that the measured rows before it lead to. Where `stride` is above
    1, only the rows `horizon + n stride` of each run are predicted and the others are NaN.
    """
    runs = [run for recording in recordings for run in recording.runs()]
    return np.concatenate([_predict(model, run, horizon, motors, stride) for run in runs])


def _predict(model: Model, run: Recording, horizon: int, motors: str, stride: int) -> Matrix:
    workers = os.cpu_count() or 1
    if stride == 1 and (horizon == 1 or workers == 1 or len(run) * horizon < _WORTH_A_THREAD):
        return model.predict(run, horizon, motors=motors)
    block, start = model.block(), model.initial_state(run)
    rows = (_input_rows(run, "measured"), _input_rows(run, motors, outputs=False))
    # Whole strides in each part.
    borders = (np.linspace(0, len(run) // stride, workers + 1).astype(int) * stride).tolist()
    borders[-1] = len(run)
    states = [start]
    for begin, end in itertools.pairwise(borders[:-1]):
        states.append(block.run(states[-1], rows[0][begin:end])[0])
    # The first call compiles; two threads compiling the same function would do it twice.
    block.run_horizon(start, rows[0][:1], rows[1][:1], horizon)

    def part(number: int) -> Matrix:
        span = (borders[number], borders[number + 1])
        if stride > 1:
            return _predict_with_stride(block, states[number], rows, span, (horizon, stride))
        return _part(block, states[number], rows, span, horizon)

    with ThreadPoolExecutor(workers) as pool:
        predicted = np.concatenate(list(pool.map(part, range(workers))))
    if stride > 1:
        # Row k of it was predicted from row k.
        return np.vstack([np.full((horizon, predicted.shape[1]), np.nan), predicted])[: len(run)]
    return np.vstack([start.outputs, predicted[: len(run) - 1]])


def _part(block: Block, state: State, rows: tuple[Matrix, Matrix], span: tuple[int, int], horizon: int) -> Matrix:
    """Return the predictions made from rows `span`; the first part has those with too little past as well."""
    begin, end = span
    reach = slice(begin, end + horizon - 1)
    predicted = block.run_horizon(state, rows[0][reach], rows[1][reach], horizon)
    return predicted if begin == 0 else predicted[horizon - 1 :]


def _predict_with_stride(
    block: Block, state: State, rows: tuple[Matrix, Matrix], span: tuple[int, int], steps: tuple[int, int]
) -> Matrix:
    """Predict `horizon` samples ahead from every `stride`-th row of `span`; NaN for the others."""
    horizon, stride = steps
    measured, free = rows
    predicted = np.full((span[1] - span[0], len(block.outputs)), np.nan)
    for k in range(span[0], min(span[1], len(free) - horizon), stride):
        ahead = np.vstack([measured[k : k + 1], free[k + 1 : k + horizon]])
        predicted[k - span[0]] = block.run(state, ahead)[1][-1]
        state, _ = block.run(state, measured[k : k + stride])
    return predicted


RESAMPLES = 1000
# Blocks are at least so many time constants long, 1 s of the neck, ...
_LEAST_TIME_CONSTANTS = 5.0
# ... and so many correlation times, so that what joins two blocks is little of each (5 and 8 covered no better); ...
_BLOCK_CORRELATION_TIMES = 3.0
# ... but fewer blocks than this say nothing about how blocks differ.
_FEWEST_BLOCKS = 8


def fit_intervals(
    measured: list[Matrix], predicted: list[Matrix], segment: np.ndarray, time_constant: float
) -> list[list[list[float] | None]]:
    """Return for each prediction and axis the 95 % interval [low, high] of its fit [%].

    None where nothing is measured or moves, or the rows are fewer than eight blocks of five time constants [samples].
    Measured and predicted: (time, 2) for each horizon, NaN where not judged; `segment` (time,) is sorted.
    """
    from scipy.sparse import csr_array

    errors = [y - yhat for y, yhat in zip(measured, predicted, strict=True)]
    length = block_length(np.column_stack([*errors, measured[0]]), segment, time_constant)
    if length is None:
        return [[None] * measured[0].shape[1] for _ in measured]
    table = np.column_stack([_terms(y, e) for y, e in zip(measured, errors, strict=True)])
    sums = _block_sums(table, segment, length)
    if not len(sums):  # no error is a number: the predictions are beyond all bounds
        return [[None] * measured[0].shape[1] for _ in measured]
    axes = measured[0].shape[1]
    # The same blocks for every horizon and axis, and the same every time.
    drawn = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, -(-len(sums) // length)))
    picks = csr_array((np.ones(drawn.size), drawn.ravel(), np.arange(RESAMPLES + 1) * drawn.shape[1]),
                      shape=(RESAMPLES, len(sums)))  # fmt: skip
    totals = (picks @ sums).reshape(RESAMPLES, len(measured), axes, 4)
    return [[_interval(totals[:, h, axis]) for axis in range(axes)] for h in range(len(measured))]


def block_length(signals: Matrix, segment: np.ndarray, time_constant: float) -> int | None:
    """Return the samples of a block: three correlation times of the slowest of the signals (time, n).

    The correlation time is the first lag at which the autocorrelation is below 1/e. At least five time constants
    [samples] and never more than an eighth of the rows; None where both cannot be.
    """
    rows = len(signals)
    least, most = round(_LEAST_TIME_CONSTANTS * time_constant), rows // _FEWEST_BLOCKS
    if most < max(least, 1):
        return None
    slowest = max(_correlation_time(e, segment, most) for e in signals.T)
    return int(min(max(_BLOCK_CORRELATION_TIMES * slowest, least, 1), most))


def _correlation_time(signal: Vector, segment: np.ndarray, most: int) -> int:
    there = np.isfinite(signal)
    if not there.any():
        return 0
    # Rows between those that are judged hold what is around them.
    e = np.interp(np.arange(signal.size), np.flatnonzero(there), signal[there] - signal[there].mean())
    covariance = np.zeros(most + 1)
    for part in np.split(e, np.flatnonzero(np.diff(segment)) + 1):
        spectrum = np.abs(np.fft.rfft(part, 2 * part.size)) ** 2
        c = np.fft.irfft(spectrum)[: min(part.size, most + 1)]
        covariance[: c.size] += c
    below = covariance < covariance[0] / np.e
    return int(np.argmax(below)) if below.any() else most


def _terms(measured: Matrix, errors: Matrix) -> Matrix:
    """Return the terms of a fit per row: 1, y, y^2 and e^2 of each axis (time, 8); 0 for rows not scored."""
    columns = []
    for y, e in zip(measured.T, errors.T, strict=True):
        # A prediction that is no number leaves no interval, as it leaves no fit.
        there = np.isfinite(y)
        z = np.where(there, y - (y[there].mean() if there.any() else 0.0), 0.0)
        columns += [there.astype(float), z, z**2, np.where(there, np.where(np.isfinite(e), e, np.nan), 0.0) ** 2]
    return np.column_stack(columns)


def _block_sums(table: Matrix, segment: np.ndarray, length: int) -> Matrix:
    """Return the sums over the block that starts at each row (rows, n), of the segments with anything judged."""
    parts = []
    for part in np.split(table, np.flatnonzero(np.diff(segment)) + 1):
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
    ones) from its middle, a bent angle further than half a turn from zero, or no finite number.
    """
    unit = Scaling.of(rows.robot, set_points=None, outputs=rows.measured).output_unit
    middle, width = _range(rows.measured / unit)
    inside = (np.abs(simulated / unit - middle) <= RANGES * width) & (np.abs(simulated) < rows.robot.angle_limit)
    gone = ~inside.all(axis=1)
    first = [np.flatnonzero(gone & (rows.segment == number)) for number in range(int(rows.segment[-1]) + 1)]
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
_RANGE_TOLERANCE = 1e-6

#: The name of the simulation among the horizons of a validation.
INFINITE = "inf"


def score_tables(
    rows: Rows, time: Vector, measured: dict[str, Matrix], predicted: dict[str, Matrix], *, lost: bool
) -> dict[str, Any]:
    """Return the tables of scores by their names in `Validation`; a lost (diverged) simulation has none.

    `measured` and `predicted`: horizon -> (time, outputs).
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
            tables["rmse_deg"][h][axis] = _number(rows.to_display_unit(rmse(*pair)))
            tables["r2"][h][axis] = _number(r_squared(*pair))
            tables["worst_deg"][h][axis] = _number(rows.to_display_unit(worst))
            tables["worst_time"][h][axis] = float(time[row]) if row >= 0 else None
    return tables


def run_tables(
    segments: Sequence[ScoredSegment],
    rows_of_all: Rows,
    measured: dict[str, Matrix],
    predicted: dict[str, Matrix],
    lost: list[float | None],
) -> list[dict[str, Any]]:
    """Return the score tables of each segment, with its number, run and start."""
    entries = []
    for number, segment in enumerate(segments):
        rows = rows_of_all.segment == number
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
                "run": segment.run,
                "start_s": float(segment.recording.time[0]),
                "rows_scored": int(segment.scored.sum()),
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
        found = fit_intervals([measured[h] for h in kept], [predicted[h] for h in kept], rows.segment, time_constant)
        result |= {h: dict(zip(rows.names, pair, strict=True)) for h, pair in zip(kept, found, strict=True)}
    return result


def free_run_bounds(kind: str, free: Matrix, robot: Robot) -> tuple[Matrix, Matrix]:
    """Return the lower and upper bounds (time, outputs) among a model's outputs; NaN where its kind has none.

    Bounds of set membership follow the outputs and motors, lower and upper of one output after the other.
    """
    outputs = len(robot.outputs.names)
    if kind not in BOUNDED or free.shape[1] == outputs:  # that many where there is no simulation
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
    widths = [rows.to_display_unit(value) for value in width]
    return dict(zip(rows.names, coverage.tolist(), strict=True)), dict(zip(rows.names, widths, strict=True))


def outside_table(model: Model, rows: Rows, free: Matrix) -> dict[str, float] | None:
    """Return the share of measured samples [%] outside the training range; None if it is unknown.

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
        slack = _RANGE_TOLERANCE * (most - least)
        beyond = (rows.set_points < least - slack) | (rows.set_points > most + slack)
        flagged = np.repeat(beyond.any(axis=1, keepdims=True), there.shape[1], axis=1)
    share = 100.0 * (flagged & there).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return dict(zip(model.robot.outputs.names, share.tolist(), strict=True))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
