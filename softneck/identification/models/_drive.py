"""The drive model: from motor set-point to measured position, first order plus delay, one per motor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording

# 0.2 s at 20 ms: a drive that answers later than that is not the paper's.
_MAX_DELAY = 10


@dataclass(frozen=True, slots=True, eq=False)
class DriveModel:
    """`m(k+1) = a m(k) + (1 - a) u(k+1-d)` per motor.

    Attributes:
        pole: (motors,) a.
        delay: (motors,) d in samples; 0 says that the position is the set-point (no positions were logged).
    """

    pole: Vector
    delay: Vector

    @property
    def array(self) -> Matrix:
        """(motors, 2): pole and delay, as the runtime reads them."""
        return np.column_stack([self.pole, self.delay])

    def simulate(self, set_points: Matrix, start: Vector) -> Matrix:
        """Return motor positions (time, motors) [rad] for set-points (time, motors), from `start` (motors,)."""
        columns = zip(set_points.T, start, self.pole, self.delay, strict=True)
        return np.column_stack([_simulate(u, m0, a, int(d)) for u, m0, a, d in columns])


def fit_drive(recording: Recording) -> DriveModel:
    """Identify the drives from logged positions; the identity where none were logged."""
    motors = recording.set_points.shape[1]
    if not recording.has_motor_positions:
        return DriveModel(np.zeros(motors), np.zeros(motors))
    fits = [_fit_motor(recording, motor) for motor in range(motors)]
    return DriveModel(np.array([a for a, _ in fits]), np.array([float(d) for _, d in fits]))


def _fit_motor(recording: Recording, motor: int) -> tuple[float, int]:
    runs = [(run.set_points[:, motor], run.motor_positions[:, motor]) for run in recording.runs()]
    candidates = [(_pole(runs, d), d) for d in range(1, _MAX_DELAY + 1)]
    return min(candidates, key=lambda fit: _error(runs, *fit))


def _pole(runs: list[tuple[Vector, Vector]], d: int) -> float:
    """Least squares of `m(k+1) - u = a (m(k) - u)` with u = u(k+1-d)."""
    above = below = 0.0
    for u, m in runs:
        if u.size <= d:
            continue
        target = u[: u.size - d]
        ahead, now = m[d:] - target, m[d - 1 : -1] - target
        there = np.isfinite(ahead) & np.isfinite(now)
        above += float(ahead[there] @ now[there])
        below += float(now[there] @ now[there])
    return float(np.clip(above / below, 0.0, 0.999)) if below > 0 else 0.0


def _error(runs: list[tuple[Vector, Vector]], a: float, d: int) -> float:
    return sum(float(np.nansum((_simulate(u, _first(m, u), a, d) - m) ** 2)) for u, m in runs)


def _first(m: Vector, u: Vector) -> float:
    """Return the first position that was not missed; the first set-point where all were."""
    there = np.isfinite(m)
    return float(m[np.argmax(there)]) if there.any() else float(u[0])


def _simulate(u: Vector, start: float, a: float, d: int) -> Vector:
    from scipy.signal import lfilter

    if d == 0:
        return u.copy()
    # Before the record began the drive had reached its position.
    delayed = np.concatenate([np.full(min(d, u.size), start), u[: max(u.size - d, 0)]])
    return lfilter([1.0 - a], [1.0, -a], delayed, zi=[a * start])[0]
