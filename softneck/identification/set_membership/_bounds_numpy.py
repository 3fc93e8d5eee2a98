"""What `_set_runtime` computes, over all points by numpy: the fallback where numba is not installed.

The same operations in the same order, so the bounds are equal to the last bit.
"""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, Vector

# See `_set_runtime.set_batch`: points (n, N), values (N,), nodes, ages (N,).
Tree = tuple[Matrix, Vector, Matrix, Vector]


def plain_batch(tree: Tree, column: int, gammas: Vector, queries: Matrix, windows: Matrix, bounds: Matrix) -> None:
    """Tighten `bounds` (m, 2) at each row of `queries`; see `_set_runtime.set_batch`."""
    del column
    points, values, _, ages = tree
    borders = (np.arange(gammas.size + 1) * values.size) // gammas.size
    slopes = np.repeat(gammas, np.diff(borders))
    for k, x in enumerate(queries):
        cone = slopes * _distances(points, x)
        counts = _counts(ages, windows[min(k, len(windows) - 1)])
        bounds[k, 0] = np.max(values - cone, initial=bounds[k, 0], where=counts)
        bounds[k, 1] = np.min(values + cone, initial=bounds[k, 1], where=counts)


def plain_needs(
    tree: Tree, column: int, slack: float, queries: Matrix, targets: Vector, windows: Matrix, gamma: float
) -> float:
    """Return the gamma that more points need beside the tree's; see `_set_runtime.set_needs`."""
    del column
    points, values, _, ages = tree
    for k, x in enumerate(queries):
        counts = _counts(ages, windows[min(k, len(windows) - 1)])
        needed = (np.abs(values - targets[k]) - slack) / np.maximum(_distances(points, x), 1e-300)
        gamma = float(np.max(np.minimum(needed, 1e300), initial=gamma, where=counts))
    return gamma


def plain_regions(tree: Tree, column: int, slack: float, gammas: Vector) -> None:
    """Raise `gammas` to what the points of each region need; see `_set_runtime.set_regions`."""
    points, values = tree[:2]
    for region in range(gammas.size):
        stretch = slice(region * values.size // gammas.size, (region + 1) * values.size // gammas.size)
        gammas[region] = plain_needs(
            tree, column, slack, points[:, stretch].T, values[stretch], np.zeros((1, 2)), float(gammas[region])
        )


def _distances(points: Matrix, x: Vector) -> Vector:
    squared = np.zeros(points.shape[1])
    for row, coordinate in zip(points, x, strict=True):
        gap = row - coordinate
        squared += gap * gap
    return np.sqrt(squared)


def _counts(ages: Vector, window: Vector) -> np.ndarray:
    return (ages < window[0]) | (ages >= window[1]) | (window[0] >= window[1])
