"""One setting fitted on one recording and judged in free run on another: what a search is made of."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from softneck.core import DataError, Matrix, Progress, SoftneckError
from softneck.signals import Recording

from ._model import Model
from ._validation import INFINITE, Validation, validate

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
        score: mean of both axes' free-run fits [%]; -inf where there is none.
        error: standard error of `score` over blocks of 2 s [%].
        size: numbers in the regressor, or weights of a network: what parsimony counts.
        seconds: time of the fit.
        diverged: time [s] at which the free run left the neck's range, or None.
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
        judged = validate(model, hold_out, horizons=(1, INFINITE))
    except (SoftneckError, np.linalg.LinAlgError, FloatingPointError) as error:
        return _failed(settings, time.perf_counter() - begin, str(error))
    if judged.rows_left_out:
        raise DataError(
            f"{judged.rows_left_out} rows of the hold-out were trained on; hold out a recording of another excitation."
        )
    score, error = _score(judged)
    return Trial(
        settings=settings,
        free_run=judged.fits[INFINITE],
        one_step=judged.fits["1"],
        score=score,
        error=error,
        size=model_size(model),
        seconds=seconds,
        diverged=judged.diverged,
        reason="" if np.isfinite(score) else _why(judged),
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


def _score(judged: Validation) -> tuple[float, float]:
    """Return the mean of both free-run fits [%] and its standard error by resampling blocks of the hold-out."""
    fits = list(judged.fits[INFINITE].values())
    if any(fit is None for fit in fits):
        return -np.inf, float("nan")
    y = judged.measured
    wrong, spread = _block_sums((y - judged.free_run) ** 2), _block_sums((y - np.nanmean(y, axis=0)) ** 2)
    # Any generator will do, but the same search must give the same answer.
    drawn = np.random.default_rng(0).integers(len(wrong), size=(_RESAMPLES, len(wrong)))
    ratio = wrong[drawn].sum(axis=1) / np.maximum(spread[drawn].sum(axis=1), 1e-300)
    resampled = 100.0 * (1.0 - np.sqrt(ratio)).mean(axis=1)
    return float(np.mean([fit for fit in fits if fit is not None])), float(resampled.std())


def _block_sums(squares: Matrix) -> Matrix:
    """Return the sums (blocks, 2) over consecutive rows (time, 2), samples that are NaN left out."""
    borders = np.arange(0, len(squares), _BLOCK)
    return np.add.reduceat(np.nan_to_num(squares), borders, axis=0)


def _why(judged: Validation) -> str:
    if judged.diverged is not None:
        return f"the free run left the neck's range at {judged.diverged:g} s"
    return "an axis of the hold-out was not measured or never moved"


def _failed(settings: Mapping[str, Any], seconds: float, reason: str) -> Trial:
    none: dict[str, float | None] = {"pitch": None, "roll": None}
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
