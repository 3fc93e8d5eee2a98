"""Whether an output follows the motors through a mode that outlasts the lags of a regression.

A mode of order two is fitted by its simulation error on one half of the rows and judged on the other half. Only its
frequency and damping are searched, from the peaks of the periodogram; the rest is linear (Golub and Pereyra 2003).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector

from ..recording._recording import Recording

# Dampings and peaks of each spectrum from which the search starts.
_DAMPINGS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.4)
_PEAKS = 4
# Bounds of the search: above, the mode is a lag that a regression shows; below, no run is long enough to tell.
_SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-4, 1.5
# A half needs this many periods of a mode to tell it from a drift.
_FEW_PERIODS = 3.0
# Numerator coefficients of each motor, an eighth of a period apart: they give gain, phase and static gain.
_LAGS, _LAGS_PER_PERIOD = 3, 8
# Rows of a half for each parameter, and the most that are fitted; more would cost time and change no verdict.
_ROWS_PER_PARAMETER, _MOST_ROWS = 10, 8192
_MOST_EVALUATIONS = 80

Half = list[tuple[Matrix, Vector]]


@dataclass(frozen=True, slots=True)
class Mode:
    """A mode through which the motors move an output.

    Attributes:
        frequency: undamped [rad/s].
        damping: ratio; 1 is critical.
        share: of the variance beside free motion and level, what the motors explain on rows not fitted.
    """

    frequency: float
    damping: float
    share: float

    def __str__(self) -> str:
        return f"oscillate at {self.frequency:.3g} rad/s with damping {self.damping:.2g}"


def driven_mode(recording: Recording, output: int) -> Mode | None:
    """Return the mode by which the motors move an output; None for too few rows or an output that never moves.

    The share is that of the half which is explained worse. The free motion and level of each run are fitted to the
    judged rows and subtracted, so that only what the motors cause counts.
    """
    halves = _halves_of_runs(recording, output)
    parameters = 2 + _LAGS * recording.set_points.shape[1]
    if min(sum(int(np.isfinite(y).sum()) for _, y in half) for half in halves) < _ROWS_PER_PARAMETER * parameters:
        return None
    modes = [mode for mode in map(_fit, halves) if mode is not None]
    if len(modes) < len(halves):
        return None
    shares = [_share(fitted, judged, mode) for fitted, judged, mode in zip(halves, halves[::-1], modes, strict=True)]
    frequency, damping = np.sqrt(np.prod(np.array(modes, dtype=float), axis=0))
    return Mode(float(frequency) / recording.sample_time, float(damping), min(shares))


def _halves_of_runs(recording: Recording, output: int) -> tuple[Half, Half]:
    """Return the first and the second half of each run: set-points (time, motors) and the output (time,)."""
    halves: tuple[Half, Half] = ([], [])
    for run in recording.runs():
        y, n = run.outputs[:, output], len(run) // 2
        for half, rows in zip(halves, (slice(0, n), slice(n, 2 * n)), strict=True):
            left = _MOST_ROWS - sum(part.size for _, part in half)
            if np.isfinite(y[rows][:left]).sum() > 3:
                half.append((run.set_points[rows][:left], y[rows][:left]))
    return halves


def _fit(half: Half) -> tuple[float, float] | None:
    """Return frequency [rad/sample] and damping of the smallest simulation error."""
    from scipy.optimize import minimize

    # A few periods in the longest run, and Nyquist.
    low, high = 2.0 * np.pi * _FEW_PERIODS / max(y.size for _, y in half), np.pi

    def error(x: Vector) -> float:
        w, damping = np.exp(x)
        if not (low <= w < high and _SMALLEST_DAMPING <= damping <= _LARGEST_DAMPING):
            return np.inf
        X, y = _columns(half, w, damping)
        return float(((y - X @ np.linalg.lstsq(X, y)[0]) ** 2).sum())

    starts = [np.log([w, damping]) for w in _peaks(half, low) for damping in _DAMPINGS]
    if not starts:
        return None
    starts.sort(key=error)
    best = min((_descend(minimize, error, start) for start in starts[:2]), key=error)
    w, damping = np.exp(best)
    return float(w), float(damping)


def _descend(minimize: Callable[..., Any], error: Callable[[Vector], float], start: Vector) -> Vector:
    # The first steps are below the width of the minimum of a mode that never decays within the run.
    simplex = start + np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 0.5]])
    options = {"initial_simplex": simplex, "maxfev": _MOST_EVALUATIONS, "xatol": 1e-4, "fatol": 0.0}
    return np.asarray(minimize(error, start, method="Nelder-Mead", options=options).x)


def _peaks(half: Half, low: float) -> Vector:
    """Return the frequencies [rad/sample] of the highest peaks of the longest run, of the output and of its rate."""
    y = max((y for _, y in half), key=len)
    there = np.isfinite(y)
    y = np.interp(np.arange(y.size), np.flatnonzero(there), y[there])
    window = np.hanning(y.size)
    spectrum = np.abs(np.fft.rfft(window * (y - y.mean()), 8 * y.size))
    w = np.linspace(0.0, np.pi, spectrum.size)
    found = []
    for size in (spectrum, spectrum * w):
        inner = size[1:-1]
        at = 1 + np.flatnonzero((inner > size[:-2]) & (inner >= size[2:]) & (w[1:-1] >= low))
        found += list(w[at[np.argsort(size[at])[::-1][:_PEAKS]]])
    return np.unique(found)


def _columns(half: Half, w: float, damping: float) -> tuple[Matrix, Vector]:
    """Return responses of the mode to the motors (rows, lags * motors) and the output, both without free motion."""
    from scipy.signal import lfilter

    root = np.exp(w * (-damping + np.emath.sqrt(damping**2 - 1.0) * np.array([1.0, -1.0])))
    F = np.poly(root).real
    spacing = max(1, round(2.0 * np.pi / w / _LAGS_PER_PERIOD))
    parts, targets = [], []
    for u, y in half:
        there = np.isfinite(y)
        # The level of a run takes up the equilibrium at its first set-points.
        x = np.asarray(lfilter([F.sum()], F, u - u[0], axis=0))
        late = [np.vstack([np.zeros((min(j * spacing, len(x)), x.shape[1])), x])[: len(x)] for j in range(_LAGS)]
        free = np.column_stack([lfilter([1.0], F, np.eye(y.size, 2), axis=0), np.ones(y.size)])[there]
        Q = np.linalg.qr(free)[0]
        X, target = np.hstack(late)[there], y[there]
        parts.append(X - Q @ (Q.T @ X))
        targets.append(target - Q @ (Q.T @ target))
    return np.concatenate(parts), np.concatenate(targets)


def _share(fitted: Half, judged: Half, mode: tuple[float, float]) -> float:
    """Return the share of the variance that the mode of `fitted` explains of `judged`."""
    X, y = _columns(fitted, *mode)
    b = np.linalg.lstsq(X, y)[0]
    X, y = _columns(judged, *mode)
    spread = float(y @ y)
    return 1.0 - float(((y - X @ b) ** 2).sum()) / spread if spread > 0.0 else float("nan")
