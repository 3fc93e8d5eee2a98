"""Exact bounds by branch and bound over a slanted tree (see `_regressor`).

Node j of level l is row 2^l + j of `nodes`.

A node's points lie in a box along the rows of `frame`, the first of which, e, runs up the plane that all values follow:
y = m e p + r with r from rmin to rmax of the node. At the distance s from the box across e, and d along it, no cone
falls below `rmin + m e x + min over d of (m d + gamma sqrt(d^2 + s^2))`, which is least where d is
-m s / sqrt(gamma^2 - m^2) or at the box's end. With m near gamma that leaves out far more than the least y of the node
above the nearest point of its box. What rounding may do to such a number is taken off it, and cones are worked out from
the points as they are: the bounds are those of all points to the bit.
"""

import math

import numpy as np

# Times n + 8, beyond what so many rounded operations on numbers of one size make wrong: 2^-50, where one makes 2^-53.
SLANT_ROUNDING = 8.881784197001252e-16


def tree_cones(points: np.ndarray, first: int, count: int, gamma: float, x: np.ndarray, cones: np.ndarray) -> None:
    """Fill `cones` with gamma times the distance of x (n,) from `count` points from column `first` on, side by side.

    The sum of each point goes over its sides in their order, as a box's does.
    """
    for k in range(count):
        cones[k] = 0.0
    for i in range(x.shape[0]):
        value = x[i]
        side = points[i, first : first + count]  # of indices from 0 on numba makes vectors
        for k in range(count):
            gap = side[k] - value
            cones[k] += gap * gap
    for k in range(count):
        cones[k] = gamma * math.sqrt(cones[k])


def slant_children(
    nodes: np.ndarray, node: int, at: np.ndarray, plane: np.ndarray
) -> tuple[float, float, float, float]:
    """Return bounds on y + gamma d from below and on y - gamma d from above, for both children of a node.

    Args:
        nodes: rows (along low, along high, rmin, rmax, low of all other sides, high of them).
        node: the node.
        at: where, in the frame.
        plane: (m e x, m, m / sqrt(gamma^2 - m^2), gamma, what rounding may do).
    """
    sides = at.shape[0] - 1
    squared_a = 0.0
    squared_b = 0.0
    a = 2 * node
    b = 2 * node + 1
    for i in range(sides):
        x = at[1 + i]
        gap = max(max(nodes[a, 4 + i] - x, x - nodes[a, 4 + sides + i]), 0.0)
        squared_a += gap * gap
        gap = max(max(nodes[b, 4 + i] - x, x - nodes[b, 4 + sides + i]), 0.0)
        squared_b += gap * gap
    high_a, low_a = slant_child(nodes, a, squared_a, at[0], plane)
    high_b, low_b = slant_child(nodes, b, squared_b, at[0], plane)
    return high_a, low_a, high_b, low_b


def slant_child(nodes: np.ndarray, node: int, squared: float, along: float, plane: np.ndarray) -> tuple[float, float]:
    """Return `slant_children` of one child, whose box is at the root of `squared` across the plane's slope."""
    m = plane[1]
    gamma = plane[3]
    # The box along e, seen from x: d runs from start to stop.
    start = nodes[node, 0] - along
    stop = nodes[node, 1] - along
    # m s / sqrt(gamma^2 - m^2): upper cones are least at d = -best, lower ones largest at +best.
    best = plane[2] * math.sqrt(squared)
    # Convex in d: where the bottom lies outside of the box, the box's nearer end is least.
    d = min(max(-best, start), stop)
    high = nodes[node, 2] + plane[0] + (m * d + gamma * math.sqrt(d * d + squared)) - plane[4]
    d = min(max(best, start), stop)
    # The same upside down, with rmax; rounding is added, which again keeps the node rather than leaves it out.
    low = nodes[node, 3] + plane[0] + (m * d - gamma * math.sqrt(d * d + squared)) + plane[4]
    return high, low


def slant_leaf(
    points: np.ndarray,
    values: np.ndarray,
    first: int,
    count: int,
    gamma: float,
    x: np.ndarray,
    cones: np.ndarray,
    best: np.ndarray,
) -> None:
    """Tighten `best` (low, high) by the cones of `count` points from column `first` on; `cones` is room for them."""
    tree_cones(points, first, count, gamma, x, cones)
    low = best[0]
    high = best[1]
    there = values[first : first + count]
    for k in range(count):
        high = min(high, there[k] + cones[k])
        low = max(low, there[k] - cones[k])
    best[0] = low
    best[1] = high


