"""The echo: how the last errors of a free run tell the next one, as a filter that is stable by construction."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector

# Poles beyond this would remember a measurement for minutes.
_RADIUS = 0.995


def fit_echo(errors: list[Vector], order: int) -> Vector:
    """Return c (order,) of `e(k+1) = sum_i c_i e(k+1-i)` by Yule and Walker (Stoica and Moses 2005, sec. 3.4).

    Args:
        errors: one sequence a run; NaN where nothing was measured.
        order: how many errors back.
    """
    r = np.zeros(order + 1)
    counts = np.zeros(order + 1)
    for e in errors:
        for lag in range(min(order + 1, e.size)):
            products = e[lag:] * e[: e.size - lag]
            there = np.isfinite(products)
            r[lag] += products[there].sum()
            counts[lag] += there.sum()
    # Dividing by one number keeps the matrix positive definite, and so the filter stable.
    r /= max(counts[0], 1.0)
    if r[0] <= 1e-20:
        return np.zeros(order)
    R = r[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    c = np.linalg.solve(R + 1e-9 * r[0] * np.eye(order), r[1:])
    radius = float(np.abs(np.roots(np.concatenate([[1.0], -c]))).max(initial=0.0))
    if radius > _RADIUS:  # missed samples spoil the matrix: draw the poles in
        c = c * (_RADIUS / radius) ** np.arange(1, order + 1)
    return c
