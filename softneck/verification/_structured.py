"""Structured singular value of a loop over its box, and the search for its worst plant.

With a zero-order hold an axis without its dead time is `y0+ = y0 + alpha (K u - y0)`, alpha = 1 - exp(-p Ts): gain
and pole are real scalars that enter once each, exactly. The dead time is a complex scalar, weighted by its largest
relative change of any plant of the box. The loop is `z = M w`, `w = Delta z` with two real and one complex scalar per
axis, and `mu < 1` at every frequency proves stability of the whole box.

For a family tested against its recordings it is `y = (1 + W Delta) G0 u`: one complex scalar per axis, with the weight
of the recordings, in their band.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector, worst
from softneck.design import mu_upper
from softneck.identification import response_of

from ._linear import LinearLaw, loops_of, radii
from ._metrics import Scale
from ._plants import AxisBox, Plants, PlantSource, join, make_plants, measured_plant, mixing_matrix

_POPULATION_PER_UNKNOWN = 10
# Objective of an unstable loop, and largest objective of a stable one.
_UNSTABLE_BADNESS = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Result of a search.

    `plants`: the worst plant of each source, and of each axis if they are decoupled. `radius`: largest spectral radius.
    """

    plants: Plants
    radius: float


def search(necks: list[PlantSource], law: LinearLaw, *, extra: int, generations: int, seed: int) -> SearchResult:
    """Return the plants inside the boxes with the smallest disk margin, unstable ones first.

    Differential evolution (Storn and Price 1997) over gain, pole and dead time of each axis, or of all coupled axes;
    `extra` samples of delay from the loop's order.
    """
    hardest: list[Plants] = []
    largest = 0.0
    for source, neck in enumerate(necks):
        for axes in coupled_axes(neck, law):
            task = _Task(neck, source, axes, law, extra)
            found = _evolve(task.badness, 3 * len(axes), generations, seed)
            label = axes_name(neck, axes) + (" axes" if len(axes) > 1 else "")
            hardest.append(task.plants(found.reshape(1, -1), f"worst that a search found ({label})"))
            largest = worst("stability.radius", [largest, task.radius])
    return SearchResult(join(hardest), largest)


def coupled_axes(neck: PlantSource, law: LinearLaw) -> list[tuple[int, ...]]:
    """Return groups of coupled axes: all if plant or controller couples them, else each alone."""
    every = tuple(range(len(neck.axes)))
    whole = law.coupled or bool(np.any(neck.cross != 0.0))
    return [every] if whole else [(i,) for i in every]


def axes_name(neck: PlantSource, axes: Sequence[int]) -> str:
    """Return the name of a group of axes."""
    return neck.names[axes[0]] if len(axes) == 1 else "both" if len(axes) == 2 else "all"


class _Task:
    """The objective of the search in one source, and the largest radius."""

    def __init__(self, neck: PlantSource, source: int, axes: tuple[int, ...], law: LinearLaw, extra: int) -> None:
        self.neck, self.source, self.axes, self.law, self.extra = neck, source, axes, law, extra
        self.radius = 0.0

    def plants(self, x: Matrix, name: str = "") -> Plants:
        """Return the plants at x (n, 3 axes), from 0 to 1 across the box, without the order's delay."""
        numbers = np.tile(np.stack([box.nominal for box in self.neck.axes]), (len(x), 1, 1))
        for k, axis in enumerate(self.axes):
            box = self.neck.axes[axis]
            numbers[:, axis] = box.low + x[:, 3 * k : 3 * k + 3] * (box.high - box.low)
        return make_plants(self.neck, numbers, [f"{self.neck.name}: {name}"] * len(x), source=self.source)

    def badness(self, x: Matrix) -> Vector:
        """Return the objective (n,) at x (3 axes, n), which scipy minimises."""
        plants = self.plants(x.T).later(self.extra)
        found, size = loops_of(plants, self.law, peaks=False)
        self.radius = worst("stability.radius", [self.radius, *size])
        peaks = found.difference[:, list(self.axes)].max(axis=1)
        # The radius of unstable loops, else the peak of |S - T|, which is infinite at the stability limit.
        return -np.where(
            size >= 1.0, _UNSTABLE_BADNESS * size, np.where(peaks < _UNSTABLE_BADNESS, peaks, _UNSTABLE_BADNESS)
        )


