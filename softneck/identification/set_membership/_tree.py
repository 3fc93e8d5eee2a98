"""The kd-tree over the points of a set: balanced, so that the order of the points is all of its structure."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, Vector

# The last level has at most so many points in a node, and (of more than one node) at least half as many.
LEAF = 16


def depth_of(rows: int) -> int:
    """Return the number of halvings after which no node has more than `LEAF` of `rows` points."""
    depth = 0
    while rows > LEAF << depth:
        depth += 1
    return depth


def tree_order(points: Matrix) -> np.ndarray:
    """Return the order (N,) of the columns of `points` (n, N) in which each node is one stretch of them.

    Each level halves all its nodes at once, across the widest side of each, by one stable sort.
    """
    rows = points.shape[1]
    order = np.arange(rows)
    for level in range(depth_of(rows)):
        cuts = borders(rows, level)
        sides = np.array([low_high(row[order], cuts) for row in points])
        widest = np.argmax(sides[:, 1] - sides[:, 0], axis=0)
        node = np.repeat(np.arange(widest.size), np.diff(cuts))
        order = order[np.lexsort((points[widest[node], order], node))]
    return order


def tree_nodes(points: Matrix, values: Vector | Matrix) -> Matrix:
    """Return the nodes (2^(depth+1), 2 n + 2) over points (n, N) in tree order: low and high a side, ymin, ymax.

    Several outputs, `values` (m, N), have a ymin and a ymax each.

    Node j of level l is row 2^l + j and holds the columns from `j N >> l` on; row 0 is unused and zero.
    """
    n, rows = points.shape
    depth = depth_of(rows)
    values = np.atleast_2d(values)
    nodes = np.zeros((2 << depth, 2 * n + 2 * len(values)))
    for level in range(depth + 1):
        cuts = borders(rows, level)
        for i, row in enumerate((*points, *values)):
            nodes[1 << level : 2 << level, 2 * i : 2 * i + 2] = low_high(row, cuts).T
    return nodes


def borders(rows: int, level: int) -> np.ndarray:
    """Return the first column of each node of a level, and `rows` behind them."""
    return (np.arange((1 << level) + 1) * rows) >> level


def low_high(row: Vector, borders: np.ndarray) -> Matrix:
    """Return the least and the largest number (2, nodes) of each stretch."""
    return np.array([np.minimum.reduceat(row, borders[:-1]), np.maximum.reduceat(row, borders[:-1])])