def slant_bounds(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, frame: np.ndarray, gamma: float, x: np.ndarray
) -> tuple[float, float]:
    """Return max(y - gamma d) and min(y + gamma d) over `points` (n, N) in tree order and their `values` (N,)."""
    best = np.empty(4)
    best[0] = -np.inf
    best[1] = np.inf
    slant_search(points, values, nodes, frame, gamma, x, best)
    return best[0], best[1]


def slant_slopes(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, frame: np.ndarray, gamma: float, x: np.ndarray,
    near: np.ndarray, slopes: np.ndarray,
) -> None:  # fmt: skip
    """Fill `slopes` (2, n) with the derivatives of `slant_bounds`: the slopes of the two active cones.

    The bounds are piecewise smooth: where two cones meet, the first in the tree's order counts, and a cone's tip is
    moved by nothing.

    Args:
        points, values, nodes, frame, gamma, x: as of `slant_bounds`.
        near: (2,) bounds a little looser than those at x, so that little is searched; changed.
        slopes: (2, n).
    """
    best = np.empty(4)
    best[0] = near[0]
    best[1] = near[1]
    slant_search(points, values, nodes, frame, gamma, x, best)
    rows = values.shape[0]
    leaves = nodes.shape[0] // 2
    cones = np.empty(rows // leaves + 1)
    for side in range(2):
        sign = 2.0 * side - 1.0  # the lower bound is values less cones
        node = int(best[2 + side])
        first = (node - leaves) * rows // leaves
        count = (node + 1 - leaves) * rows // leaves - first
        tree_cones(points, first, count, gamma, x, cones)
        at = 0
        for k in range(count - 1, -1, -1):
            if sign * values[first + k] + cones[k] <= sign * values[first + at] + cones[at]:
                at = k
        over = sign * gamma * gamma / cones[at] if cones[at] > 0.0 else 0.0  # the cone is gamma |x - w|
        for i in range(x.shape[0]):
            slopes[side, i] = over * (x[i] - points[i, first + at])


def slant_search(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, frame: np.ndarray, gamma: float, x: np.ndarray,
    best: np.ndarray,
) -> None:  # fmt: skip
    """Tighten `best` (low, high) by the cones of all points; the next two entries are their leaves."""
    at = np.dot(frame, x)
    # The slope m and the size of points and values stand in the row that is no node.
    m = nodes[0, 0]
    size = nodes[0, 1]
    # Sums of magnitudes: no distance and no product with e is larger, so this is the size of what gets rounded.
    for i in range(x.shape[0]):
        size += abs(x[i])
    plane = np.empty(5)
    plane[0] = m * at[0]
    plane[1] = m
    # The tree keeps m at 0.98 gamma at most (`_MAX_SLOPE_RATIO`); m = 0 has no plane to follow.
    plane[2] = m / math.sqrt(gamma * gamma - m * m) if m > 0.0 else 0.0
    plane[3] = gamma
    plane[4] = (x.shape[0] + 8) * SLANT_ROUNDING * (gamma * size + nodes[0, 2])
    slant_descend(points, values, nodes, at, plane, gamma, x, best)


def slant_descend(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, at: np.ndarray, plane: np.ndarray, gamma: float,
    x: np.ndarray, best: np.ndarray,
) -> None:  # fmt: skip
    """Search the tree for `slant_search`, with `at` and `plane` of `slant_children`; written by hand in C."""
    rows = values.shape[0]
    leaves = nodes.shape[0] // 2
    best[2] = leaves
    best[3] = leaves
    # Left for later: one node a level at most, and 2^64 nodes are more than any memory holds.
    waiting = np.empty(64, dtype=np.int64)
    later = np.empty((64, 2))
    cones = np.empty(rows // leaves + 1)
    waiting[0] = 1
    later[0, 0] = -np.inf
    later[0, 1] = np.inf
    top = 1
    while top > 0:
        top -= 1
        node = waiting[top]
        high = later[top, 0]
        low = later[top, 1]
        # As long as a cone of this node may still tighten one of the bounds.
        while high < best[1] or low > best[0]:
            if node >= leaves:
                first = (node - leaves) * rows // leaves
                count = (node + 1 - leaves) * rows // leaves - first
                low = best[0]
                high = best[1]
                slant_leaf(points, values, first, count, gamma, x, cones, best)
                if best[0] > low:
                    best[2] = node
                if best[1] < high:
                    best[3] = node
                break
            high, low, other_high, other_low = slant_children(nodes, node, at, plane)
            node = 2 * node
            other = node + 1
            # The more promising child now, the other one later, if ever.
            if other_high - other_low < high - low:
                node, other = other, node
                high, other_high = other_high, high
                low, other_low = other_low, low
            # Bounds only get tighter: what cannot help now never will.
            if other_high < best[1] or other_low > best[0]:
                waiting[top] = other
                later[top, 0] = other_high
                later[top, 1] = other_low
                top += 1
