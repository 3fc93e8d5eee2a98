"""Trees over stretches of points, and their queries: compiled and on all cores, or by numpy."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions
from softneck.runtime._compile import have_numba

from ._trees import tree_nodes, tree_order

# See `_queries_runtime`: points (n, N), values (N,), nodes, ages (N,).
Tree = tuple[Matrix, Vector, Matrix, Vector]


def plain_batch(tree: Tree, column: int, gammas: Vector, queries: Matrix, windows: Matrix, bounds: Matrix) -> None:
    """Tighten `bounds` (m, 2) at each row of `queries`; see `_queries_runtime`."""
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
    """Return the gamma that more points need beside the tree's; see `_queries_runtime`."""
    del column
    points, values, _, ages = tree
    for k, x in enumerate(queries):
        counts = _counts(ages, windows[min(k, len(windows) - 1)])
        needed = (np.abs(values - targets[k]) - slack) / np.maximum(_distances(points, x), 1e-300)
        gamma = float(np.max(np.minimum(needed, 1e300), initial=gamma, where=counts))
    return gamma


def plain_regions(tree: Tree, column: int, slack: float, gammas: Vector) -> None:
    """Raise `gammas` to what the points of each region need; see `_queries_runtime`."""
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


_RUNTIME = "softneck.identification.set_membership._queries_runtime"
# Below this, starting a thread (50 us) costs more than it saves.
_ROWS_PER_THREAD = 200
# No point is left out.
EVERYTHING = np.zeros((1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class PointTree:
    """Points in tree order.

    Attributes:
        points: (n, N) scaled regressors.
        values: (m, N) outputs.
        nodes: (2^(depth+1), 2 n + 2 m), see `_trees`; ymin and ymax of each output.
        ages: (N,) the row that each was, as a float.
    """

    points: Matrix
    values: Matrix
    nodes: Matrix
    ages: Vector

    def tree(self, output: int) -> Tree:
        """Return what the runtime takes for one output."""
        return self.points, self.values[output], self.nodes, self.ages

    def column(self, output: int) -> int:
        """Return the column of an output's ymin."""
        return 2 * (len(self.points) + output)

    def own_nodes(self, output: int) -> Matrix:
        """Return the nodes (2^(depth+1), 2 n + 2) of one output alone."""
        n = len(self.points)
        columns = [*range(2 * n), 2 * (n + output), 2 * (n + output) + 1]
        return self.nodes if len(self.values) == 1 else np.ascontiguousarray(self.nodes[:, columns])


def plant(points: Matrix, values: Matrix, ages: Vector) -> PointTree:
    """Return the tree over points (n, N), values (m, N) and ages (N,), which are put in its order where they lie.

    In place, so that memory holds the points once.
    """
    order = tree_order(points)
    for row in (*points, *values):
        row[:] = row[order]
    return PointTree(points, values, tree_nodes(points, values), ages[order])


def tighten(
    trees: list[PointTree], output: int, gammas: Vector, queries: Matrix, *, windows: Matrix = EVERYTHING, workers: int
) -> Matrix:
    """Return max(y - gamma d) and min(y + gamma d) (rows, 2) over all trees, without epsilon.

    Each row is computed alone, so the result does not depend on the number of workers.
    """
    bounds = np.tile([-np.inf, np.inf], (len(queries), 1))
    batch = load_functions(_RUNTIME).set_batch if have_numba() else plain_batch
    if not have_numba():
        workers = 1

    def run(rows: slice) -> None:
        seen = windows[rows] if len(windows) > 1 else windows
        for tree in trees:
            batch(tree.tree(output), tree.column(output), gammas, queries[rows], seen, bounds[rows])

    in_parts(run, len(queries), workers)
    return bounds


def region_gammas(tree: PointTree, output: int, slack: float, regions: int) -> Vector:
    """Return the slope (regions,) that the points of each region need beside all points."""
    gammas = np.zeros(regions)
    raise_gammas = load_functions(_RUNTIME).set_regions if have_numba() else plain_regions
    raise_gammas(tree.tree(output), tree.column(output), slack, gammas)
    return gammas


def in_parts(run: Callable[[slice], None], rows: int, workers: int) -> None:
    """Call `run` for stretches of rows, on threads: the compiled loops hold no lock."""
    parts = min(workers, rows // _ROWS_PER_THREAD)
    if parts <= 1:
        run(slice(0, rows))
        return
    # Four stretches a thread, as some queries visit more than others.
    borders = np.linspace(0, rows, 4 * parts + 1).astype(int)
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(run, [slice(a, b) for a, b in pairwise(borders)]))


def all_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
