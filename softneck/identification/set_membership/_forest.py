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

from ._bounds_numpy import Tree, plain_batch, plain_needs, plain_regions
from ._tree import tree_nodes, tree_order

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
        nodes: (2^(depth+1), 2 n + 2 m), see `_tree`; ymin and ymax of each output.
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

    def in_time_order(self) -> tuple[Matrix, Matrix, Vector]:
        """Return points, values and ages, oldest first."""
        order = np.argsort(self.ages)
        return self.points[:, order], self.values[:, order], self.ages[order]


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


def needed_gamma(
    trees: list[PointTree], output: int, slack: float, new: tuple[Matrix, Vector], *, windows: Matrix, gamma: float
) -> float:
    """Return the slope, at least `gamma`, that new points (rows, n) and values (rows,) need beside the trees'."""
    needs = load_functions(_RUNTIME).set_needs if have_numba() else plain_needs
    for tree in trees:
        gamma = needs(tree.tree(output), tree.column(output), slack, *new, windows, gamma)
    return float(gamma)


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
