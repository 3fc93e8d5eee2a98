"""What one axis may be: a box of static gain, pole and dead time, and which of it the recordings do not exclude."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.identification.uncertainty._measured import AxisMeasured, response_of

# Halvings of the way to a plant that is excluded: to a thousandth.
_HALVINGS = 10


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisBox:
    """What one axis may be; numbers are static gain [rad/rad], pole [1/s], dead time [s].

    Attributes:
        nominal: (3,).
        low, high: (3,).
        samples: (n, 3) plants that were identified; none for a model.
        std: (n, 3) their standard deviations; None where nobody knows.
        rest: numerator and denominator (r + 1,) each, highest power first, of dynamics that are certain.
        measured: of a family that was tested against its recordings, what they show; plants that these exclude are
            none of the box.
    """

    nominal: Vector
    low: Vector
    high: Vector
    samples: Matrix
    std: Matrix | None = None
    rest: tuple[Vector, Vector] = field(default_factory=lambda: (np.ones(1), np.ones(1)))
    measured: AxisMeasured | None = None

    @property
    def widths(self) -> Vector:
        """Half the width of the box (3,), 0 where it is certain."""
        return 0.5 * (self.high - self.low)

    @property
    def middle(self) -> Vector:
        """(3,) of the box."""
        return 0.5 * (self.high + self.low)


def within_weight(numbers: Matrix, box: AxisBox, Ts: float) -> Matrix:
    """Return the plants of an axis (n, 3), those that the recordings exclude drawn towards one that they do not.

    Corners put together what no recording has, such as the slowest pole and the longest dead time. Where even the best
    sample is excluded, poles are too few for this plant, and the box stays whole.
    """
    if box.measured is None:
        return numbers
    known = np.concatenate([box.nominal[None], box.samples])
    excess = _excess(known, box, Ts)
    if excess.min() > 1.0:
        return numbers
    inside = known[int(np.argmin(excess))]
    share = np.where(_excess(numbers, box, Ts) <= 1.0, 1.0, 0.0)[:, None]
    excluded = 1.0 - share
    for k in range(1, _HALVINGS + 1):
        further = share + 0.5**k * excluded
        allowed = _excess(inside + further * (numbers - inside), box, Ts) <= 1.0
        share = np.where(allowed[:, None], further, share)
    return inside + share * (numbers - inside)


def _excess(numbers: Matrix, box: AxisBox, Ts: float) -> Vector:
    """Return how many times the weight over the recordings each plant (n, 3) needs in their band."""
    measured: Any = box.measured
    z = np.exp(1j * measured.frequency * Ts)
    above, below, delay = sampled(numbers, box.rest, Ts)
    powers = z ** np.arange(above.shape[1] - 1, -1, -1)[:, None]
    G = (above @ powers) / (below @ powers) * z ** -delay[:, None].astype(float)
    error = np.abs(G / response_of(measured.model, measured.frequency, Ts) - 1.0)
    return (error / np.maximum(measured.weight, 1e-12)).max(axis=1)


def sampled(numbers: Matrix, rest: tuple[Vector, Vector], Ts: float) -> tuple[Matrix, Matrix, np.ndarray]:
    """Return numerator and denominator (n, q) and delay (n,) of one axis: y+ = a y + b0 u(k-d) + b1 u(k-d-1)."""
    K, p, L = numbers.T
    # 1e-9: dead times such as 0.08 / 0.02 are whole but for rounding.
    d = np.floor(L / Ts + 1e-9)
    part = np.clip(L / Ts - d, 0.0, 1.0)
    a = np.exp(-p * Ts)
    late = np.exp(-p * Ts * (1.0 - part))
    first = np.stack([K * (1.0 - late), K * (late - a)], axis=1)
    own = np.stack([np.ones_like(a), -a], axis=1)
    above = _products(first, rest[0])
    below = _products(own, np.append(rest[1], 0.0))
    above = np.pad(above, ((0, 0), (below.shape[1] - above.shape[1], 0)))
    return above, below, d.astype(int)


def _products(rows: Matrix, polynomial: Vector) -> Matrix:
    return np.stack([np.convolve(row, polynomial) for row in rows])
