"""Model invalidation: the least uncertainty with which a whole record is consistent, in one band of frequencies.

`y = G0 (1 + D W) u + v` with `|D| <= d` and a bound on the noise v: a record whose transforms leave over more than
d allows invalidates it (Smith and Doyle 1992, IEEE Trans. Automatic Control 37:942; Poolla et al. 1994, ibid. 39:951).
The energies over a band are compared, so d is a lower bound: what is not invalidated is not thereby explained.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Vector

from ..linear._srivc_fit import Continuous
from ._spectra import ComplexArray

# Time constants after which a run's start is forgotten: exp(-5) is below 1 %.
_FORGOTTEN = 5.0
# The noise is white, and seen above this part of the Nyquist frequency, where nothing else is.
_NOISE_ABOVE = 0.7


def least_uncertainty(
    runs: Sequence[tuple[Vector, Vector]],
    model: Continuous,
    frequency: Vector,
    weight: Vector,
    band: tuple[float, float],
    sample_time: float,
) -> float:
    """Return the least norm of the uncertainty, in parts of the weight, that a record needs in a band.

    Args:
        runs: input (time,) and output (time,) of each; missing outputs are filled by straight lines.
        model: nominal.
        frequency, weight: (m,) of W.
        band: its ends [rad/s].
        sample_time: [s].

    Returns:
        at least 0; NaN where no run has three frequencies in the band.
    """
    left, noise, allowed, lines = 0.0, 0.0, 0.0, 0
    for u, y in runs:
        w, E, Y0, floor = _transformed(u, y, model, sample_time)
        there = (w >= band[0]) & (w <= band[1])
        W = np.interp(np.log(np.maximum(w[there], 1e-9)), np.log(frequency), weight)
        left += float(np.sum(np.abs(E[there]) ** 2))
        allowed += float(np.sum((W * np.abs(Y0[there])) ** 2))
        noise += floor * int(there.sum())
        lines += int(there.sum())
    if lines < 3 or allowed <= 0.0:
        return float("nan")
    return max(0.0, float(np.sqrt(left) - np.sqrt(noise))) / float(np.sqrt(allowed))


def _transformed(
    u: Vector, y: Vector, model: Continuous, sample_time: float
) -> tuple[Vector, ComplexArray, ComplexArray, float]:
    """Return frequencies [rad/s], transforms of what the nominal leaves over and of its output, power of the noise."""
    from scipy.signal import detrend

    y0 = nominal_output(model, u, sample_time)
    there = np.isfinite(y)
    y = np.interp(np.arange(y.size), np.flatnonzero(there), y[there])
    slowest = float(-np.roots(np.concatenate([[1.0], model.a])).real.max())
    first = min(round((_FORGOTTEN / slowest + model.delay) / sample_time), u.size // 3)
    window = np.hanning(u.size - first)
    E, Y0, Y = (np.fft.rfft(window * detrend(part[first:], type="constant")) for part in (y - y0, y0, y))
    w = 2.0 * np.pi * np.fft.rfftfreq(window.size, sample_time)
    return w, E, Y0, float(np.median(np.abs(Y[w > _NOISE_ABOVE * w[-1]]) ** 2)) / np.log(2.0)


def nominal_output(model: Continuous, u: Vector, sample_time: float) -> Vector:
    """Return what the model answers to `u` (time,), which was held at its first value before."""
    from scipy.signal import lfilter

    a, b, d = model.sampled(sample_time)
    late = np.concatenate([np.zeros(d + 1), u - u[0]])[: u.size]
    below = np.concatenate([[1.0], a])
    return np.asarray(lfilter(b, below, late)) + u[0] * model.b[-1] / model.a[-1]
