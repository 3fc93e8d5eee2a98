"""Many queries of one set: bounds, row by row on one thread (nogil).

Exact bounds by branch and bound over a kd-tree (see `_trees`): node j of level l is row 2^l + j of `nodes`.

A cone's value at a box is no better than its ymin (ymax) at the box's nearest point. Rounding keeps that
order: gaps, squares, their sums in one order, roots and products all rise with their arguments, so a node
that is left out holds no better cone to the last bit, and the bounds are those of all points to the bit.
"""

import math

import numpy as np

from softneck.identification.set_membership._principal_tree_runtime import tree_cones


def tree_children(nodes: np.ndarray, node: int, x: np.ndarray) -> tuple[float, float]:
    """Return the distances of x (n,) from the boxes of both children of a node, 0 within, side by side."""
    a = 2 * node
    b = 2 * node + 1
    left = 0.0
    right = 0.0
    for i in range(x.shape[0]):
        below = nodes[a, 2 * i] - x[i]
        above = x[i] - nodes[a, 2 * i + 1]
        gap = below if below > above else above
        gap = gap if gap > 0.0 else 0.0
        left += gap * gap
        below = nodes[b, 2 * i] - x[i]
        above = x[i] - nodes[b, 2 * i + 1]
        gap = below if below > above else above
        gap = gap if gap > 0.0 else 0.0
        right += gap * gap
    return math.sqrt(left), math.sqrt(right)


def tree_tighten(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray],
    gamma: float,
    x: np.ndarray,
    bounds: tuple[float, float],
    hidden: tuple[np.ndarray, float, float],
) -> tuple[float, float]:
    """Return `bounds` (low, high) tightened by max(y - gamma d) and min(y + gamma d) over all points.

    Args:
        tree: points (n, N) in tree order, their values (N,), nodes.
        gamma: slope of the cones.
        x: (n,) where.
        bounds: what is known already; (-inf, inf) at first.
        hidden: ages (N,), start, stop: points with `start <= age < stop` do not count.
    """
    points, values, nodes = tree
    column = 2 * x.shape[0]  # the values' ymin; ymax is behind it
    low, high = bounds
    ages, start, stop = hidden
    rows = values.shape[0]
    leaves = nodes.shape[0] // 2
    # Left for later: one node a level at most, and 2^64 nodes are more than any memory holds.
    waiting = np.empty(64, dtype=np.int64)
    later = np.empty(64)
    # Leaves share the points evenly: none has more than one above the mean.
    cones = np.empty(rows // leaves + 1)
    waiting[0] = 1
    later[0] = 0.0
    top = 1
    while top > 0:
        top -= 1
        node = waiting[top]
        cone = later[top]
        # Eq. 19 and 20 with the best value and the nearest place that the box allows: no cone in it does better.
        while nodes[node, column] + cone < high or nodes[node, column + 1] - cone > low:
            if node >= leaves:
                first = (node - leaves) * rows // leaves
                count = (node + 1 - leaves) * rows // leaves - first
                tree_cones(points, first, count, gamma, x, cones)
                for k in range(count):
                    if start < stop and start <= ages[first + k] < stop:
                        continue
                    value = values[first + k]
                    high = min(high, value + cones[k])
                    low = max(low, value - cones[k])
                break
            left, right = tree_children(nodes, node, x)
            # The nearer child now, the other one later, if ever.
            if left <= right:
                node = 2 * node
                other = node + 1
                cone = gamma * left
                far = gamma * right
            else:
                other = 2 * node
                node = other + 1
                cone = gamma * right
                far = gamma * left
            # Bounds only get tighter: what cannot help now never will.
            if nodes[other, column] + far < high or nodes[other, column + 1] - far > low:
                waiting[top] = other
                later[top] = far
                top += 1
    return low, high


def set_batch(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    gamma: float,
    queries: np.ndarray,
    windows: np.ndarray,
    bounds: np.ndarray,
) -> None:
    """Tighten `bounds` (m, 2) at each row of `queries` (m, n).

    Args:
        tree: points (n, N) in tree order, values (N,), nodes, ages (N,).
        gamma: slope of the cones.
        queries: (m, n).
        windows: (m, 2): points with `start <= age < stop` do not count.
        bounds: (m, 2) low and high, tightened in place.
    """
    points, values, nodes, ages = tree
    for k in range(queries.shape[0]):
        hidden = (ages, windows[k, 0], windows[k, 1])
        known = (bounds[k, 0], bounds[k, 1])
        bounds[k, 0], bounds[k, 1] = tree_tighten((points, values, nodes), gamma, queries[k], known, hidden)
