"""Scores of a prediction against a measurement."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector


def nrmse_fit(measured: Vector, predicted: Vector) -> float:
    """Return the paper's fit, `100 (1 - |y - yhat| / |y - mean y|)` [%], over the measured samples.

    100 is perfect, 0 is as good as the mean. It is NaN where y was not measured or is constant.
    """
    y, yhat = _measured_pairs(measured, predicted)
    spread = float(np.linalg.norm(y - y.mean())) if _varies(y) else 0.0
    return 100.0 * (1.0 - float(np.linalg.norm(y - yhat)) / spread) if spread > 0 else float("nan")


def r_squared(measured: Vector, predicted: Vector) -> float:
    """Return `R2 = 1 - SSE/SST = 1 - (1 - fit/100)^2`; NaN where y was not measured or is constant."""
    return 1.0 - (1.0 - nrmse_fit(measured, predicted) / 100.0) ** 2


def rmse(measured: Vector, predicted: Vector) -> float:
    """Return the root mean square error over the measured samples, in the unit of the arguments."""
    y, yhat = _measured_pairs(measured, predicted)
    return float(np.sqrt(np.mean((y - yhat) ** 2))) if y.size else float("nan")


def worst_error(measured: Vector, predicted: Vector) -> tuple[float, int]:
    """Return the largest absolute error, infinite for a NaN prediction, and its row; (NaN, -1) without measurements."""
    size = np.abs(measured - predicted)
    size[np.isfinite(measured) & np.isnan(predicted)] = np.inf
    if not np.isfinite(measured).any():
        return float("nan"), -1
    row = int(np.nanargmax(size))
    return float(size[row]), row


def no_worse(scores: Vector, best: Vector) -> bool:
    """Return whether scores of segments are above the best by no more than one standard error of the difference."""
    with np.errstate(invalid="ignore"):
        more = scores - best
        error = more.std(ddof=1) / np.sqrt(more.size) if more.size > 1 else 0.0
        return bool(more.mean() <= error)


def _varies(y: Vector) -> bool:
    # The mean of equal numbers has a rounding error; dividing by that gave fits of -1e16 %.
    return y.size > 0 and float(np.ptp(y)) > 1e-12 * float(np.abs(y).max())


def _measured_pairs(measured: Vector, predicted: Vector) -> tuple[Vector, Vector]:
    there = np.isfinite(measured)
    return measured[there], predicted[there]
