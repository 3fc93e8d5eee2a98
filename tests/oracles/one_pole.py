"""The paper's linear model (Eq. 31) by scipy alone: what a neck looks like to one pole and a dead time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from softneck.core import Matrix, Vector
from softneck.signals import SAMPLE_TIME

# Eq. 31: gains [deg/rad], poles [1/s], dead time [s].
PAPER_GAINS = (27.691 / 5.293, 25.424 / 4.938)
PAPER_POLES = (5.293, 4.938)
DEAD_TIME = 4
# Tables 3 and 4, free run of RLS: validation and tests 1 to 3, pitch and roll [%].
PAPER_FITS = np.array([[78.0448, 82.7217], [79.9230, 76.0284], [78.4813, 48.5090], [63.1412, 83.2230]])
# As `validate`: half a second is measured, the rest runs free.
_WARM_UP = 25


@dataclass(frozen=True, slots=True)
class OnePole:
    """y(k+1) = a y(k) + b u(k - 4) of one axis."""

    a: float
    b: float

    @property
    def gain(self) -> float:
        """Static gain [rad/rad]."""
        return self.b / (1.0 - self.a)

    @property
    def pole(self) -> float:
        """Its size [1/s]."""
        return -float(np.log(self.a)) / SAMPLE_TIME

    def fit(self, u: Vector, y: Vector) -> float:
        """Return the paper's fit of the free run from `u` alone [%]."""
        forced = self.b * late(u)[_WARM_UP - 1 : -1]
        free = lfilter([1.0], [1.0, -self.a], forced, zi=[self.a * y[_WARM_UP - 1]])[0]
        rest = y[_WARM_UP:]
        return float(100.0 * (1.0 - np.linalg.norm(rest - free) / np.linalg.norm(rest - rest.mean())))


def late(u: Vector) -> Vector:
    """Return `u` after the dead time, as if its first value had always been there."""
    return np.concatenate([np.full(DEAD_TIME, u[0]), u[:-DEAD_TIME]])


def least_squares(u: Vector, y: Vector) -> OnePole:
    """Return the least one-step error, which is what recursive least squares finds (Eq. 28 to 30)."""
    X = np.column_stack([y, late(u)])[DEAD_TIME:-1]
    a, b = np.linalg.lstsq(X, y[DEAD_TIME + 1 :])[0]
    return OnePole(float(a), float(b))


def output_error(u: Vector, y: Vector) -> OnePole:
    """Return the least error in free run: the gain in closed form, the pole by a bounded search."""

    def scaled(log_pole: float) -> tuple[float, float, float]:
        a = float(np.exp(-SAMPLE_TIME * np.exp(log_pole)))
        x = lfilter([0.0, 1.0 - a], [1.0, -a], late(u), zi=[u[0]])[0]
        gain = float(x @ y / (x @ x))
        return float(np.sum((y - gain * x) ** 2)), a, gain

    best: Any = minimize_scalar(
        lambda log_pole: scaled(log_pole)[0], bounds=(np.log(0.5), np.log(30.0)), method="bounded"
    )
    _, a, gain = scaled(float(best.x))
    return OnePole(a, gain * (1.0 - a))


def fits(models: tuple[OnePole, OnePole], judged: list[tuple[Matrix, Matrix]]) -> Matrix:
    """Return the fits [%] of both axes (record, axis); `judged` are redefined inputs and outputs, each (time, 2)."""
    return np.array([[models[axis].fit(U[:, axis], Y[:, axis]) for axis in range(2)] for U, Y in judged])
