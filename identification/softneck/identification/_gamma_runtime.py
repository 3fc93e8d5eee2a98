"""The least gamma that a data set allows (Eq. 16-20; Milanese and Novara 2004), by branch and bound over pairs."""

import math

import numpy as np


def gamma_gap(nodes: np.ndarray, a: int, b: int, n: int) -> float:
    """Return the distance between the boxes of two nodes of a kd-tree over n sides, 0 where they meet."""
    squared = 0.0
    for i in range(n):
        gap = max(nodes[a, 2 * i] - nodes[b, 2 * i + 1], nodes[b, 2 * i] - nodes[a, 2 * i + 1])
        if gap > 0.0:
            squared += gap * gap
    return math.sqrt(squared)


def gamma_allowed(distance: float, slacks: np.ndarray, gammas: np.ndarray) -> float:
    """Return how far apart outputs may be at this distance before any of the gammas (m,) is too small."""
    allowed = np.inf
    for m in range(slacks.shape[0]):
        allowed = min(allowed, slacks[m] + gammas[m] * distance)
    return allowed


def gamma_leaves(
    points: np.ndarray,
    values: np.ndarray,
    leaves: tuple[int, int, int],
    nearest: float,
    slacks: np.ndarray,
    gammas: np.ndarray,
    pairs: np.ndarray,
) -> None:
    """Raise the gammas to what the pairs between two leaves need; `leaves` is (a, b, how many there are)."""
    rows = values.shape[0]
    a, b, count = leaves
    # Gammas only rise, so what this says stays on the safe side.
    allowed = gamma_allowed(nearest, slacks, gammas)
    for j in range(a * rows // count, (a + 1) * rows // count):
        for k in range(b * rows // count, (b + 1) * rows // count):
            rise = abs(values[j] - values[k])
            if rise <= allowed:
                continue
            squared = 0.0
            for i in range(points.shape[0]):
                gap = points[i, j] - points[i, k]
                squared += gap * gap
            distance = math.sqrt(squared)
            for m in range(slacks.shape[0]):
                needed = (rise - slacks[m]) / max(distance, 1e-300)
                if needed > gammas[m]:
                    gammas[m] = needed
                    pairs[m, 0] = j
                    pairs[m, 1] = k


def gamma_search(
    points: np.ndarray, values: np.ndarray, nodes: np.ndarray, slacks: np.ndarray, gammas: np.ndarray, pairs: np.ndarray
) -> None:
    """Find the least gammas with `|y_j - y_k| <= slack + gamma |w_j - w_k|` for all pairs.

    Args:
        points: (n, N) in tree order.
        values: (N,).
        nodes: see `_tree`.
        slacks: (m,) epsilon for the paper's rule f_u(i) >= y(i), 2 epsilon for Milanese and Novara's.
        gammas: (m,) zeros; become the result, beyond 1e200 where equal points are further apart than the slack.
        pairs: (m, 2) become the pairs that decide.
    """
    n = points.shape[0]
    leaves = nodes.shape[0] // 2
    # Neighbours need the largest gammas: the more of them are known, the less is left to search.
    for leaf in range(leaves):
        gamma_leaves(points, values, (leaf, leaf, leaves), 0.0, slacks, gammas, pairs)
    # Pairs of nodes of one level, at most 3 left for later at each of at most 64 levels.
    waiting = np.empty((256, 2), dtype=np.int64)
    waiting[0, 0] = 1
    waiting[0, 1] = 1
    top = 1
    while top > 0:
        top -= 1
        a = waiting[top, 0]
        b = waiting[top, 1]
        rise = max(nodes[a, 2 * n + 1] - nodes[b, 2 * n], nodes[b, 2 * n + 1] - nodes[a, 2 * n])
        nearest = gamma_gap(nodes, a, b, n)
        if rise <= gamma_allowed(nearest, slacks, gammas):
            continue
        if a >= leaves:
            if a != b:
                gamma_leaves(points, values, (a - leaves, b - leaves, leaves), nearest, slacks, gammas, pairs)
            continue
        # The last pushed is the first taken: a node with itself first.
        for p in range(2):
            for q in range(2):
                if a != b or p < q:
                    waiting[top, 0] = 2 * a + p
                    waiting[top, 1] = 2 * b + q
                    top += 1
        if a == b:
            for p in range(2):
                waiting[top, 0] = 2 * a + p
                waiting[top, 1] = 2 * a + p
                top += 1
