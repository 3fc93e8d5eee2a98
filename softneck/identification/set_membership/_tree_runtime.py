"""Exact bounds by branch and bound over a kd-tree (see `_trees`): node j of level l is row 2^l + j of `nodes`.

A cone's value at a box is no better than its ymin (ymax) at the box's nearest point. Rounding keeps that
order: gaps, squares, their sums in one order, roots and products all rise with their arguments, so a node
that is left out holds no better cone to the last bit, and the bounds are those of all points to the bit.
"""

import math

import numpy as np


def tree_distance(nodes: np.ndarray, node: int, x: np.ndarray) -> float:
    """Return the distance of x (n,) from a node's box, 0 within."""
    squared = 0.0
    for i in range(x.shape[0]):
        # x can be beyond one end of the box only.
        gap = max(nodes[node, 2 * i] - x[i], x[i] - nodes[node, 2 * i + 1])
        if gap > 0.0:
            squared += gap * gap
    return math.sqrt(squared)


def tree_children(nodes: np.ndarray, node: int, x: np.ndarray) -> tuple[float, float]:
    """Return `tree_distance` of both children of a node, side by side: the processor works on the two at once."""
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


def tree_cones(points: np.ndarray, first: int, count: int, gamma: float, x: np.ndarray, cones: np.ndarray) -> None:
    """Fill `cones` with gamma times the distance of x (n,) from `count` points from column `first` on, side by side.

    The sum of each point goes over its sides in their order, as a box's does: see above.
    """
    for k in range(count):
        cones[k] = 0.0
    for i in range(x.shape[0]):
        value = x[i]
        for k in range(count):
            gap = points[i, first + k] - value
            cones[k] += gap * gap
    for k in range(count):
        cones[k] = gamma * math.sqrt(cones[k])


def tree_tighten(
    tree: tuple[np.ndarray, np.ndarray, np.ndarray],
    place: tuple[int, int],
    gamma: float,
    x: np.ndarray,
    bounds: tuple[float, float],
    hidden: tuple[np.ndarray, float, float],
) -> tuple[float, float]:
    """Return `bounds` (low, high) tightened by max(y - gamma d) and min(y + gamma d) over the points under a node.

    Args:
        tree: points (n, N) in tree order, their values (N,), nodes.
        place: the node, 1 for all points, and the column of `nodes` with the values' ymin (ymax is behind it).
        gamma: slope of the cones.
        x: (n,) where.
        bounds: what is known already; (-inf, inf) at first.
        hidden: ages (N,), start, stop: points with `start <= age < stop` do not count.
    """
    points, values, nodes = tree
    node, column = place
    low, high = bounds
    ages, start, stop = hidden
    rows = values.shape[0]
    leaves = nodes.shape[0] // 2
    # Left for later: one node a level at most, and 2^64 nodes are more than any memory holds.
    waiting = np.empty(64, dtype=np.int64)
    later = np.empty(64)
    # Leaves share the points evenly: none has more than one above the mean.
    cones = np.empty(rows // leaves + 1)
    waiting[0] = node
    later[0] = 0.0 if node == 1 else gamma * tree_distance(nodes, node, x)  # of all points: at least 0, and free
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
