"""Many queries of one set: bounds, and the slopes that its points need, row by row on one thread (nogil)."""

import math

import numpy as np

from softneck.identification.set_membership._tree_runtime import tree_children, tree_distance, tree_tighten


def set_home(nodes: np.ndarray, regions: int, x: np.ndarray) -> int:
    """Return the node of the region (a power of two of them) that x falls to, nearest child first."""
    node = 1
    while node < regions:
        left, right = tree_children(nodes, node, x)
        node = 2 * node if left <= right else 2 * node + 1
    return node


def set_bounds(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray],
    column: int,
    gammas: np.ndarray,
    x: np.ndarray,
    bounds: tuple[float, float],
    hidden: tuple[np.ndarray, float, float],
) -> tuple[float, float]:
    """Return `bounds` tightened by the cones of all regions, each with its own slope; see `tree_tighten`."""
    regions = gammas.shape[0]
    home = set_home(tree[2], regions, x)
    # The region that x lies in comes first: with its bounds the others are soon left out.
    bounds = tree_tighten(tree, (home, column), float(gammas[home - regions]), x, bounds, hidden)
    for region in range(regions):
        if regions + region != home:
            bounds = tree_tighten(tree, (regions + region, column), float(gammas[region]), x, bounds, hidden)
    return bounds


def set_batch(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    column: int,
    gammas: np.ndarray,
    queries: np.ndarray,
    windows: np.ndarray,
    bounds: np.ndarray,
) -> None:
    """Tighten `bounds` (m, 2) at each row of `queries` (m, n).

    Args:
        tree: points (n, N) in tree order, values (N,), nodes, ages (N,).
        column: of `nodes`, with the values' ymin.
        gammas: (2^l,) slopes of the nodes of level l.
        queries: (m, n).
        windows: (m, 2) or (1, 2) for all rows: points with `start <= age < stop` do not count.
        bounds: (m, 2) low and high, tightened in place.
    """
    points, values, nodes, ages = tree
    for k in range(queries.shape[0]):
        # One window for each query, or one for all.
        w = min(k, windows.shape[0] - 1)
        known = (bounds[k, 0], bounds[k, 1])
        hidden = (ages, windows[w, 0], windows[w, 1])
        bounds[k, 0], bounds[k, 1] = set_bounds((points, values, nodes), column, gammas, queries[k], known, hidden)


def set_need(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray],
    column: int,
    gamma: float,
    slack: float,
    x: np.ndarray,
    y: float,
    hidden: tuple[np.ndarray, float, float],
) -> tuple[float, int]:
    """Return the gamma that one more point (x, y) needs, at least `gamma`, and the column that asks for it, or -1."""
    points, values, nodes = tree
    ages, start, stop = hidden
    rows = values.shape[0]
    leaves = nodes.shape[0] // 2
    worst = -1
    waiting = np.empty(64, dtype=np.int64)
    waiting[0] = 1
    top = 1
    while top > 0:
        top -= 1
        node = waiting[top]
        distance = tree_distance(nodes, node, x)
        # Less some rounding, so that what is left out needs no more to the last bit.
        while max(nodes[node, column + 1] - y, y - nodes[node, column]) > (1.0 - 1e-14) * (slack + gamma * distance):
            if node >= leaves:
                for k in range((node - leaves) * rows // leaves, (node + 1 - leaves) * rows // leaves):
                    if start < stop and start <= ages[k] < stop:
                        continue
                    squared = 0.0
                    for i in range(x.shape[0]):
                        gap = points[i, k] - x[i]
                        squared += gap * gap
                    # As `gamma_need`: equal points ask for a huge but finite gamma.
                    needed = min((abs(values[k] - y) - slack) / max(math.sqrt(squared), 1e-300), 1e300)
                    if needed > gamma:
                        gamma = needed
                        worst = k
                break
            left, right = tree_children(nodes, node, x)
            node = 2 * node if left <= right else 2 * node + 1
            distance = min(left, right)
            # The sibling: 2j and 2j + 1 differ in the last bit.
            waiting[top] = node ^ 1
            top += 1
    return gamma, worst


def set_regions(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], column: int, slack: float, gammas: np.ndarray
) -> None:
    """Raise `gammas` (2^l,) to what the points of each region need beside all points."""
    points, values, nodes, ages = tree
    rows = values.shape[0]
    regions = gammas.shape[0]
    x = np.empty(points.shape[0])
    for region in range(regions):
        for j in range(region * rows // regions, (region + 1) * rows // regions):
            for i in range(points.shape[0]):
                x[i] = points[i, j]
            # All points count, j itself too: its own rise of 0 asks for nothing.
            gammas[region], _ = set_need(
                (points, values, nodes), column, gammas[region], slack, x, values[j], (ages, 0.0, 0.0)
            )
