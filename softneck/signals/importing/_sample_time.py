"""The sample time at which logged motor positions and velocities agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Vector

# Differences over this many samples, averaged over as many, drown quantisation, the drive's noise and the rule by which
# rates were made of positions (a difference to the next row, the last, or both), and still see every move.
_WINDOW = 20
# Below it position and velocity do not tell of the same motion (another motor, a command, a wrong sign).
_AGREE = 0.9
# Estimates of one log differ by a few % between motors; a nominal time further off is wrong.
_FITS = 0.03


@dataclass(frozen=True, slots=True)
class SampleTime:
    """An estimate [s]: the median over motors, and the smallest and largest of them."""

    value: float
    lowest: float
    highest: float
    motors: int

    def contradicts(self, nominal: float) -> bool:
        """Return whether `nominal` [s] lies outside the motors' values and their usual scatter."""
        return not self.lowest * (1 - _FITS) <= nominal <= self.highest * (1 + _FITS)

    def __str__(self) -> str:
        return f"{1e3 * self.value:.3g} ms ({1e3 * self.lowest:.3g} to {1e3 * self.highest:.3g}, {self.motors} motors)"


def estimate_sample_time(channels: Mapping[str, Vector], run: np.ndarray) -> SampleTime:
    """Return the period T for which `x(k+n) - x(k) = T sum v` holds best within each run, both averaged over n rows.

    Rates that are differences lack what is faster than their step, so neither side may hold it. Both sides carry
    noise, so T is the ratio of their lengths (the geometric mean of the two regressions).

    Args:
        channels: with motor_position_j [rad] and motor_velocity_j [rad/s], each (time,).
        run: (time,) numbers of the runs.
    """
    periods = []
    for j in (1, 2, 3):
        x, v = channels.get(f"motor_position_{j}"), channels.get(f"motor_velocity_{j}")
        if x is not None and v is not None:
            period, correlation = velocity_period(x, v, run)
            if correlation > _AGREE:
                periods.append(period)
    if not periods:
        raise DataError(
            "the sample time cannot be estimated: no motor has a position and a velocity that agree; "
            "give `sample_time_s` as a number."
        )
    return SampleTime(float(np.median(periods)), min(periods), max(periods), len(periods))


def velocity_period(x: Vector, v: Vector, run: np.ndarray) -> tuple[float, float]:
    """Return the period [s] at which v is the rate of x, and the correlation of both motions; 0, 0 without motion."""
    moved, sums = [], []
    for border in np.split(np.arange(x.size), np.flatnonzero(np.diff(run)) + 1):
        if border.size > 2 * _WINDOW:
            position, velocity = x[border], v[border]
            total = np.concatenate([[0.0], np.cumsum((velocity[1:] + velocity[:-1]) / 2)])
            moved.append(_mean_move(position))
            sums.append(_mean_move(total))
    if not moved:
        return 0.0, 0.0
    a, b = np.concatenate(moved), np.concatenate(sums)
    good = np.isfinite(a) & np.isfinite(b)
    aa, bb, ab = float(a[good] @ a[good]), float(b[good] @ b[good]), float(a[good] @ b[good])
    return (0.0, 0.0) if aa * bb == 0 else (float(np.sqrt(aa / bb)), ab / float(np.sqrt(aa * bb)))


def _mean_move(x: Vector) -> Vector:
    """Return the differences over a window, averaged over the next one."""
    return np.convolve(x[_WINDOW:] - x[:-_WINDOW], np.full(_WINDOW, 1.0 / _WINDOW), "valid")
