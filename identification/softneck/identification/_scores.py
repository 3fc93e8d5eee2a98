"""Scores of a prediction against a measurement."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector


def nrmse_fit(measured: Vector, predicted: Vector) -> float:
    """Return the paper's fit, `100 (1 - |y - yhat| / |y - mean y|)` [%], over the samples that were measured.

    100 is perfect, 0 is as good as the mean; NaN where nothing was measured or nothing moved.
    """
    y, yhat = _paired(measured, predicted)
    spread = float(np.linalg.norm(y - y.mean())) if y.size else 0.0
    return 100.0 * (1.0 - float(np.linalg.norm(y - yhat)) / spread) if spread > 0 else float("nan")


def rmse(measured: Vector, predicted: Vector) -> float:
    """Return the root mean square error in the unit of the arguments, over the samples that were measured."""
    y, yhat = _paired(measured, predicted)
    return float(np.sqrt(np.mean((y - yhat) ** 2))) if y.size else float("nan")


def _paired(measured: Vector, predicted: Vector) -> tuple[Vector, Vector]:
    there = np.isfinite(measured)
    return measured[there], predicted[there]
