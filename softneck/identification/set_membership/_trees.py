"""The kd-trees over the points of a set: balanced, so that the order of the points is all of their structure.

The slanted one is a kd-tree in the directions in which the points spread. Regressors are histories, so that points
hardly leave a few directions, and what the values do over those is nearly a plane. Boxes along those directions are
far tighter than boxes along the regressors, have fewer sides, and values over the plane range far less within one than
values do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import FileFormatError, Matrix, Vector

from ..linear._regression import check_linear
from ..models._arrays import check_table, within

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


def tree_nodes(points: Matrix, values: Vector) -> Matrix:
    """Return the nodes (2^(depth+1), 2 n + 2) over points (n, N) in tree order: low and high a side, ymin, ymax.

    Node j of level l is row 2^l + j and holds the columns from `j N >> l` on; row 0 is unused and zero.
    """
    n, rows = points.shape
    depth = depth_of(rows)
    nodes = np.zeros((2 << depth, 2 * n + 2))
    for level in range(depth + 1):
        cuts = borders(rows, level)
        for i, row in enumerate((*points, values)):
            nodes[1 << level : 2 << level, 2 * i : 2 * i + 2] = low_high(row, cuts).T
    return nodes


def borders(rows: int, level: int) -> np.ndarray:
    """Return the first column of each node of a level, and `rows` behind them."""
    return (np.arange((1 << level) + 1) * rows) >> level


def low_high(row: Vector, borders: np.ndarray) -> Matrix:
    """Return the least and the largest number (2, nodes) of each stretch."""
    return np.array([np.minimum.reduceat(row, borders[:-1]), np.maximum.reduceat(row, borders[:-1])])


# Of gamma, the most that the plane may climb: nearer to it, rounding of gamma^2 - m^2 would count.
_STEEPEST = 0.98
# Directions with less than this share of the widest spread hardly tell nodes apart, and the plane is steep over their
# noise: they take part in neither.
_THIN = 0.02
_SAMPLE = 20_000
# Other sides come in fours, as processors take them.
_SIDES = 4
_MOST_SIDES = 8


def slant_frames(data: Sequence[tuple[Matrix, Vector]], gammas: Vector) -> tuple[Matrix, Vector]:
    """Return a frame (1 + 4 or 1 + 8, n) for each points (n, N) and values (N,), and its plane's climb along row 0.

    Rows are orthonormal; those behind the n-th are zero.
    """
    found = [_frame(points, values, float(gamma)) for (points, values), gamma in zip(data, gammas, strict=True)]
    sides = _SIDES if max(wide for _, _, wide in found) <= _SIDES else _MOST_SIDES
    return np.array([frame[: 1 + sides] for frame, _, _ in found]), np.array([slope for _, slope, _ in found])


def _frame(points: Matrix, values: Vector, gamma: float) -> tuple[Matrix, float, int]:
    """Return the frame with all sides that may be, the plane's climb, and how many sides tell nodes apart."""
    n = len(points)
    # Directions and plane may be anything: a part of the points finds good ones.
    some = slice(None, None, max(1, values.size // _SAMPLE))
    P, y = points[:, some], values[some] - values[some].mean()
    # Sums of squares of any size neither overflow nor vanish.
    size = float(np.abs(P).max()) or 1.0
    P = P / size
    P -= P.mean(axis=1, keepdims=True)
    spread, follows = P @ P.T, P @ y
    variance, V = np.linalg.eigh(spread)
    slope = np.zeros(n)
    # The plane follows the directions of widest spread, as long as it climbs less than cones do.
    for j in range(n - 1, -1, -1):
        if variance[j] <= _THIN**2 * variance[-1]:
            break
        more = slope + V[:, j] * (V[:, j] @ follows / variance[j])
        if float(np.linalg.norm(more)) > _STEEPEST * gamma * size:
            break
        slope = more
    climb = float(np.linalg.norm(slope))
    along = slope / climb if climb > 0.0 else V[:, -1]
    # What is square to it, widest first.
    across = np.linalg.qr(np.column_stack([along, np.eye(n)]))[0][:, 1:]
    variance, V = np.linalg.eigh(across.T @ spread @ across)
    rows = (across @ V[:, ::-1]).T[:_MOST_SIDES]
    frame = np.zeros((1 + _MOST_SIDES, n))
    frame[0] = along
    frame[1 : 1 + len(rows)] = rows
    wide = np.sum(variance > _THIN**2 * max(float(along @ spread @ along), variance.max(initial=0.0)))
    return frame, climb / size, int(wide)


def is_frame(frame: Matrix) -> bool:
    """Return whether the rows of a frame are orthonormal, but for rows of zeros: then no length in it is too long."""
    known = frame[np.any(frame != 0.0, axis=1)]
    sides = len(frame) - 1
    return (
        sides >= 0
        and sides % _SIDES == 0
        and bool(np.allclose(known @ known.T, np.eye(len(known)), rtol=0, atol=1e-13))
    )


def in_frame(frame: Matrix, points: Matrix) -> Matrix:
    """Return the points (n, N) along the rows of `frame`, summed in one order: the same bits on every machine."""
    turned = np.zeros((len(frame), points.shape[1]))
    for row, direction in zip(turned, frame, strict=True):
        for weight, component in zip(direction, points, strict=True):
            row += weight * component
    return turned


def slant_order(frame: Matrix, points: Matrix) -> np.ndarray:
    """Return the order (N,) of the columns of `points` in which each node is one stretch of them."""
    return tree_order(in_frame(frame, points))


def _largest(points: Matrix) -> float:
    """Return the largest sum of a point's components, row by row."""
    total = np.zeros(points.shape[1])
    for row in points:
        total += np.abs(row)
    return float(total.max())


def slant_nodes(frame: Matrix, slope: float, points: Matrix, values: Vector) -> Matrix:
    """Return the nodes (2^(depth+1), 2 (1 + sides) + 2) over points in tree order; see `_principal_tree_runtime`.

    Row 0, which is not a node, holds the slope of the plane and the size of points and values.
    """
    sides, rows = len(frame) - 1, values.size
    depth = depth_of(rows)
    nodes = np.zeros((2 << depth, 4 + 2 * sides))
    nodes[0, 0] = slope
    nodes[0, 1] = _largest(points)
    nodes[0, 2] = np.abs(values).max()
    # One direction after the other: memory holds no second copy of the points.
    for i in range(1 + sides):
        row = in_frame(frame[i : i + 1], points)[0]
        columns = [(row, 3 + i, 3 + sides + i)] if i > 0 else [(row, 0, 1), (values - slope * row, 2, 3)]
        for level in range(depth + 1):
            there, cuts = nodes[1 << level : 2 << level], borders(rows, level)
            for numbers, low, high in columns:
                there[:, low], there[:, high] = low_high(numbers, cuts)
    return nodes


# At most so many rows tell how wide the bounds are between the data: a quantile needs no more.
_WIDTHS = 5000


def usual_width(points: Matrix, values: Vector, gamma: float, correlated: int, quantile: float) -> float:
    """Return the half-width, without epsilon, that a quantile of the rows stays below, themselves left out.

    Args:
        points, values: scaled regressors (n, N) and targets (N,), in order of time.
        gamma: slope of the cones.
        correlated: rows before and after a row that are left out with it.
        quantile: of the rows.
    """
    rows, halves = np.arange(values.size), []
    # Spread over the tree, and so over all places.
    for k in tree_order(points)[np.unique(np.linspace(0, rows.size - 1, min(rows.size, _WIDTHS)).astype(np.int64))]:
        squared = np.zeros(rows.size)
        for row in points:
            gap = row - row[k]
            squared += gap * gap
        cone, counts = gamma * np.sqrt(squared), np.abs(rows - k) > correlated
        halves.append(0.5 * (np.min((values + cone)[counts]) - np.max((values - cone)[counts])))
    return float(np.quantile(halves, quantile))


def check_nlsm(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    """Raise FileFormatError unless the set has its tree, and its base fits the histories."""
    check_table(arrays["table"], sizes)
    within(np.array([sizes["rows"]]), 1, np.inf, "the number of points")
    frame, slopes = arrays["frame"], _slopes(arrays)
    if not all(is_frame(rows) for rows in frame):
        raise FileFormatError("the directions in its array `frame` are not orthogonal; identify the model again.")
    parts = zip(frame, slopes, arrays["points"], arrays["values"], strict=True)
    nodes = np.array([slant_nodes(*axis) for axis in parts])
    # A tree of another shape would be read beyond its end, and one of other numbers would leave points out.
    if not np.array_equal(arrays["nodes"], nodes):
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    check_linear(arrays, sizes, least=0)


def _slopes(arrays: Mapping[str, Matrix]) -> Vector:
    """Return the climb (outputs,) of the values' plane of each axis, less than the cones'."""
    nodes = arrays["nodes"]
    axes = len(arrays["bounds"])
    slopes = nodes[:, 0, 0] if nodes.ndim == 3 and len(nodes) == axes and nodes.size else np.full(axes, -1.0)
    if not ((slopes >= 0.0) & ((slopes < arrays["bounds"][:, 0]) | (slopes == 0.0))).all():
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    return slopes
