"""Exact bounds by branch and bound over a kd-tree (see `_tree`): node j of level l is row 2^l + j of `nodes`.

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
        gap = max(nodes[node, 2 * i] - x[i], x[i] - nodes[node, 2 * i + 1])
        if gap > 0.0:
            squared += gap * gap
    return math.sqrt(squared)


def tree_bounds(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, gamma: float, x: np.ndarray
) -> tuple[float, float]:
    """Return max(y - gamma d) and min(y + gamma d) over `points` (n, N) in tree order and their `values` (N,)."""
    rows = values.shape[0]
    n = x.shape[0]
    leaves = nodes.shape[0] // 2
    low = -np.inf
    high = np.inf
    # Left for later: one node a level at most, and 2^64 nodes are more than any memory holds.
    waiting = np.empty(64, dtype=np.int64)
    cones = np.empty(64)
    waiting[0] = 1
    cones[0] = 0.0
    top = 1
    while top > 0:
        top -= 1
        node = waiting[top]
        cone = cones[top]
        while nodes[node, 2 * n] + cone < high or nodes[node, 2 * n + 1] - cone > low:
            if node >= leaves:
                for k in range((node - leaves) * rows // leaves, (node + 1 - leaves) * rows // leaves):
                    squared = 0.0
                    for i in range(n):
                        gap = points[i, k] - x[i]
                        squared += gap * gap
                    distance = gamma * math.sqrt(squared)
                    high = min(high, values[k] + distance)
                    low = max(low, values[k] - distance)
                break
            left = gamma * tree_distance(nodes, 2 * node, x)
            right = gamma * tree_distance(nodes, 2 * node + 1, x)
            # The nearer child now, the other one later.
            nearer = 0 if left <= right else 1
            waiting[top] = 2 * node + 1 - nearer
            cones[top] = max(left, right)
            top += 1
            node = 2 * node + nearer
            cone = min(left, right)
    return low, high


def tree_batch(
    points: np.ndarray,
    values: np.ndarray,
    nodes: np.ndarray,
    gamma: float,
    queries: np.ndarray,
    bounds: np.ndarray,
) -> None:
    """Fill `bounds` (m, 2) with the bounds at each row of `queries` (m, n)."""
    for k in range(queries.shape[0]):
        low, high = tree_bounds(points, values, nodes, gamma, queries[k])
        bounds[k, 0] = low
        bounds[k, 1] = high
