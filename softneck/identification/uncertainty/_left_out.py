"""Parts of a recording to leave out in turn, and what a kind misses on rows that it was not trained on."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, concatenate

from ..models._model import WARM_UP, Model

# What is left of a run is worth training on, or judging by, from here on [rows].
_LEAST = 3 * WARM_UP


def left_out(recording: Recording, parts: int) -> list[tuple[Recording, Recording]]:
    """Return (rest, part) for each part: whole runs where there are as many, else as many blocks of each run.

    What stands before and behind a block are runs of their own, never joined.
    """
    runs = recording.runs()
    if len(runs) >= parts:
        return [
            (concatenate([run for n, run in enumerate(runs) if n % parts != i]),
             concatenate([run for n, run in enumerate(runs) if n % parts == i]))
            for i in range(parts)
        ]  # fmt: skip
    return [_block(runs, i, parts) for i in range(parts)]


def _block(runs: Sequence[Recording], i: int, parts: int) -> tuple[Recording, Recording]:
    rest, part = [], []
    for run in runs:
        low, high = (round(len(run) * edge / parts) for edge in (i, i + 1))
        rest += [run.rows(a, b) for a, b in ((0, low), (high, len(run))) if b - a >= _LEAST]
        if high - low >= _LEAST:
            part.append(run.rows(low, high))
    # Too short to be cut: trained on and judged by all of it, as the kinds do themselves.
    return concatenate(rest or list(runs)), concatenate(part or list(runs))


def left_out_error(fit: Callable[[Recording], Model], parts: Sequence[tuple[Recording, Recording]]) -> Vector:
    """Return the rms error (outputs,) of free runs over parts that were left out in turn; inf where one diverges."""
    errors = np.concatenate([_missed(fit(rest), part) for rest, part in parts])
    return np.sqrt(np.nanmean(errors**2, axis=0))


def _missed(model: Model, recording: Recording) -> Matrix:
    """Return the errors (rows, outputs) of a free run, without the samples that set its initial state."""
    Y = model.simulate(recording)[:, : recording.outputs.shape[1]]
    errors = np.where(np.isfinite(Y), recording.outputs - Y, np.where(np.isfinite(recording.outputs), np.inf, np.nan))
    starts = np.concatenate([np.arange(len(run)) < WARM_UP for run in recording.runs()])
    return errors[~starts]
