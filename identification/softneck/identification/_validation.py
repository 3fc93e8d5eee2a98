"""Honest validation: every model beside persistence, one step and k steps ahead and in free run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from softneck.core import DataError, Matrix, Vector, require_one_of
from softneck.signals import Recording

from ._model import WARM_UP, Model
from ._rows import known_rows
from ._scores import nrmse_fit, rmse

INFINITE = "inf"
_AXES = ("pitch", "roll")
# A free run further from zero than this has left any neck's range: it diverged.
_DIVERGED = np.pi
# Level of the residual tests, as in MATLAB's `resid`; lags as there.
_LEVEL, _LAGS = 0.99, 25


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """One model on one recording.

    Attributes:
        model, data: their names.
        rows_scored, rows_left_out: rows judged, and rows left out because the model was trained on them.
        persistence, fits: horizon -> axis -> fit [%]; None where it diverged or nothing was measured or moved.
        rmse_deg: horizon -> axis -> root mean square error [deg].
        diverged: time [s] at which the free run left the neck's range, or None.
        white, uncorrelated: verdicts of the residual tests on the one-step errors.
        time, measured, free_run, one_step: for plots: (time,) and (time, 2) [rad], NaN where nothing is scored.
    """

    model: str
    data: str
    rows_scored: int
    rows_left_out: int
    persistence: dict[str, dict[str, float | None]]
    fits: dict[str, dict[str, float | None]]
    rmse_deg: dict[str, dict[str, float | None]]
    diverged: float | None
    white: bool
    uncorrelated: bool
    time: Vector
    measured: Matrix
    free_run: Matrix
    one_step: Matrix

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of the public face's JSON."""
        return {
            "model": self.model,
            "data": self.data,
            "rows_scored": self.rows_scored,
            "rows_left_out": self.rows_left_out,
            "fits": {"persistence": self.persistence, "model": self.fits},
            "rmse_deg": self.rmse_deg,
            "diverged": self.diverged,
            "residuals": {"white": self.white, "uncorrelated_with_inputs": self.uncorrelated},
        }


def validate(
    model: Model,
    recording: Recording,
    *,
    names: tuple[str, str] = ("model", "data"),
    horizons: Sequence[int | str] = (1, 5, 25, INFINITE),
    motors: str = "simulated",
    include_training: bool = False,
) -> Validation:
    """Judge a model on the rows of a recording that it was not trained on.

    Each stretch of unseen rows starts from 25 measured samples, which are not scored. A free run then has the
    set-points alone, or the logged motor positions as well (`motors="measured"`).

    Raises:
        DataError: nothing is left to judge, or another sample time.
    """
    require_one_of("motors", motors, ("simulated", "measured"))
    stretches, seen = _stretches(model, recording, include_training)
    # One step ahead is always computed: the residual tests need it.
    runs = [_predictions(model, stretch, (1, *horizons), motors) for stretch, _ in stretches]
    scored = [mask for _, mask in stretches]
    y = np.concatenate([np.where(m[:, None], s.outputs, np.nan) for (s, _), m in zip(stretches, scored, strict=True)])
    joined = {h: np.concatenate([run[h] for run in runs]) for h in runs[0]}
    time = np.concatenate([stretch.time for stretch, _ in stretches])
    diverged = _divergence(time, joined[INFINITE]) if INFINITE in joined else None
    finite = [str(h) for h in horizons if h != INFINITE]
    held = {h: np.concatenate([_persistence(s, int(h)) for s, _ in stretches]) for h in finite}
    there = np.isfinite(y).all(axis=1)
    error = (y - joined["1"])[there]
    inputs = np.concatenate([stretch.set_points for stretch, _ in stretches])[there]
    since = np.concatenate([np.arange(len(stretch)) for stretch, _ in stretches])
    # A row with less past than the horizon was not predicted from that far back.
    judged = {h: np.where((since >= (0 if h == INFINITE else int(h)))[:, None], y, np.nan) for h in map(str, horizons)}
    scores = {h: _scores(judged[h], joined[h], lost=h == INFINITE and diverged is not None) for h in judged}
    return Validation(
        model=names[0],
        data=names[1],
        rows_scored=int(sum(mask.sum() for mask in scored)),
        rows_left_out=seen,
        persistence={h: _scores(judged[h], held[h], lost=False)[0] for h in finite},
        fits={h: fit for h, (fit, _) in scores.items()},
        rmse_deg={h: error_deg for h, (_, error_deg) in scores.items()},
        diverged=diverged,
        white=_is_white(error),
        uncorrelated=_is_uncorrelated(error, inputs),
        time=time,
        measured=y,
        free_run=joined.get(INFINITE, np.full_like(y, np.nan)),
        one_step=joined["1"],
    )


