"""The nu-gap between the nominal axis and every plant, and how far the controller stands it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softneck.core import Vector

from ._linear import LinearLaw
from ._plants import Plants


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Of one axis, gains scaled by the controller's at the crossover so that units do not count.

    Attributes:
        gap: (n,) nu-gap between the nominal and each plant.
        margin: normalised coprime margin b of the nominal loop; every plant with a gap below is stable with it.
    """

    gap: Vector
    margin: float

    @property
    def ratio(self) -> Vector:
        """(n,) gap over margin: below 1 the gap alone proves stability."""
        return self.gap / self.margin if self.margin > 0.0 else np.full(self.gap.size, math.inf)


def gaps(nominal: Plants, plants: Plants, law: LinearLaw, w: Vector) -> tuple[Gaps, Gaps]:
    """Return the gaps of pitch and roll between one nominal plant and all others, axes taken alone.

    Args:
        nominal: one plant.
        plants: (n) stable ones.
        law: the controller's linear form.
        w: (m,) frequencies [rad/s] up to Nyquist.
    """
    Ky = law.feedback(w)
    return tuple(_axis(nominal.response(w)[0, i], plants.response(w)[:, i], -Ky[:, i, i]) for i in (0, 1))  # pyright: ignore[reportReturnType]


def _axis(P1: np.ndarray, P2: np.ndarray, C: np.ndarray) -> Gaps:
    # The loop's gain falls through 1 at the crossover; there controller and plant are each other's inverse in size.
    crossing = np.flatnonzero(np.abs(P1 * C) >= 1.0)
    k = np.abs(C[crossing[-1] if crossing.size else 0])
    P1, P2, C = P1 * k, P2 * k, C / k
    distance = np.abs(P1 - P2) / np.sqrt((1.0 + np.abs(P1) ** 2) * (1.0 + np.abs(P2) ** 2))
    # Both are stable: the gap is the largest distance unless 1 + P2* P1 winds around zero (Vinnicombe 1993).
    turns = np.angle(1.0 + np.conj(P2) * P1)
    unwrapped = np.unwrap(np.concatenate([np.zeros((turns.shape[0], 1)), turns], axis=1), axis=1)
    wound = np.abs(np.round(unwrapped[:, -1] / math.pi)) > 0
    margin = float(np.min(np.abs(1.0 + P1 * C) / np.sqrt((1.0 + np.abs(P1) ** 2) * (1.0 + np.abs(C) ** 2))))
    return Gaps(np.where(wound, 1.0, distance.max(axis=1)), margin)
