"""The smallest gamma that a data set allows (Eq. 16-20; Milanese and Novara 2004), by branch and bound."""

import math

import numpy as np


def gamma_gap(nodes: np.ndarray, a: int, b: int, n: int) -> float:
    """Return the distance between the boxes of two nodes of a kd-tree over n sides, 0 where they meet."""
    squared = 0.0
    for i in range(n):
        # Negative where the boxes overlap along this side: then it adds nothing to the distance.
        gap = max(nodes[a, 2 * i] - nodes[b, 2 * i + 1], nodes[b, 2 * i] - nodes[a, 2 * i + 1])
        if gap > 0.0:
            squared += gap * gap
    return math.sqrt(squared)


def gamma_allowed(distance: float, slacks: np.ndarray, gammas: np.ndarray) -> float:
    """Return how far apart outputs may be at this distance before any of the gammas (m,) is too small.

    That is the least `slack + gamma distance`. Each gamma is the largest of the same falling lines in its slack, so
    the sum is convex over rising slacks and its bottom is found by halving.
    """
    first = 0
    last = slacks.shape[0] - 1
    while first < last:
        middle = (first + last) // 2
        if slacks[middle] + gammas[middle] * distance <= slacks[middle + 1] + gammas[middle + 1] * distance:
            last = middle
        else:
            first = middle + 1
    # Less some rounding: what is left out then needs no gamma above those found, to the last bit.
    return (1.0 - 1e-14) * (slacks[first] + gammas[first] * distance)


def gamma_need(rise: float, slack: float, distance: float) -> float:
    """Return the gamma that two outputs `rise` apart need; beyond 1e200 where the points are equal."""
    return min((rise - slack) / max(distance, 1e-300), 1e300)


def gamma_leaves(
    points: np.ndarray,
    values: np.ndarray,
    nodes: np.ndarray,
    leaves: tuple[int, int],
    slacks: np.ndarray,
    gammas: np.ndarray,
    pairs: np.ndarray,
) -> None:
    """Raise the gammas to the need of all pairs between two leaves."""
    rows = values.shape[0]
    n = points.shape[0]
    # The second half of `nodes` is the last level; its leaves share the columns evenly (see `borders` in `_regressor`).
    count = nodes.shape[0] // 2
    a = leaves[0] - count
    b = leaves[1]
    first = (b - count) * rows // count
    last = (b + 1 - count) * rows // count
    for j in range(a * rows // count, (a + 1) * rows // count):
        # The point against the whole leaf first: one distance may do for all of its points.
        squared = 0.0
        for i in range(n):
            gap = max(max(nodes[b, 2 * i] - points[i, j], points[i, j] - nodes[b, 2 * i + 1]), 0.0)
            squared += gap * gap
        # Gammas only rise, so what this says stays on the safe side.
        allowed = gamma_allowed(math.sqrt(squared), slacks, gammas)
        # The furthest that any value of the leaf may be from this one.
        if max(nodes[b, 2 * n + 1] - values[j], values[j] - nodes[b, 2 * n]) <= allowed:
            continue
        for k in range(first, last):
            rise = abs(values[j] - values[k])
            # `allowed` is that of the nearest the leaf comes to the point: a pair within it needs no root.
            if rise <= allowed:
                continue
            squared = 0.0
            for i in range(n):
                gap = points[i, j] - points[i, k]
                squared += gap * gap
            distance = math.sqrt(squared)
            if rise <= gamma_allowed(distance, slacks, gammas):
                continue
            for m in range(slacks.shape[0]):
                needed = gamma_need(rise, slacks[m], distance)
                if needed > gammas[m]:
                    gammas[m] = needed
                    pairs[m, 0] = j
                    pairs[m, 1] = k


def gamma_search(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, slacks: np.ndarray, gammas: np.ndarray, pairs: np.ndarray
) -> None:
    """Find the smallest gammas with `|y_j - y_k| <= slack + gamma |w_j - w_k|` for all pairs.

    Args:
        points: (n, N) in tree order.
        values: (N,).
        nodes: see `_regressor`.
        slacks: (m,) rising: epsilon for the paper's rule f_u(i) >= y(i), 2 epsilon for Milanese and Novara's.
        gammas: (m,) zeros; become the result, beyond 1e200 where equal points are further apart than the slack.
        pairs: (m, 2) become the pairs that decide.
    """
    n = points.shape[0]
    leaves = nodes.shape[0] // 2
    # Neighbours need the largest gammas: the more of them are known, the less is left to search.
    for leaf in range(leaves):
        gamma_leaves(points, values, nodes, (leaves + leaf, leaves + leaf), slacks, gammas, pairs)
    # Pairs of nodes of one level, at most 3 left for later at each of at most 64 levels.
    waiting = np.empty((256, 2), dtype=np.int64)
    waiting[0, 0] = 1
    waiting[0, 1] = 1
    top = 1
    while top > 0:
        top -= 1
        a = waiting[top, 0]
        b = waiting[top, 1]
        # The most that outputs of two nodes differ by, at the least that their points are apart: no pair asks for more.
        rise = max(nodes[a, 2 * n + 1] - nodes[b, 2 * n], nodes[b, 2 * n + 1] - nodes[a, 2 * n])
        nearest = gamma_gap(nodes, a, b, n)
        if rise <= gamma_allowed(nearest, slacks, gammas):
            continue
        if a >= leaves:
            # Leaves with themselves were done above.
            if a != b:
                gamma_leaves(points, values, nodes, (a, b), slacks, gammas, pairs)
            continue
        # The last pushed is the first taken: a node with itself first.
        for p in range(2):
            for q in range(2):
                # A node with itself has its two children as a pair once only.
                if a != b or p < q:
                    waiting[top, 0] = 2 * a + p
                    waiting[top, 1] = 2 * b + q
                    top += 1
        if a == b:
            for p in range(2):
                waiting[top, 0] = 2 * a + p
                waiting[top, 1] = 2 * a + p
                top += 1
