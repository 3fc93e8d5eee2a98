"""The noise ceiling: what a perfect model would score, where the same set-points were played more than once.

What differs between repeats follows from no set-point: noise, and whatever of the neck does not repeat. A model that
knew the rest exactly would fit `100 (1 - sigma / std(y))`.
"""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix
from softneck.signals import Recording

# Set-points are equal within this [rad]: 0.05 deg at the motor, far below a log's last digit that matters.
_TOLERANCE = 1e-3
# The start of a run is left out: the neck has forgotten how it began after five time constants [s].
_SETTLED_SECONDS = 1.0
# Repeats shorter than this [s] say too little: 50 samples give the noise to 10 %.
_LEAST_SECONDS = 1.0


def noise_deviation(recording: Recording) -> list[float | None]:
    """Return the standard deviation [rad] of what does not repeat of pitch and roll; None where nothing repeats."""
    squares, weights = np.zeros(2), np.zeros(2)
    for group in _groups(recording):
        repeats = np.stack(group)
        count = np.isfinite(repeats).sum(axis=0)
        mean = np.nansum(repeats, axis=0) / np.maximum(count, 1)
        squares += np.nansum((repeats - mean) ** 2, axis=(0, 1))
        weights += np.maximum(count - 1, 0).sum(axis=0)
    return [float(np.sqrt(s / w)) if w > 0 else None for s, w in zip(squares, weights, strict=True)]


def noise_ceiling(recording: Recording, measured: Matrix) -> list[float | None]:
    """Return the fit [%] of a perfect model on the rows `measured` (time, 2), per axis; None where nothing repeats."""
    result: list[float | None] = []
    for sigma, y in zip(noise_deviation(recording), measured.T, strict=True):
        there = y[np.isfinite(y)]
        spread = float(there.std()) if there.size else 0.0
        result.append(100.0 * (1.0 - sigma / spread) if sigma is not None and spread > 0 else None)
    return result


def _groups(recording: Recording) -> list[list[Matrix]]:
    """Return groups of outputs, in each of equal length (time, 2), that had the same set-points."""
    Ts = recording.sample_time
    settled, least = round(_SETTLED_SECONDS / Ts), round(_LEAST_SECONDS / Ts)
    moving = [run for run in recording.runs() if len(run) >= settled + least and _moves(run.set_points)]
    groups: list[list[Matrix]] = []
    for alike in _alike(moving):
        if len(alike) > 1:
            end = min(len(run) for run in alike)
            groups.append([run.outputs[settled:end] for run in alike])
            continue
        period = _period(alike[0].set_points, least)
        if period is not None:
            ends = range(settled + period, len(alike[0]) + 1, period)
            groups.append([alike[0].outputs[end - period : end] for end in ends])
    return groups


def _alike(runs: list[Recording]) -> list[list[Recording]]:
    """Return the runs in groups of equal set-points, as far as the shorter one goes."""
    groups: list[list[Recording]] = []
    for run in runs:
        group = next((group for group in groups if _equal(group[0].set_points, run.set_points)), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    return groups


def _equal(a: Matrix, b: Matrix) -> bool:
    n = min(len(a), len(b))
    # Two runs that both begin at rest have repeated nothing yet.
    return bool(np.abs(a[:n] - b[:n]).max() <= _TOLERANCE) and _moves(a[:n])


def _moves(set_points: Matrix) -> bool:
    return bool(np.ptp(set_points, axis=0).max() > _TOLERANCE)


def _period(u: Matrix, least: int) -> int | None:
    """Return the smallest number of samples, at least `least`, after which set-points (time, 3) repeat, if any."""
    n = len(u)
    # Sum of squared differences at every lag by FFT; it only proposes, the largest difference decides.
    spectrum = np.abs(np.fft.rfft(u, 2 * n, axis=0)) ** 2
    products = np.fft.irfft(spectrum, axis=0)[:n].sum(axis=1)
    power = np.concatenate([[0.0], np.cumsum((u**2).sum(axis=1))])
    lags = np.arange(least, n // 2 + 1)
    difference = power[n - lags] + power[n] - power[lags] - 2.0 * products[lags]
    for lag in lags[difference <= n * u.shape[1] * _TOLERANCE**2]:
        if np.abs(u[lag:] - u[:-lag]).max() <= _TOLERANCE:
            return int(lag)
    return None
