"""What Eq. 9-11 neglect: gains across the axes, and the third system, compression."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, redefine

from ..linear._srivc_fit import Continuous, SrivcFitOptions

_RUNS_NEEDED = 100


def cross_gains(recordings: Sequence[Recording], nominal: Sequence[Continuous], source: str) -> tuple[Matrix, Matrix]:
    """Return static gains (2, 3) [rad/rad] from theta_i, phi_i, delta_i to pitch and roll, and their deviations.

    Every input is given the pole and the dead time of the output's own axis; gains and an offset for each run by
    least squares, so that only ratios of slow effects are told.

    Args:
        recordings: of one neck.
        nominal: models of pitch and roll.
        source: "set_points" or "positions".
    """
    gains, stds = np.full((2, 3), np.nan), np.full((2, 3), np.nan)
    for axis in range(2):
        parts, targets = [], []
        for recording in recordings:
            for run in recording.runs():
                y = run.outputs[:, axis]
                there = np.isfinite(y)
                if there.sum() < _RUNS_NEEDED:
                    continue
                U = redefine(run.motor_positions if source == "positions" else run.set_points)
                X = np.column_stack([_unit_response(nominal[axis], U[:, j], run.sample_time) for j in range(3)])[there]
                parts.append(X - X.mean(axis=0))
                targets.append(y[there] - y[there].mean())
        if not parts:
            continue
        X, y = np.concatenate(parts), np.concatenate(targets)
        moved = X.std(axis=0) > 1e-6
        theta, *_ = np.linalg.lstsq(X[:, moved], y)
        e = y - X[:, moved] @ theta
        covariance = np.linalg.pinv(X[:, moved].T @ X[:, moved]) * float(e @ e) / max(y.size - 3, 1)
        gains[axis, moved], stds[axis, moved] = theta, np.sqrt(np.diag(covariance))
    return gains, stds


def fit_compression(recordings: Sequence[Recording], search: SrivcFitOptions, source: str) -> Continuous | None:
    """Return G_delta from delta_i [rad] to compression [m], None where it was not logged or not excited."""
    runs: list[tuple[Vector, Vector]] = []
    for recording in recordings:
        for run in recording.runs():
            if "compression" not in run.channels:
                continue
            U = redefine(run.motor_positions if source == "positions" else run.set_points)
            # In millimetres the numbers are of the order of one.
            runs.append((np.ascontiguousarray(U[:, 2]), 1e3 * run.channels["compression"]))
    if not runs or max(float(u.std()) for u, _ in runs) < 0.05:
        return None
    fits = [fit for pole in (5.0, 1.5, 15.0) if (fit := search.start(runs, pole, 0.1)) is not None]
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit.cost).model
    return Continuous(a=best.a, b=1e-3 * best.b, delay=best.delay)


def _unit_response(model: Continuous, u: Vector, sample_time: float) -> Vector:
    """Return the response to `u` of the model scaled to a static gain of one, from rest at u(0)."""
    from scipy.signal import lfilter

    scaled = Continuous(a=model.a, b=model.a[-1:], delay=model.delay)
    a, b, d = scaled.sampled(sample_time)
    return u[0] + np.asarray(lfilter(np.concatenate([np.zeros(1 + d), b]), np.concatenate([[1.0], a]), u - u[0]))
