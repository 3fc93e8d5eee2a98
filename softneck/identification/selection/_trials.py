"""One setting fitted on one recording and judged in free run on another: what a search is made of."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from softneck.core import Matrix, Progress, SoftneckError
from softneck.robot import Robot
from softneck.signals import Recording

from ..models._model import WARM_UP, Model
from ..models._scores import nrmse_fit
from ..validation._score_tables import divergence

# [rad] Half a turn: a free run beyond it left any neck's range. That of another robot is what the hold-out shows.
FARTHEST = np.pi
# Errors within 2 s of each other belong together: that is ten time constants of the neck.
_BLOCK = 100
# The standard error itself is then known to 5 %.
_RESAMPLES = 200


class Estimator(Protocol):
    """A frozen dataclass of settings whose `fit` returns a model."""

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = ...) -> Model:
        """Return the model of the recordings."""
        ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Trial:
    """One fit of a search.

    Attributes:
        settings: the settings that were varied.
        free_run, one_step: axis -> fit on the hold-out [%]; None where it diverged or failed.
        score: mean of all axes' free-run fits [%]; -inf where there is none.
        error: standard error of `score` over blocks of 2 s [%].
        size: numbers in the regressor, or weights of a network: what parsimony counts.
        seconds: time of the fit.
        diverged: time [s] at which the free run left the robot's range, or None.
        reason: why there is no score, or "".
    """

    settings: Mapping[str, Any]
    free_run: Mapping[str, float | None]
    one_step: Mapping[str, float | None]
    score: float
    error: float
    size: int
    seconds: float
    diverged: float | None
    reason: str

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values; a score that is none becomes null."""
        values = dataclasses.asdict(self)
        there = np.isfinite(self.score)
        return values | {"score": self.score if there else None, "error": self.error if there else None}


def settings_of(vary: Mapping[str, Sequence[Any]], index: Sequence[int]) -> dict[str, Any]:
    """Return one value of each varied setting."""
    return {name: values[i] for (name, values), i in zip(vary.items(), index, strict=True)}


def attempt(estimator: Any, settings: Mapping[str, Any], train: Recording, hold_out: Recording) -> Trial:
    """Fit `estimator` with `settings` on `train` and judge it on `hold_out`; a failure is a trial too."""
    begin = time.perf_counter()
    try:
        model = dataclasses.replace(estimator, **settings).fit(train)
        seconds = time.perf_counter() - begin
        names = hold_out.robot.outputs.names
        free_run = model.simulate(hold_out)[:, : len(names)]
        one_step = model.predict(hold_out)[:, : len(names)]
    except (SoftneckError, np.linalg.LinAlgError, FloatingPointError) as error:
        return _failed(settings, time.perf_counter() - begin, str(error), hold_out.robot)
    y = _scored(hold_out)
    diverged = _diverged(hold_out, free_run, y)
    fits = dict.fromkeys(names) if diverged is not None else _fits(names, y, free_run)
    there = [fit for fit in fits.values() if fit is not None]
    whole = len(there) == len(names)
    return Trial(
        settings=settings,
        free_run=fits,
        one_step=_fits(names, y, one_step),
        score=float(np.mean(there)) if whole else -np.inf,
        error=standard_error(y, free_run) if whole else float("nan"),
        size=model_size(model),
        seconds=seconds,
        diverged=diverged,
        reason="" if whole else _why(diverged, hold_out.robot),
    )


def model_size(model: Model) -> int:
    """Return the components of a regressor, the coefficients of a linear model or the weights of a network."""
    arrays = model.arrays
    if "W1" in arrays:
        return int(sum(arrays[name][0].size for name in ("W1", "b1", "W2", "b2", "w3", "b3")))
    if "table" in arrays:
        return len(arrays["table"])
    sizes = [arrays[name].shape[-1] for name in ("a", "b") if name in arrays]
    return int(sum(sizes)) if sizes else int(sum(a.size for a in arrays.values()))


def _diverged(hold_out: Recording, free_run: Matrix, y: Matrix) -> float | None:
    """Return the time [s] at which a free run (time, outputs) left the robot's range; None where it stayed."""
    if not hold_out.robot.is_neck:
        return divergence(hold_out.time, np.zeros(len(y)), free_run, y, neck=False)[0]
    gone = ~(np.abs(free_run) < FARTHEST).all(axis=1)
    return float(hold_out.time[np.argmax(gone)]) if gone.any() else None


def _scored(hold_out: Recording) -> Matrix:
    """Return the measured outputs (time, outputs), NaN where the start of a run is aligned and not scored."""
    parts = [run.outputs.copy() for run in hold_out.runs()]
    for part in parts:
        part[:WARM_UP] = np.nan
    return np.concatenate(parts)


def _fits(names: Sequence[str], y: Matrix, outputs: Matrix) -> dict[str, float | None]:
    fits = [nrmse_fit(y[:, axis], outputs[:, axis]) for axis in range(len(names))]
    return {name: fit if np.isfinite(fit) else None for name, fit in zip(names, fits, strict=True)}


def standard_error(y: Matrix, outputs: Matrix) -> float:
    """Return the standard error of the mean of all fits [%], by resampling blocks of the hold-out."""
    wrong, spread = _block_sums((y - outputs) ** 2), _block_sums((y - np.nanmean(y, axis=0)) ** 2)
    # Any generator will do, but the same search must give the same answer.
    drawn = np.random.default_rng(0).integers(len(wrong), size=(_RESAMPLES, len(wrong)))
    ratio = wrong[drawn].sum(axis=1) / np.maximum(spread[drawn].sum(axis=1), 1e-300)
    return float((100.0 * (1.0 - np.sqrt(ratio))).mean(axis=1).std())


def _block_sums(squares: Matrix) -> Matrix:
    """Return the sums (blocks, outputs) over consecutive rows (time, outputs), samples that are NaN left out."""
    borders = np.arange(0, len(squares), _BLOCK)
    return np.add.reduceat(np.nan_to_num(squares), borders, axis=0)


def _why(diverged: float | None, robot: Robot) -> str:
    if diverged is not None:
        whose = "the neck" if robot.is_neck else f"`{robot.name}`"
        return f"the free run left {whose}'s range at {diverged:g} s"
    return "an axis of the hold-out was not measured or never moved"


def _failed(settings: Mapping[str, Any], seconds: float, reason: str, robot: Robot) -> Trial:
    none: dict[str, float | None] = dict.fromkeys(robot.outputs.names)
    return Trial(
        settings=settings,
        free_run=none,
        one_step=none,
        score=-np.inf,
        error=float("nan"),
        size=0,
        seconds=seconds,
        diverged=None,
        reason=reason,
    )
