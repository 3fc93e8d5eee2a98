"""Which rows are judged: stretches of rows that the model was not trained on, less those that set its start."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Vector, to_si
from softneck.robot import Robot
from softneck.runtime import Block, State
from softneck.signals import Recording

from ..models._fitting import known_rows
from ..models._model import WARM_UP, Model, _input_rows

# Far predictions cost `horizon` steps for each row, and neighbours err alike: so many steps are enough. 3,000 rows,
# the paper's validation, are all predicted 25 samples ahead; of 30,000 every tenth one, which is 0.2 s after the last.
_MOST_STEPS = 75_000


@dataclass(frozen=True, slots=True, eq=False)
class ScoredStretch:
    """Rows of one run that follow each other.

    Attributes:
        recording: those rows alone.
        scored: (time,) which of them are judged; never the first 25, a row that the model was trained on, or one
            where neither angle was measured.
        run: number of the run, as the recording counts.
    """

    recording: Recording
    scored: np.ndarray
    run: int


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The rows of all stretches, one stretch after the other.

    Attributes:
        time: (time,) [s].
        stretch: (time,) number of the stretch.
        since: (time,) samples since its start.
        measured: (time, 2) [rad]; NaN where missed or not scored.
        set_points: (time, 3) [rad].
        robot: whose rows they are; another than the neck has its own numbers of motors and outputs, in SI.
    """

    time: Vector
    stretch: np.ndarray
    since: np.ndarray
    measured: Matrix
    set_points: Matrix
    robot: Robot

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the outputs."""
        return self.robot.outputs.names

    def shown(self, value: float) -> float:
        """Return an error in the unit in which scores show it: a neck's degrees, else the robot's `display_unit`."""
        unit = self.robot.outputs.display_unit
        return float(np.degrees(value)) if unit == "deg" else value / to_si(unit)[0]

    def judged(self, horizon: int | None) -> Matrix:
        """Return `measured`, NaN as well where there are not `horizon` samples of past; None is the free run."""
        if horizon is None:
            return self.measured
        # A row with less past than the horizon was not predicted from that far back.
        past = self.since - horizon
        return np.where(((past >= 0) & (past % self.stride(horizon) == 0))[:, None], self.measured, np.nan)

    def stride(self, horizon: int) -> int:
        """Return n where only every n-th row is predicted `horizon` samples ahead: of more than 75,000 steps."""
        steps = int((self.since >= horizon).sum()) * horizon
        return 1 if horizon == 1 else max(-(-steps // _MOST_STEPS), 1)


def unseen_stretches(recording: Recording, hashes: np.ndarray) -> tuple[list[ScoredStretch], int]:
    """Return the stretches of rows whose hash is not in `hashes`, and how many rows were left out.

    Raises:
        DataError: nothing is left to judge.
    """
    stretches: list[ScoredStretch] = []
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
                stretches.append(ScoredStretch(part, mask, int(run.run[0])))
    if not stretches:
        raise DataError(f"nothing is left to judge: {_why(len(recording), left_out, longest)}")
    return stretches, left_out


def pooled(stretches: list[ScoredStretch]) -> Rows:
    """Return the rows of all stretches."""
    outputs = [np.where(s.scored[:, None], s.recording.outputs, np.nan) for s in stretches]
    return Rows(
        time=np.concatenate([s.recording.time for s in stretches]),
        stretch=np.repeat(np.arange(len(stretches)), [len(s.recording) for s in stretches]),
        since=np.concatenate([np.arange(len(s.recording)) for s in stretches]),
        measured=np.concatenate(outputs),
        set_points=np.concatenate([s.recording.set_points for s in stretches]),
        robot=stretches[0].recording.robot,
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
    """Return the borders of stretches between long parts that were seen; a few rows seen do not break one."""
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
            return _strided(block, states[number], rows, span, (horizon, stride))
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


def _strided(
    block: Block, state: State, rows: tuple[Matrix, Matrix], span: tuple[int, int], steps: tuple[int, int]
) -> Matrix:
    """Return what every `stride`-th row of `span` predicts for `horizon` samples later; NaN for the others."""
    horizon, stride = steps
    measured, free = rows
    predicted = np.full((span[1] - span[0], len(block.outputs)), np.nan)
    for k in range(span[0], min(span[1], len(free) - horizon), stride):
        ahead = np.vstack([measured[k : k + 1], free[k + 1 : k + horizon]])
        predicted[k - span[0]] = block.run(state, ahead)[1][-1]
        state, _ = block.run(state, measured[k : k + stride])
    return predicted
