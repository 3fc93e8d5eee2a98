"""Find the assignment of motors to tendons and the mounting of the sensor that explain the measured directions best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softneck.core import Matrix, Vector

from ..bus._sensor_source import Axes

# Explanations fit alike within this [rad]: tendons of a neck come out up to 6 deg off, and the nearest two directions
# that two different mistakes give are 30 deg apart.
_ALIKE = math.radians(8.0)
# Nothing explains directions that stay this far off [rad].
FITS = math.radians(20.0)
# All orders of so many motors are tried; of more those that fit best for each way in which the sensor may sit.
_ALL_ORDERS = 5


@dataclass(frozen=True, slots=True)
class Mounting:
    """One explanation.

    `order`: for each motor the tendon that it pulls, both from 0 on. `axes`: for each output as it was measured which
    true output it is, and its sign. `off`: rms angle between what is measured and what it should be then [rad].
    """

    order: tuple[int, ...]
    axes: Axes
    off: float

    @property
    def mistakes(self) -> int:
        """How many exchanges of two, and reversals, lead there."""
        signs = sum(sign < 0.0 for _, sign in self.axes)
        return exchanges(self.order) + exchanges([number for number, _ in self.axes]) + signs


def exchanges(order: Sequence[int]) -> int:
    """Return the number of transpositions in `order`: its length minus its cycles."""
    seen, cycles = set[int](), 0
    for begin in range(len(order)):
        if begin in seen:
            continue
        cycles, at = cycles + 1, begin
        while at not in seen:
            seen.add(at)
            at = order[at]
    return len(order) - cycles


def explain(directions: Matrix, tendons: Matrix) -> list[Mounting]:
    """Return the explanations with fewest errors, the best one first; moves cannot distinguish them.

    Args:
        directions: (motors, outputs) in which each motor moved the outputs as they were measured, NaN where unknown.
        tendons: (outputs, motors) in which each tendon pulls by the robot file.
    """
    known: NDArray[np.bool_] = np.asarray(np.isfinite(directions).all(axis=1))
    found = [Mounting(order, axes, _off(directions, tendons, order, axes, known))
             for axes in _axes(tendons.shape[0]) for order in _orders(directions, tendons, axes, known)]  # fmt: skip
    best = min(one.off for one in found)
    alike = [one for one in found if one.off < best + _ALIKE]
    fewest, straight = min(one.mistakes for one in alike), tuple((k, 1.0) for k in range(tendons.shape[0]))
    return sorted((one for one in alike if one.mistakes == fewest), key=lambda one: (one.axes != straight, one.off))


def _axes(outputs: int) -> Iterator[Axes]:
    for order in itertools.permutations(range(outputs)):
        for signs in itertools.product((1.0, -1.0), repeat=outputs):
            yield tuple(zip(order, signs, strict=True))


def _orders(directions: Matrix, tendons: Matrix, axes: Axes, known: NDArray[np.bool_]) -> Iterator[tuple[int, ...]]:
    count = directions.shape[0]
    if count <= _ALL_ORDERS:
        yield from itertools.permutations(range(count))
        return
    from scipy.optimize import linear_sum_assignment

    expected = [to_sensor_axes(tendon, axes) for tendon in tendons.T]
    cost = np.array([[_angle(directions[j], one) if known[j] else 0.0 for one in expected] for j in range(count)])
    yield tuple(range(count))
    yield tuple(int(k) for k in linear_sum_assignment(cost**2)[1])


def to_sensor_axes(direction: Vector, axes: Axes) -> Vector:
    """Return a true direction of the outputs as a sensor with `axes` tells it."""
    return np.array([sign * direction[number] for number, sign in axes])


def _off(directions: Matrix, tendons: Matrix, order: Sequence[int], axes: Axes, known: NDArray[np.bool_]) -> float:
    angles = [_angle(directions[j], to_sensor_axes(tendons[:, order[j]], axes)) for j in range(len(order)) if known[j]]
    return float(np.sqrt(np.mean(np.square(angles)))) if angles else 0.0


def _angle(a: Vector, b: Vector) -> float:
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return math.acos(min(1.0, max(-1.0, float(a @ b) / size))) if size > 0.0 else math.pi