def _evolve(function: Callable[[Matrix], Vector], unknowns: int, generations: int, seed: int) -> Vector:
    from scipy.optimize import differential_evolution

    rng, size = np.random.default_rng(seed), _POPULATION_PER_UNKNOWN
    result = differential_evolution(
        function, [(0.0, 1.0)] * unknowns, vectorized=True, updating="deferred", popsize=size, maxiter=generations,
        init="sobol", rng=rng, polish=False, tol=1e-6,
    )  # fmt: skip
    return np.asarray(result.x)


# Grid of dead times and poles for the weight of the dead time.
_DELAY_COUNT, _POLE_COUNT = 15, 5
# Factor for values between the grid points, and the smallest weight, which widens peaks of real uncertainty.
_WEIGHT_MARGIN, _MIN_WEIGHT = 1.01, 0.01
_FREQUENCY_COUNT = 90
# Grid of the search for peaks of real scalars: 0.2 % apart, at most 0.03 rad of phase of a dead time of 0.1 s.
_FINE_FREQUENCY_COUNT = 4000


@dataclass(frozen=True, slots=True, eq=False)
class StructuredResult:
    """Bounds over frequency.

    `axes`: name of the axis, "both" of two coupled ones, or "all". `frequency`: (m,) [rad/s]. `upper`: (m,) bound of mu
    for stability.
    """

    axes: str
    frequency: Vector
    upper: Vector

    @property
    def mu(self) -> float:
        """Largest upper bound."""
        return float(self.upper.max())


def structured_singular_value(
    neck: PlantSource, law: LinearLaw, *, extra: int, scale: Scale | None = None
) -> list[StructuredResult]:
    """Return the bounds of each axis, or of all coupled axes, computed in quantities scaled by `scale`."""
    time, gain = (1.0, 1.0) if scale is None else (scale.time, scale.gain)
    Ts = neck.sample_time
    results = []
    for axes in coupled_axes(neck, law):
        bands = [box.measured.band for box in (neck.axes[i] for i in axes) if box.measured is not None]
        low, high = [max(ends) for ends in zip(*((a, -b) for a, b in bands), (0.05 / time, -math.pi / Ts), strict=True)]
        peaks = _real_peaks(neck, law, np.geomspace(low, -high, _FINE_FREQUENCY_COUNT), axes, extra, gain)
        w = np.union1d(np.geomspace(low, -high, _FREQUENCY_COUNT), peaks)
        M, blocks = interconnection(neck, law, w, axes, extra, gain)
        name = axes_name(neck, axes)
        if not _middle_is_stable(neck, law, axes, extra):
            # The bound is only valid around a stable nominal loop.
            never = np.full(w.size, math.inf)
            results.append(StructuredResult(name, w, never))
            continue
        results.append(StructuredResult(name, w, mu_upper(M, blocks)))
    return results


def _real_peaks(neck: PlantSource, law: LinearLaw, w: Vector, axes: Sequence[int], extra: int, gain: float) -> Vector:
    """Return frequencies of peaks of real scalars, where mu is not continuous (Packard and Pandey 1993)."""
    M, blocks = interconnection(neck, law, w, axes, extra, gain)
    own = np.imag(np.diagonal(M, axis1=1, axis2=2))[:, [kind < 0 for kind, _ in blocks]]
    i, k = np.nonzero(np.diff(np.signbit(own), axis=0))
    return w[i] + own[i, k] / (own[i, k] - own[i + 1, k]) * (w[i + 1] - w[i])


def _middle_is_stable(neck: PlantSource, law: LinearLaw, axes: Sequence[int], extra: int) -> bool:
    """Return whether the loop in the middle of the box is stable; other axes are nominal."""
    measured = measured_plant(neck, 0)
    if measured is not None:
        return bool(radii(measured.later(extra), law)[0] < 1.0)
    numbers = np.stack([box.nominal for box in neck.axes])
    for i in axes:
        box = neck.axes[i]
        numbers[i] = [box.middle[0], _middle_pole(box, neck.sample_time), box.middle[2]]
    return bool(radii(make_plants(neck, numbers[None], [""]).later(extra), law)[0] < 1.0)


