"""The structured singular value of a loop over its box, on the exact discrete response.

Behind a zero-order hold an axis without its dead time is `y0+ = y0 + alpha (K u - y0)`, alpha = 1 - exp(-p Ts): gain
and pole enter once each, as real scalars, exactly. The dead time is a complex scalar whose weight is the largest
relative change that a dead time of the box makes to any plant of the box. So the loop is `z = M w`, `w = Delta z` with
two real and one complex scalar for an axis, and `mu < 1` at every frequency proves stability of the whole box.

Of a family that was tested against its recordings it is `y = (1 + W Delta) G0 u` instead: one complex scalar for an
axis, with the weight that covers what they show, in the band that they excite.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.design import mu_upper
from softneck.identification import response_of

from ._linear import LinearLaw, inverse, loops, radii
from ._metrics import Scale
from ._plants import AxisBox, Plants, PlantSource, join, make_plants, measured_plant, mixing_matrix

# Members of a generation per unknown.
_POPULATION_PER_UNKNOWN = 10
# An unstable loop is worse than any peak; a peak is at most this.
_UNSTABLE_BADNESS = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """What a search found.

    Attributes:
        plants: the worst plant of each neck (and axis, where the axes are apart).
        radius: largest spectral radius met.
        evaluations: plants tried.
    """

    plants: Plants
    radius: float
    evaluations: int


def search(
    necks: list[PlantSource], law: LinearLaw, w: Vector, *, extra: int, generations: int, seed: int
) -> SearchResult:
    """Return the plants inside the boxes with the smallest disk margin, unstable ones first.

    Differential evolution (Storn and Price 1997) over gain, pole and dead time of each axis alone, or of all where
    the axes are coupled by the plant or the controller.

    Args:
        necks: with their boxes.
        law: the controller's linear form.
        w: (m,) frequencies [rad/s].
        extra: samples of delay that the loop's order adds.
        generations: of the search.
        seed: of the search.
    """
    worst: list[Plants] = []
    largest, count = 0.0, 0
    for source, neck in enumerate(necks):
        for axes in coupled_axes(neck, law):
            task = _Task(neck, source, axes, law, w, extra)
            found = _evolve(task.badness, 3 * len(axes), generations, seed)
            worst.append(task.plants(found.reshape(1, -1), f"worst that a search found ({_axes_label(neck, axes)})"))
            largest, count = max(largest, task.radius), count + task.count
    return SearchResult(join(worst), largest, count)


def coupled_axes(neck: PlantSource, law: LinearLaw) -> list[tuple[int, ...]]:
    """Return which axes are judged together: all where plant or controller couple them, else each alone."""
    every = tuple(range(len(neck.axes)))
    whole = law.coupled or bool(np.any(neck.cross != 0.0))
    return [every] if whole else [(i,) for i in every]


def axes_name(neck: PlantSource, axes: Sequence[int]) -> str:
    """Return what axes that are judged together are called."""
    return neck.names[axes[0]] if len(axes) == 1 else "both" if len(axes) == 2 else "all"


def _axes_label(neck: PlantSource, axes: tuple[int, ...]) -> str:
    return neck.names[axes[0]] if len(axes) == 1 else f"{axes_name(neck, axes)} axes"


class _Task:
    """The badness of plants of one neck, and the largest radius that was met."""

    def __init__(
        self, neck: PlantSource, source: int, axes: tuple[int, ...], law: LinearLaw, w: Vector, extra: int
    ) -> None:
        self.neck, self.source, self.axes, self.law, self.w, self.extra = neck, source, axes, law, w, extra
        self.radius, self.count = 0.0, 0

    def plants(self, x: Matrix, name: str = "") -> Plants:
        """Return the plants at x (n, 3 axes), each number 0 to 1 across its box, without the order's delay."""
        numbers = np.tile(np.stack([box.nominal for box in self.neck.axes]), (x.shape[0], 1, 1))
        for k, axis in enumerate(self.axes):
            box = self.neck.axes[axis]
            numbers[:, axis] = box.low + x[:, 3 * k : 3 * k + 3] * (box.high - box.low)
        return make_plants(self.neck, numbers, [f"{self.neck.name}: {name}"] * x.shape[0], source=self.source)

    def badness(self, x: Matrix) -> Vector:
        """Return minus the badness (n,) of x (3 axes, n) as scipy lays it out."""
        plants = self.plants(x.T).later(self.extra)
        size = radii(plants, self.law)
        self.radius, self.count = max(self.radius, float(size.max())), self.count + len(plants)
        S = inverse(np.eye(len(self.neck.axes)) + loops(plants, self.law, self.w)[1])
        peaks = np.stack([np.abs(2.0 * S[..., i, i] - 1.0).max(axis=1) for i in self.axes]).max(axis=0)
        # Beyond stability the radius leads on; before it the peak does, which is infinite on the border.
        return -np.where(size >= 1.0, _UNSTABLE_BADNESS * size, np.minimum(peaks, _UNSTABLE_BADNESS))


