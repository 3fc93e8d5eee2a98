"""A model that follows a neck that changed: a warm refit on the latest data, held to the old model elsewhere.

Strength and blocks are chosen on necks that were left out: `benchmarks/adaptation.py choose`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector, require_positive
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording, concatenate

from ..models._fitting import row_hashes
from ..models._model import WARM_UP, Model
from ..models._ports import trained_set_points
from ..models._scores import nrmse_fit
from ..models._validity import doubted
from ._free import Free, require_adapting
from ._problem import Problem, free_run, information, reference, scored

#: The latest data that are looked at [s].
WINDOW = 30.0
# Weight of a change along the reference beside an error over the window.
_STRENGTH = 0.1
# Held out: the last of every so many blocks, so long [s]; between them the window is learnt from.
_EVERY, _BLOCK = 3, 2.0
# Set-points that move less than this part of what they do along the reference teach nothing.
_LEAST_MOTION = 0.1
# Fewer entries of an output than this on either side decide nothing.
_LEAST_ROWS = 50
# Parts of the way that are tried until no output is worse.
_PARTS = (1.0, 0.5, 0.25)
# Rows of the window that a set's bounds are to hold.
_COVERED = 0.99


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What became of an adaptation.

    Attributes:
        adapted: whether anything changed.
        why: the old model was kept; "" where not.
        seconds: of the window.
        rows: held out.
        before, after: fit [%] of the free run on them, of each output.
        part: of the way that was gone.
    """

    adapted: bool
    why: str
    seconds: float
    rows: int = 0
    before: tuple[float, ...] = ()
    after: tuple[float, ...] = ()
    part: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return what findings and JSON say."""
        return {
            "adapted": self.adapted, "why": self.why, "window_s": self.seconds, "rows_held_out": self.rows,
            "fit_before": list(self.before), "fit_after": list(self.after), "part": self.part,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Adaptation:
    """How a model is adapted.

    Attributes:
        window: latest seconds of the recording that are looked at [s].
        strength: weight of a change of the old free run along its reference motion beside an error over the window.
        block: length of a block [s], of which every third is held out.
    """

    window: float = WINDOW
    strength: float = _STRENGTH
    block: float = _BLOCK

    def __post_init__(self) -> None:
        require_positive("window", self.window, "s")
        require_positive("strength", self.strength)
        require_positive("block", self.block, "s")

    @one_blas_thread
    def of(self, model: Model, recording: Recording) -> Model:
        """Return the adapted model, or the old one where that is no worse; findings say which, under `adaptation`.

        Raises:
            SettingsError: a kind that cannot adapt.
            DataError: another robot or sample time.
        """
        require_adapting(model)
        model.check(recording)
        window = _latest(recording, self.window)
        if window is None:
            least = (WARM_UP + 1) * recording.sample_time
            why = f"no run of the window goes on for more than {least:.3g} s after all outputs were first measured"
            return _kept(model, Judged(adapted=False, why=why, seconds=0.0))
        known, held = _split(window, self.block)
        seconds = len(window) * window.sample_time
        if min(known.sum(axis=0).min(), held.sum(axis=0).min()) < _LEAST_ROWS:
            why = "an output was measured in too few of its rows"
            return _kept(model, Judged(adapted=False, why=why, seconds=seconds))
        motion = reference(model)
        if not _moved(window.set_points, motion.set_points):
            why = "the window hardly moves the neck, so that it teaches nothing"
            return _kept(model, Judged(adapted=False, why=why, seconds=seconds, rows=int(held.any(axis=1).sum())))
        free = Free.of(model)
        problem = Problem(free, window, known, window.outputs, information(free, motion), self.strength)
        return _accepted(model, window, problem, problem.solve(), held)


def adapted(model: Model, recording: Recording, window: float) -> Model:
    """Return `model.adapted(recording, window=window)`."""
    return Adaptation(window=window).of(model, recording)


def _accepted(model: Model, window: Recording, problem: Problem, z: Vector, held: np.ndarray) -> Model:
    """Return the adapted model if no output is worse over the rows held out, else the old one."""
    seconds, rows = len(window) * window.sample_time, int(held.any(axis=1).sum())
    before = _fits(window.outputs, free_run(model, window), held)
    best: tuple[float, Model, tuple[float, ...]] | None = None
    for part in _PARTS:
        numbers = problem.numbers(part * z)
        if not (part * z).any() or not problem.free.sound(numbers):
            continue
        trial = problem.free.at(numbers)
        after = _fits(window.outputs, free_run(trial, window), held)
        no_worse = all(new >= old for new, old in zip(after, before, strict=True))
        if no_worse and sum(after) > sum(before) and (best is None or sum(after) > sum(best[2])):
            best = (part, trial, after)
    if best is None:
        why = "no adapted model is better on the rows held out"
        return _kept(model, Judged(adapted=False, why=why, seconds=seconds, rows=rows, before=before, after=before))
    said = Judged(adapted=True, why="", seconds=seconds, rows=rows, before=before, after=best[2], part=best[0])
    new = _widened(best[1], window)
    findings = {
        **model.findings,
        **trained_set_points(window, model.findings),
        "adaptation": said.as_dict(),
    }
    rows_seen = np.unique(np.concatenate([model.training_rows, row_hashes(window)]))
    return replace(new, findings=findings, training_rows=rows_seen)


def _kept(model: Model, said: Judged) -> Model:
    return replace(model, findings={**model.findings, "adaptation": said.as_dict()})


def _latest(recording: Recording, seconds: float) -> Recording | None:
    """Return the last seconds, each run from where all outputs are there; None where they never are."""
    rows = max(round(seconds / recording.sample_time), 1)
    last = recording.rows(max(len(recording) - rows, 0), len(recording))
    parts = []
    for run in last.runs():
        there = np.isfinite(run.outputs).all(axis=1)
        if there.any() and len(run) - int(np.argmax(there)) > WARM_UP + 1:
            parts.append(run.rows(int(np.argmax(there)), len(run)))
    return concatenate(parts) if parts else None


def _split(window: Recording, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the entries (time, outputs) to learn from and those held out: blocks in turn."""
    there = scored(window)
    block = np.arange(len(window)) // max(round(seconds / window.sample_time), 1)
    held = (block % _EVERY == _EVERY - 1)[:, None]
    return there & ~held, there & held


def _moved(window: Matrix, motion: Matrix) -> bool:
    """Return whether a motor moves over the window by a part of what it does along the reference."""
    return bool((window.std(axis=0) > _LEAST_MOTION * motion.std(axis=0)).any())


def _fits(measured: Matrix, free: Matrix, held: np.ndarray) -> tuple[float, ...]:
    fits = [nrmse_fit(measured[held[:, axis], axis], free[held[:, axis], axis]) for axis in range(measured.shape[1])]
    return tuple(float(fit) if np.isfinite(fit) else -np.inf for fit in fits)


def _widened(model: Model, window: Recording) -> Model:
    """Return the model with a doubt that holds for what was seen in the window."""
    there = scored(window)
    run = model.simulate(window)[:, : len(model.robot.outputs.names)]
    errors = np.where(there, window.outputs - run, np.nan)
    return doubted(model, errors)