def interconnection(
    neck: PlantSource, law: LinearLaw, w: Vector, axes: Sequence[int], extra: int, gain: float = 1.0
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Return M (m, rows, columns) over `w` [rad/s] and its blocks; `gain` is one of scaled quantities, in SI."""
    n = len(axes)
    parts = [_axis_model(neck.axes[i], w, neck.sample_time, extra, gain) for i in axes]
    X = np.eye(n) if n == 1 else mixing_matrix(neck.cross, n)
    Ky = gain * law.feedback(w)[:, list(axes)][:, :, list(axes)]
    V = X @ Ky
    m = w.size
    P = np.zeros((m, n, n), dtype=complex)
    H, F, E = np.zeros((m, n, 3 * n), complex), np.zeros((m, 3 * n, n), complex), np.zeros((m, 3 * n, 3 * n), complex)
    for k, part in enumerate(parts):
        own = slice(3 * k, 3 * k + 3)
        P[:, k, k], H[:, k, own], F[:, own, k], E[:, own, own] = part
    # y = P u' + H w, u' = V (y + d), z = F u' + E w.
    S = np.linalg.inv(np.eye(n) - P @ V)
    M = F @ V @ S @ H + E
    blocks = [(-1, 0), (-1, 0), (1, 0)] * n
    keep = [r for k, i in enumerate(axes) for r in _uncertain(neck, i, 3 * k)]
    M = M[:, keep][:, :, keep]
    blocks = [blocks[r] for r in keep]
    return M, blocks


def _uncertain(neck: PlantSource, axis: int, start: int) -> list[int]:
    """Return the rows of the uncertain ones of gain and pole, and of the dead time."""
    widths = neck.axes[axis].widths if neck.axes[axis].measured is None else np.zeros(3)
    return [start + k for k in range(3) if widths[k] > 0.0 or k == 2]


def _axis_model(box: Any, w: Vector, Ts: float, extra: int, gain: float = 1.0) -> tuple[np.ndarray, ...]:
    """Return P (m,), H (m, 3), F (m, 3), E (m, 3, 3) of one axis around the middle of its box."""
    z = np.exp(1j * w * Ts)
    if box.measured is not None:
        P, W = response_of(box.measured.model, w, Ts) * z**-extra / gain, box.measured.weight_at(w)
        none = np.zeros((w.size, 3, 3), dtype=complex)
        own = np.array([0.0, 0.0, 1.0])
        return P, W[:, None] * own, P[:, None] * own, none
    L, K, rK = box.middle[2], box.middle[0] / gain, box.widths[0] / gain
    ends = 1.0 - np.exp(-np.array([box.low[1], box.high[1]]) * Ts)
    alpha, r = 0.5 * (ends[0] + ends[1]), 0.5 * (ends[1] - ends[0])
    middle = _middle_pole(box, Ts)
    rest = np.polyval(box.rest[0], z) / np.polyval(box.rest[1], z) * z**-extra
    D = _delay_factor(middle, L, z, Ts) * rest
    W = _delay_weight(box, middle, z, Ts)
    lag = 1.0 / (z - 1.0 + alpha)
    # x = K u + rK w1; y0 = lag (alpha x + r w2); z1 = u, z2 = x - y0, z3 = D y0; y = D y0 + W w3.
    m = w.size
    P = D * lag * alpha * K
    H = np.stack([D * lag * alpha * rK, D * lag * r, W], axis=1)
    F = np.stack([np.ones(m), K * (1.0 - lag * alpha), P], axis=1)
    E = np.zeros((m, 3, 3), dtype=complex)
    E[:, 1, 0], E[:, 1, 1] = rK * (1.0 - lag * alpha), -lag * r
    E[:, 2, 0], E[:, 2, 1] = D * lag * alpha * rK, D * lag * r
    return P, H, F, E


def _middle_pole(box: AxisBox, Ts: float) -> float:
    """Return the pole [1/s] whose discrete pole is the middle of those of the box."""
    low, high = -Ts * box.low[1], -Ts * box.high[1]
    return float(math.log(2.0) - np.logaddexp(low, high)) / Ts


def _delay_factor(p: float, L: float, z: np.ndarray, Ts: float) -> np.ndarray:
    """Return the exact factor of a dead time L on the discretised lag of pole p."""
    d = math.floor(L / Ts + 1e-9)
    part = min(max(L / Ts - d, 0.0), 1.0)
    a, late = math.exp(-p * Ts), math.exp(-p * Ts * (1.0 - part))
    return ((1.0 - late) + (late - a) / z) / (1.0 - a) * z**-d


def _delay_weight(box: Any, middle: float, z: np.ndarray, Ts: float) -> Vector:
    base = _delay_factor(middle, box.middle[2], z, Ts)
    delays = np.linspace(box.low[2], box.high[2], _DELAY_COUNT)
    poles = np.unique(np.linspace(box.low[1], box.high[1], _POLE_COUNT))
    changes = [np.abs(_delay_factor(p, L, z, Ts) / base - 1.0) for p, L in itertools.product(poles, delays)]
    return np.maximum(_WEIGHT_MARGIN * np.max(changes, axis=0), _MIN_WEIGHT)