def _stretches(
    model: Model, recording: Recording, include_training: bool
) -> tuple[list[tuple[Recording, np.ndarray]], int]:
    """Return stretches of unseen rows with a mask of what to score in each, and how many rows were seen before."""
    parts: list[tuple[Recording, np.ndarray]] = []
    left_out = 0
    for run in recording.runs():
        seen = np.zeros(len(run), dtype=bool) if include_training else known_rows(run, model.training_rows)
        left_out += int(seen.sum())
        for start, stop in _unseen(seen):
            mask = ~seen[start:stop]
            mask[:WARM_UP] = False
            if mask.any():
                parts.append((run.rows(start, stop), mask))
    if not parts:
        why = f"all {left_out} rows were used to train the model" if left_out else f"{len(recording)} rows are too few"
        raise DataError(f"nothing is left to judge: {why}; use another recording or --include-training.")
    return parts, left_out


def _unseen(seen: np.ndarray) -> list[tuple[int, int]]:
    """Return the borders of stretches between long parts that were seen; a few rows seen do not break one."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(np.int8), [0]])))
    long = [(a, b) for a, b in edges.reshape(-1, 2).tolist() if b - a > WARM_UP]
    starts = [0, *(b for _, b in long)]
    stops = [*(a for a, _ in long), seen.size]
    return [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > WARM_UP]


def _predictions(model: Model, run: Recording, horizons: Sequence[int | str], motors: str) -> dict[str, Matrix]:
    result = {}
    for horizon in horizons:
        if horizon == INFINITE:
            result[INFINITE] = model.simulate(run, motors=motors)[:, :2]
        else:
            result[str(horizon)] = model.predict(run, int(horizon), motors=motors)[:, :2]
    return result


def _persistence(run: Recording, horizon: int) -> Matrix:
    """Repeat what was measured `horizon` samples before, the last sample that was not missed."""
    y = run.outputs.copy()
    for axis in range(2):
        last = np.maximum.accumulate(np.where(np.isfinite(y[:, axis]), np.arange(len(y)), 0))
        y[:, axis] = y[last, axis]
    return np.vstack([np.repeat(y[:1], min(horizon, len(y)), axis=0), y[:-horizon]])


def _scores(y: Matrix, yhat: Matrix, *, lost: bool) -> tuple[dict[str, float | None], dict[str, float | None]]:
    if lost:
        return dict.fromkeys(_AXES), dict.fromkeys(_AXES)
    fit: dict[str, float | None] = {a: _number(nrmse_fit(y[:, i], yhat[:, i])) for i, a in enumerate(_AXES)}
    error: dict[str, float | None] = {
        a: _number(float(np.degrees(rmse(y[:, i], yhat[:, i])))) for i, a in enumerate(_AXES)
    }
    return fit, error


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _divergence(time: Vector, outputs: Matrix) -> float | None:
    gone = ~(np.abs(outputs) < _DIVERGED).all(axis=1)
    return float(time[np.argmax(gone)]) if gone.any() else None


def _is_white(error: Matrix) -> bool:
    """Ljung-Box test of both axes at the 99 % level over 25 lags (Ljung and Box 1978)."""
    n = error.shape[0]
    if n <= 2 * _LAGS:
        return False
    for e in (error - error.mean(axis=0)).T:
        r = _autocorrelation(e)
        statistic = n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, _LAGS + 1))))
        if statistic > chi2.ppf(_LEVEL, _LAGS):
            return False
    return True


def _is_uncorrelated(error: Matrix, inputs: Matrix) -> bool:
    """Correlation with each input at lags 0 to 25 within its 99 % band, Bonferroni over all of them (Ljung 16.6).

    The band is that of a coloured error: variance `sum_k R_e(k) R_u(k)` over k = -25..25.
    """
    n = error.shape[0]
    if n <= 2 * _LAGS:
        return False
    tests = error.shape[1] * inputs.shape[1] * (_LAGS + 1)
    # Two-sided normal bound through chi-square with one degree of freedom.
    bound = float(np.sqrt(chi2.ppf(1.0 - (1.0 - _LEVEL) / tests, 1)))
    for e in (error - error.mean(axis=0)).T:
        r_e = _autocorrelation(e)
        for u in (inputs - inputs.mean(axis=0)).T:
            scale = max(float(np.linalg.norm(e) * np.linalg.norm(u)), 1e-300)
            r = np.array([float(e[k:] @ u[: n - k]) for k in range(_LAGS + 1)]) / scale
            # Truncation may leave the sum below that of a white error, which it never is.
            variance = max(1.0, 1.0 + 2.0 * float(r_e @ _autocorrelation(u)))
            if np.abs(r).max() * np.sqrt(n / variance) > bound:
                return False
    return True


def _autocorrelation(x: Vector) -> Vector:
    """Return the autocorrelation at lags 1 to 25 of a signal without mean."""
    power = max(float(x @ x), 1e-300)
    return np.array([float(x[k:] @ x[:-k]) for k in range(1, _LAGS + 1)]) / power
