"""A change detector from undisturbed motion: how much the model misses there, and what sums that makes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, require_one_of, require_positive, require_whole
from softneck.identification import Model
from softneck.identification.models._fitting import known_rows, one_recording
from softneck.identification.models._ports import payloads
from softneck.signals import Recording
from softneck.signals.detection._cusum import shift_score
from softneck.signals.detection._threshold import Budget, thresholds

from ._change import ChangeDetector
from ._change_parts_runtime import CHANGE_PERIOD, CHANGE_QUIET, CHANGE_STILL

# [s] of a neck's time: what a block of the bootstrap lasts (about a motion, whose misses belong together), its windows,
# the free run's start.
_BLOCK, _WINDOW, _QUIET = 5.0, 20.0, 3.0
# Motion below this part of the mean one is none.
_STILL = 0.1
# Copies of a model of several payloads; a threshold that no sum reaches.
_COPIES, _NEVER = 5, 1e9
# Above this part of rows that the model was trained on, it misses less than it will elsewhere.
_MOST_KNOWN = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeSettings:
    """What a change is, and how often none may be called one.

    Attributes:
        ratio: of the variances of what the model misses, after and before: what is to be noticed soon.
        period: over which it is averaged [s], of another robot by its time constant over a neck's.
        clip: standard deviations for which such an average counts at most.
        hours: of motion in which all sums together raise one false alarm [h].
        memory: of the output `fit` [s].
        payload_memory: over which a model of several payloads tells which one it is [s].
        payload_sight: standard deviations of what it misses for which a payload counts at most in a period.
        order: of the loop it is for.
        seed: of the bootstrap.
    """

    ratio: float = 2.0
    period: float = 0.5
    clip: float = 1.5
    hours: float = 300.0
    memory: float = 10.0
    payload_memory: float = 0.5
    payload_sight: float = 5.0
    order: str = "sequential"
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("ratio", "period", "clip", "hours", "memory", "payload_memory", "payload_sight"):
            require_positive(name, getattr(self, name))
        if self.ratio <= 1.0:
            raise SettingsError(f"`ratio` must be above 1, for a change makes a model worse; got {self.ratio:g}.")
        require_one_of("order", self.order, ("sequential", "jacobi"))
        require_whole("seed", self.seed, 0, 2**62)

    def design(self, model: Model, recordings: Recording | list[Recording]) -> ChangeDetector:
        """Return the detector over a model.

        Args:
            model: of any kind.
            recordings: undisturbed motion like that which it will see, on which the model was not trained.

        Raises:
            DataError: too little motion or none, or motion that the model was trained on.
        """
        recording = one_recording(recordings)
        model.check(recording)
        if float(np.mean(known_rows(recording, model.training_rows))) > _MOST_KNOWN:
            raise DataError("the model was trained on this motion, so that it misses less than it will elsewhere; "
                            "take another recording.")  # fmt: skip
        draft = self._draft(model)
        told = [_payload_of(draft, run) for run in recording.runs()]
        # Each under the payload that it says: what a model misses is judged before what it tells.
        runs = [(run.outputs, replace(draft, model=_under(model, payload)).states(run))
                for run, payload in zip(recording.runs(), told, strict=True)]  # fmt: skip
        still = _STILL * float(np.mean(np.concatenate([states["fastest"] for _, states in runs])))
        draft.arrays["chart"][CHANGE_STILL] = still
        spread = _spread(runs, still)
        draft = replace(draft, arrays={**draft.arrays, "spread": spread, **self._bank(draft)})
        if draft.payloads is not None:
            runs = [(run.outputs, draft.states(run, payload_start=payload))
                    for run, payload in zip(recording.runs(), told, strict=True)]  # fmt: skip
        errors = [_averages(draft, (outputs - states["angles"])[:, None], states) for outputs, states in runs]
        limits = self._thresholds(draft, [self.scores(average[:, 0], moved) for average, moved in errors])
        found: dict[str, Any] = {"seconds": len(recording) * recording.sample_time, "hours": self.hours}
        if draft.payloads is None:
            return replace(draft, arrays={**draft.arrays, "thresholds": limits}, findings=found)
        scores = [self.shifts(*_averages(draft, _apart(outputs, states), states)) for outputs, states in runs]
        telling = self._thresholds(draft, scores)
        alike = _alike(draft, scores, told)
        telling[alike] = _NEVER
        found["alike_kg"] = [float(kg) for kg in np.linspace(*draft.payloads, _COPIES)[alike]]
        return replace(draft, arrays={**draft.arrays, "thresholds": limits, "telling": telling}, findings=found)

    def _thresholds(self, draft: ChangeDetector, scores: list[Matrix]) -> Vector:
        """Return those of some charts, whose scores on undisturbed motion these are (periods, charts) of each run."""
        charts = len(draft.arrays["thresholds"]) + len(draft.arrays.get("telling", ()))
        period = draft.arrays["chart"][CHANGE_PERIOD] * draft.sample_time
        budget = Budget(rate=1.0 / (3600.0 * self.hours), charts=charts, step=period,
                        block=_BLOCK * draft.stretch, window=_WINDOW * draft.stretch)  # fmt: skip
        return thresholds(scores, budget, np.random.default_rng(self.seed))

    def _bank(self, draft: ChangeDetector) -> dict[str, Vector]:
        """Return how a model of several payloads is weighed, which tells nothing yet; nothing for other models."""
        known = payloads(draft.model.arrays)
        if known is None:
            return {}
        keep = np.exp(-draft.sample_time / draft.stretch / self.payload_memory)
        return {"bank": np.array([*known, _COPIES, keep, self.payload_sight]), "telling": np.full(_COPIES, _NEVER)}

    def shifts(self, averages: Matrix, moved: np.ndarray) -> Matrix:
        """Return the scores (periods, copies) of what the model misses against each copy.

        Args:
            averages: (periods, 1 + copies, outputs) of what the model misses and how far copies are apart from it.
            moved: (periods,) whether the neck moved in it; else nothing is counted.
        """
        one = np.ones(averages.shape[2])
        found = [shift_score(row[0], row[1:], one, sight=self.payload_sight) for row in averages]
        return moved[:, None] * np.array(found).reshape(-1, averages.shape[1] - 1)

    def scores(self, averages: Matrix, moved: np.ndarray) -> Matrix:
        """Return the scores (periods, charts) of averages (periods, outputs), in the order of the charts.

        Args:
            averages: of what the model misses over its spread.
            moved: (periods,) whether the neck moved in it; else nothing is counted.
        """
        square = np.minimum(averages**2, self.clip**2 * self.ratio)
        each = moved[:, None] * (0.5 * (1.0 - 1.0 / self.ratio) * square - 0.5 * np.log(self.ratio))
        return np.column_stack([each, each.sum(axis=1)])

    def _draft(self, model: Model) -> ChangeDetector:
        """Return a detector that knows nothing of undisturbed motion yet, and says nothing."""
        m = len(model.robot.outputs.names)
        none = {"spread": np.tile([1.0, 0.0, 0.0], (m, 1)), "thresholds": np.full(m + 1, _NEVER), "chart": np.zeros(7)}
        draft = ChangeDetector(model=model, arrays=none, order=self.order)
        Ts, stretch = model.sample_time, draft.stretch
        period, quiet = max(1, round(self.period * stretch / Ts)), round(_QUIET * stretch / Ts)
        keep = float(np.exp(-Ts / (self.memory * stretch)))
        chart = np.array([period, self.ratio, quiet, keep, Ts, self.clip, 0.0])
        return replace(draft, arrays={**none, "chart": chart})


def _payload_of(draft: ChangeDetector, run: Recording) -> float:
    """Return the payload [kg] that a run says, 0 where it says none; within those that the model knows."""
    known = payloads(draft.model.arrays)
    if known is None:
        return 0.0
    said = float(np.nanmean(run.channels["payload"])) if "payload" in run.channels else 0.0
    return float(np.clip(said, *known))


def _under(model: Model, payload: float) -> Model:
    """Return a model of several payloads as if this were its least one, at which it starts; others as they are."""
    if payloads(model.arrays) is None:
        return model
    found = model.arrays["payload"].copy()
    found[0] = payload
    return replace(model, arrays={**model.arrays, "payload": found})


def _spread(runs: list[tuple[Matrix, dict[str, Matrix]]], still: float) -> Matrix:
    """Return the variance (outputs, 3) of what the model misses: at rest, by its motion squared, by y squared."""
    from scipy.optimize import nnls

    found = []
    for axis in range(runs[0][0].shape[1]):
        X, target = [], []
        for outputs, states in runs:
            y = states["angles"][:, axis]
            X.append(np.column_stack([np.ones(len(y)), states["fastest"][:, 0] ** 2, y**2]))
            target.append((outputs[:, axis] - y) ** 2)
        A, b = np.concatenate(X), np.concatenate(target)
        there = np.isfinite(b) & (A[:, 1] > still**2)
        if not there.any():
            raise DataError("the neck stands still throughout, or nothing was measured; record motion like that which "
                            "the detector will see.")  # fmt: skip
        A, b = A[there], b[there]
        size = np.maximum(A.mean(axis=0), 1e-12)
        weights = nnls(A / size, b)[0] / size
        # A model that misses nothing at rest was not held there for long.
        weights[0] = max(weights[0], 0.1 * float(b.mean()), 1e-12)
        found.append(weights)
    return np.array(found)


def _averages(draft: ChangeDetector, values: np.ndarray, states: dict[str, Matrix]) -> tuple[np.ndarray, np.ndarray]:
    """Return values over the spread, averaged over periods, and whether the neck moved then (periods,).

    Args:
        draft: whose periods and spread these are.
        values: (time, kinds, outputs); the averages have the same shape.
        states: of the run.
    """
    motion, y, (chart, spread) = states["fastest"], states["angles"], (draft.arrays["chart"], draft.arrays["spread"])
    scaled = values / np.sqrt(spread[:, 0] + spread[:, 1] * motion**2 + spread[:, 2] * y**2)[:, None]
    period = int(chart[CHANGE_PERIOD])
    averages, moved = [], []
    for first in range(0, len(scaled) - period + 1, period):
        block, rows = scaled[first : first + period], slice(first, first + period)
        there = np.isfinite(block).all(axis=(1, 2))
        # As the runtime has it: by the last sample of a period.
        if there.any() and first + period > chart[CHANGE_QUIET]:
            averages.append(block[there].mean(axis=0))
            moved.append(bool((motion[rows] > chart[CHANGE_STILL]).any()))
    return np.array(averages).reshape(-1, *scaled.shape[1:]), np.array(moved, dtype=bool)


def _apart(outputs: Matrix, states: dict[str, Matrix]) -> np.ndarray:
    """Return (time, 1 + copies, outputs) what the model misses, and how far each copy is from it."""
    y = states["angles"]
    copies = states["told"].reshape(len(y), -1, y.shape[1])
    return np.concatenate([(outputs - y)[:, None], copies - y[:, None]], axis=1)


def _alike(draft: ChangeDetector, scores: list[Matrix], told: list[float]) -> np.ndarray:
    """Return (copies,) which of them what the model misses looks like.

    In some motion without a change their sums rise for as long as it goes on, and no threshold would hold.
    """
    least, most = draft.payloads or (0.0, 0.0)
    copies = np.linspace(least, most, _COPIES)
    long = max(1, round(_WINDOW * draft.stretch / (draft.arrays["chart"][CHANGE_PERIOD] * draft.sample_time)))
    found = np.zeros(_COPIES, dtype=bool)
    for part, payload in zip(scores, told, strict=True):
        other = np.abs(copies - payload) > 0.5 * (most - least) / (_COPIES - 1)
        for first in range(0, len(part) - long + 1, long):
            found |= other & (part[first : first + long].sum(axis=0) > 0.0)
    return found
