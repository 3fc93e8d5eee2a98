"""The echo: how the last errors of a free run tell the next one, as a filter that is stable by construction."""

from __future__ import annotations

import numpy as np

from softneck.core import Vector

# How long a disturbance is remembered where nothing is measured any more [s]: twice the neck's time constant.
_MEMORY = 0.4
_GAINS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
# A faster correction than the hold-out asks for may cost it this much of the error: where the network has to
# extrapolate, its errors last longer than there.
_PRICE = 1.4
# Motions that are new leave larger errors than those of the training. On two necks that no test was recorded on this
# factor cost 0.02 points of the one-step fit on the excitation trained on, and gained 0.05 to 0.2 on another one.
BEYOND = 3.0
# Poles beyond this would remember a measurement for minutes.
_RADIUS = 0.995


def fit_echo(errors: list[Vector], order: int, *, beyond: float = 1.0) -> Vector:
    """Return c (order,) of `e(k+1) = sum_i c_i e(k+1-i)` by Yule and Walker (Stoica and Moses 2005, sec. 3.4).

    Args:
        errors: one sequence a run; NaN where nothing was measured.
        order: how many errors back.
        beyond: how many times larger than these, beside the same noise, errors are taken to be on motions that are new.
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
    if beyond > 1.0 and order > 1:
        # What the line through the next two lags leaves of the first is noise; larger errors are as smooth.
        noise = float(np.clip(r[0] - (2.0 * r[1] - r[2]), 0.0, r[0]))
        r *= beyond**2
        r[0] -= (beyond**2 - 1.0) * noise
    R = r[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    c = np.linalg.solve(R + 1e-9 * r[0] * np.eye(order), r[1:])
    radius = float(np.abs(np.roots(np.concatenate([[1.0], -c]))).max(initial=0.0))
    if radius > _RADIUS:  # missed samples spoil the matrix: draw the poles in
        c = c * (_RADIUS / radius) ** np.arange(1, order + 1)
    return c


def fit_correction(errors: list[Vector], sample_time: float) -> Vector:
    """Return memory and gain (2,) of `d(k+1) = memory (d + gain (e - d))`, which foretells the next error e.

    The largest gain is taken whose squared error is at most 1.4 times the least.
    """
    from scipy.signal import lfilter

    memory = float(np.exp(-sample_time / _MEMORY))
    powers = []
    for gain in _GAINS:
        d = [lfilter([0.0, memory * gain], [1.0, -memory * (1.0 - gain)], np.nan_to_num(e)) for e in errors]
        left = np.concatenate([e - x for e, x in zip(errors, d, strict=True)])
        powers.append(float(np.nanmean(left**2)) if np.isfinite(left).any() else 0.0)
    allowed = [gain for gain, power in zip(_GAINS, powers, strict=True) if power <= _PRICE * min(powers)]
    return np.array([memory, max(allowed)])
