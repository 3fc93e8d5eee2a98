"""Residuals made white before they are tested: an autoregression, fitted on undisturbed motion.

A free-run residual is correlated from sample to sample, and a cumulative sum over it drifts far beyond the thresholds
that hold for white noise: Johnson and Bagshaw, "The effect of serial correlation on the performance of CUSUM tests",
Technometrics 16 (1974), find the run length cut by four at a correlation of 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, Vector
from softneck.runtime import load_functions

# Rows per coefficient below which an order is not tried: fewer fit the noise.
_ROWS_EACH = 20


@dataclass(frozen=True, slots=True)
class Whitening:
    """The filter `e_k = r_k - sum a_j r_(k-j)`; what a fault adds to a residual goes through the same.

    Attributes:
        coefficients: a_1..a_p.
    """

    coefficients: tuple[float, ...] = ()

    @classmethod
    def fit(cls, residuals: Sequence[Vector], *, most: int = 6) -> Whitening:
        """Return the autoregression of the order that Akaike's criterion, corrected for few rows, finds best.

        Args:
            residuals: undisturbed stretches, each (time,); no row looks back across their borders.
            most: highest order that is tried.

        Raises:
            DataError: a residual that is not finite, or no stretch of 20 rows.
        """
        if not all(np.isfinite(part).all() for part in residuals):
            raise DataError("residuals must be finite to fit a whitening filter.")
        long = [np.asarray(part, dtype=np.float64) for part in residuals if len(part) > most]
        rows = sum(len(part) - most for part in long)
        if rows < _ROWS_EACH:
            raise DataError(f"a whitening filter needs {_ROWS_EACH} rows beyond its order {most}; there are {rows}.")
        y = np.concatenate([part[most:] for part in long])
        best, found = np.inf, np.zeros(0)
        for order in range(min(most, rows // _ROWS_EACH) + 1):
            X = np.vstack([lags(part, order)[most - order :] for part in long])
            a = np.linalg.lstsq(X, y, rcond=None)[0] if order else np.zeros(0)
            spread = float(np.mean((y - X @ a) ** 2))
            if spread <= 0.0:
                break
            # Hurvich and Tsai (1989), with the variance as one parameter more.
            score = rows * np.log(spread) + 2.0 * (order + 1) * rows / max(rows - order - 2, 1)
            if score < best:
                best, found = score, a
        return cls(tuple(float(value) for value in found))

    def apply(self, residual: Vector) -> Vector:
        """Return the innovations (time - p,) of one stretch (time,)."""
        order = len(self.coefficients)
        return residual[order:] - lags(residual, order) @ np.array(self.coefficients)


def lags(x: Vector, order: int) -> Matrix:
    """Return (time - order, order): in each row the `order` values before, the latest first."""
    return np.column_stack([x[order - j : len(x) - j] for j in range(1, order + 1)]) if order else np.zeros((len(x), 0))


class Filter:
    """Whitening filters that run along, one for each channel: for residuals and for all that faults would add to them.

    Attributes:
        coefficients: (order, channels), zero beyond a channel's own order.
        past: values so far, the latest first (order, kinds, channels).
        seen: how many values it took.
    """

    __slots__ = ("_step", "coefficients", "past", "seen")

    def __init__(self, channels: Sequence[Whitening], kinds: int = 1) -> None:
        """Know nothing yet; values have shape (kinds, channels)."""
        order = max((len(channel.coefficients) for channel in channels), default=0)
        padded = [[*channel.coefficients, *(0.0,) * (order - len(channel.coefficients))] for channel in channels]
        self.coefficients = np.array(padded).reshape(len(channels), order).T.copy()
        self.past = np.zeros((order, kinds, len(channels)))
        self.seen = 0
        self._step: Any = load_functions("softneck.signals.detection._charts_runtime").chart_whiten

    @property
    def settled(self) -> bool:
        """Whether it has seen as many values as it looks back."""
        return self.seen >= len(self.past)

    def step(self, value: Matrix) -> Matrix:
        """Return the innovations of `value` (kinds, channels)."""
        white = np.array(value, dtype=np.float64)
        for channel in range(white.shape[1]):
            self._step(self.coefficients, self.past, white, channel)
        self.seen += 1
        return white

    def reset(self) -> None:
        """Forget all values."""
        self.past[:] = 0.0
        self.seen = 0
