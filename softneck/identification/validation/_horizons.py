"""Predictions at several horizons of long stretches, on all cores: the same numbers as `Model.predict`."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from softneck.core import Matrix
from softneck.runtime import Block, State
from softneck.signals import Recording

from ..models._model import Model, _input_rows

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