def _evolve(function: Callable[[Matrix], Vector], unknowns: int, generations: int, seed: int) -> Vector:
    from scipy.optimize import differential_evolution

    result = differential_evolution(
        function,
        [(0.0, 1.0)] * unknowns,
        vectorized=True,
        updating="deferred",
        popsize=_POPULATION_PER_UNKNOWN,
        maxiter=generations,
        init="sobol",
        rng=np.random.default_rng(seed),
        polish=False,
        tol=1e-6,
    )
    return np.asarray(result.x)


# Dead times and poles of a box that its weight is taken over.
_DELAY_COUNT, _POLE_COUNT = 15, 5
# What lies between those is covered by this part more; and a complex change of this size is always allowed for, which
# makes peaks of purely real uncertainty wider than a point.
_WEIGHT_MARGIN, _MIN_WEIGHT = 1.01, 0.01
_FREQUENCY_COUNT = 90
# Between which the peaks of a real scalar alone are looked for: 0.2 % apart, so that a dead time of 0.1 s turns by
# 0.03 rad at the most from one to the next.
_FINE_FREQUENCY_COUNT = 4000


@dataclass(frozen=True, slots=True, eq=False)
class StructuredResult:
    """Bounds over frequency.

    Attributes:
        axes: "pitch", "roll", or "both" (of more than two "all") where they are coupled.
        frequency: (m,) [rad/s].
        upper: (m,) bound of mu for stability.
    """

    axes: str
    frequency: Vector
    upper: Vector

    @property
    def mu(self) -> float:
        """The largest upper bound."""
        return float(self.upper.max())


def structured_singular_value(
    neck: PlantSource, law: LinearLaw, *, extra: int, scale: Scale | None = None
) -> list[StructuredResult]:
    """Return the bounds of each axis, or of both together where plant or controller couple them.

    Args:
        neck: with its box.
        law: the controller's linear form.
        extra: samples of delay that the loop's order adds.
        scale: of the robot; None: the neck's. The bound is descended to in scaled quantities.
    """
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
            # The bound grows the box from a stable middle; without one there is nothing to grow.
            never = np.full(w.size, math.inf)
            results.append(StructuredResult(name, w, never))
            continue
        results.append(StructuredResult(name, w, mu_upper(M, blocks)))
    return results


def _real_peaks(neck: PlantSource, law: LinearLaw, w: Vector, axes: Sequence[int], extra: int, gain: float) -> Vector:
    """Return where a real scalar alone could make the loop unstable: peaks that no grid meets.

    Packard and Pandey, 1993: mu of real scalars is not continuous in frequency.
    """
    M, blocks = interconnection(neck, law, w, axes, extra, gain)
    own = np.imag(np.diagonal(M, axis1=1, axis2=2))[:, [kind < 0 for kind, _ in blocks]]
    i, k = np.nonzero(np.diff(np.signbit(own), axis=0))
    return w[i] + own[i, k] / (own[i, k] - own[i + 1, k]) * (w[i + 1] - w[i])


def _middle_is_stable(neck: PlantSource, law: LinearLaw, axes: Sequence[int], extra: int) -> bool:
    """Return whether the loop around which the box is modelled is stable; an axis that is not judged is nominal."""
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
    """Return which of gain and pole of an axis are uncertain, and its dead time, which always is a little."""
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
    """Return the pole [1/s] that is sampled to the middle of its box's ends, also where neither shows in one."""
    low, high = -Ts * box.low[1], -Ts * box.high[1]
    return float(math.log(2.0) - np.logaddexp(low, high)) / Ts


def _delay_factor(p: float, L: float, z: np.ndarray, Ts: float) -> np.ndarray:
    """Return what a dead time L does to the sampled lag of pole p: exact, also between samples."""
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
