"""Scores of one channel, and whitening of many: the scalar code behind charts that run in a loop (see `_cusum`)."""

import math

import numpy as np

# An innovation counts for no more than this many standard deviations, and so does a fault: no model is right to a few
# per cent in each sample, and none alone shall decide.
CHART_CLIP = 5.0


def chart_shift(innovation: float, mean: float, variance: float, sight: float) -> float:
    """Return s for a shift by `mean`; one beyond `sight` standard deviations is taken for one of so many."""
    spread = max(math.sqrt(variance), abs(mean) / sight)
    e = innovation / spread
    f = mean / spread
    # Clipped around the fault's mean as well: what the fault explains may be as large as it likes.
    seen = min(max(e, min(f, 0.0) - CHART_CLIP), max(f, 0.0) + CHART_CLIP)
    return f * seen - 0.5 * f * f


def chart_spread(innovation: float, variance: float, ratio: float) -> float:
    """Return s for a variance that changed by `ratio` (Basseville and Nikiforov, example 2.2.2)."""
    square = min(innovation * innovation / variance, CHART_CLIP * CHART_CLIP * max(1.0, ratio))
    return 0.5 * (1.0 - 1.0 / ratio) * square - 0.5 * math.log(ratio)


def chart_whiten(coefficients: np.ndarray, past: np.ndarray, values: np.ndarray, channel: int) -> None:
    """Turn a channel of `values` (kinds, channels) into innovations, and keep it in `past` (order, kinds, channels)."""
    order = coefficients.shape[0]
    for i in range(values.shape[0]):
        value = values[i, channel]
        for k in range(order):
            values[i, channel] -= coefficients[k, channel] * past[k, i, channel]
        for k in range(order - 1, 0, -1):
            past[k, i, channel] = past[k - 1, i, channel]
        if order > 0:
            past[0, i, channel] = value


def chart_push(past: np.ndarray, values: np.ndarray) -> None:
    """Put `values` (channels,) before the rows of `past`, whose last one goes."""
    for k in range(past.shape[0] - 1, 0, -1):
        for j in range(values.shape[0]):
            past[k, j] = past[k - 1, j]
    for j in range(values.shape[0]):
        past[0, j] = values[j]
