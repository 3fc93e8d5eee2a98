"""The disturbance of a nonlinear model's free run, estimated over a moving horizon."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix


def estimate_gains(pole: float, window: int) -> Matrix:
    """Return (2, window): level and rate of the disturbance of now from what the model missed, newest first.

    Of all `o(k+1) = o(k) + r(k)`, `r(k+1) = a r(k)` the one nearest to the last `window` residuals, in least squares:
    with the model's inputs known and its state that of its free run the estimation over the horizon is linear.

    Args:
        pole: a, the plant's slowest.
        window: residuals, at least 2.
    """
    back = np.arange(window)
    # i samples ago the level was lower by the rates since then, r(k-j) = a^-j r(k).
    since = np.concatenate([[0.0], np.cumsum(pole ** -back[1:].astype(float))])
    regressor = np.column_stack([np.ones(window), -since])
    return np.linalg.pinv(regressor)


def disturbance_ahead(pole: float, horizon: int) -> Matrix:
    """Return (horizon, 2): what level and rate of now make of the next samples."""
    i = np.arange(1, horizon + 1)
    return np.column_stack([np.ones(horizon), (1.0 - pole**i) / (1.0 - pole)])
