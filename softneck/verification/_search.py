"""A search for the worst plant inside a box: what a grid of corners and samples may miss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

from ._linear import LinearLaw, inverse, loops, radii
from ._plants import Plants, UncertainNeck, join, make_plants

# Members of a generation per unknown.
_CROWD = 10
# An unstable loop is worse than any peak; a peak is at most this.
_UNSTABLE = 1e3


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
    necks: list[UncertainNeck], law: LinearLaw, w: Vector, *, extra: int, generations: int, seed: int
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
        for axes in axes_together(neck, law):
            task = _Task(neck, source, axes, law, w, extra)
            found = _evolve(task.badness, 3 * len(axes), generations, seed)
            worst.append(task.plants(found.reshape(1, -1), f"worst that a search found ({_axes(neck, axes)})"))
            largest, count = max(largest, task.radius), count + task.count
    return SearchResult(join(worst), largest, count)


def axes_together(neck: UncertainNeck, law: LinearLaw) -> list[tuple[int, ...]]:
    """Return which axes are judged together: all where plant or controller couple them, else each alone."""
    every = tuple(range(len(neck.axes)))
    whole = law.coupled or bool(np.any(neck.cross != 0.0))
    return [every] if whole else [(i,) for i in every]


def together(neck: UncertainNeck, axes: Sequence[int]) -> str:
    """Return what axes that are judged together are called."""
    return neck.names[axes[0]] if len(axes) == 1 else "both" if len(axes) == 2 else "all"


def _axes(neck: UncertainNeck, axes: tuple[int, ...]) -> str:
    return neck.names[axes[0]] if len(axes) == 1 else f"{together(neck, axes)} axes"


class _Task:
    """The badness of plants of one neck, and the largest radius that was met."""

    def __init__(
        self, neck: UncertainNeck, source: int, axes: tuple[int, ...], law: LinearLaw, w: Vector, extra: int
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
        return -np.where(size >= 1.0, _UNSTABLE * size, np.minimum(peaks, _UNSTABLE))


def _evolve(function: Callable[[Matrix], Vector], unknowns: int, generations: int, seed: int) -> Vector:
    from scipy.optimize import differential_evolution

    result = differential_evolution(
        function, [(0.0, 1.0)] * unknowns, vectorized=True, updating="deferred", popsize=_CROWD, maxiter=generations,
        init="sobol", rng=np.random.default_rng(seed), polish=False, tol=1e-6,
    )  # fmt: skip
    return np.asarray(result.x)
