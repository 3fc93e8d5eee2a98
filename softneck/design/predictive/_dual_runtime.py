"""A dual active-set method for `min 1/2 z'Hz + f'z, lower <= A z <= upper`, warm started, with H and A fixed.

With z0 = -H^-1 f the optimum is z = z0 - H^-1 A' w, where w, the multipliers, is positive at an upper and negative
at a lower bound. All that the method needs of H and A is `G = A H^-1 A'` and `c = A z0`: the rows' values are c - G w.
Rows are added one by one, the most violated first, and dropped when their multiplier would change sign
(Goldfarb and Idnani 1983, Mathematical Programming 27:1). The factor of the active part of G is a Cholesky factor
to which a row is appended in O(k^2); after a row is dropped it is made anew from there on.
"""

import math

import numpy as np

# A row whose part outside of the active ones is below this share of it depends on them.
QP_DEPENDENT = 1e-10
QP_FAILED = -1
QP_INFEASIBLE = -2


def qp_append(G: np.ndarray, rows: np.ndarray, L: np.ndarray, k: int, p: int) -> bool:
    """Append row p to the `k` active ones and their factor; return false if it depends on them."""
    # Row p of the factor: L l = G_Wp; `square` is left of G_pp, what of row p the active rows do not span.
    square = G[p, p]
    for i in range(k):
        value = G[p, rows[i]]
        for j in range(i):
            value -= L[i, j] * L[k, j]
        L[k, i] = value / L[i, i]
        square -= L[k, i] * L[k, i]
    if square <= QP_DEPENDENT * G[p, p]:
        return False
    L[k, k] = math.sqrt(square)
    rows[k] = p
    return True


def qp_remove(G: np.ndarray, rows: np.ndarray, L: np.ndarray, lam: np.ndarray, k: int, at: int) -> int:
    """Take out active row `at` with its multiplier; return the number that is left."""
    for i in range(at, k - 1):
        rows[i] = rows[i + 1]
        lam[i] = lam[i + 1]
    # The factor above `at` stands; the rows behind are appended to it anew.
    left = at
    for i in range(at, k - 1):
        lam[left] = lam[i]
        if qp_append(G, rows, L, left, rows[i]):
            left += 1
    return left


def qp_backward(L: np.ndarray, k: int, x: np.ndarray) -> None:
    """Solve L L' x = x in place."""
    for i in range(k):
        value = x[i]
        for j in range(i):
            value -= L[i, j] * x[j]
        x[i] = value / L[i, i]
    for i in range(k - 1, -1, -1):
        value = x[i]
        for j in range(i + 1, k):
            value -= L[j, i] * x[j]
        x[i] = value / L[i, i]


def qp_multipliers(
    c: np.ndarray, lower: np.ndarray, upper: np.ndarray, sign: np.ndarray, rows: np.ndarray, L: np.ndarray,
    k: int, lam: np.ndarray,
) -> None:  # fmt: skip
    """Fill `lam` with the multipliers that hold the active rows at their bounds."""
    for i in range(k):
        p = rows[i]
        lam[i] = c[p] - (upper[p] if sign[p] > 0.0 else lower[p])
    qp_backward(L, k, lam)


def qp_start(
    G: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray, sign: np.ndarray, rows: np.ndarray,
    L: np.ndarray, lam: np.ndarray,
) -> int:  # fmt: skip
    """Activate the rows that `sign` proposes, as far as their multipliers have the right sign; return their number."""
    k = 0
    for p in range(sign.shape[0]):
        if sign[p] != 0.0:
            # At most as many rows as variables; and a side without a bound is none to stand on.
            bound = upper[p] if sign[p] > 0.0 else lower[p]
            if k < rows.shape[0] and abs(bound) < 1e20 and qp_append(G, rows, L, k, p):
                k += 1
            else:
                sign[p] = 0.0
    while k > 0:
        qp_multipliers(c, lower, upper, sign, rows, L, k, lam)
        # The most wrong multiplier's row goes, one at a time: the others change when it does.
        worst = 0.0
        at = -1
        for i in range(k):
            wrong = -lam[i] * sign[rows[i]]
            if wrong > worst:
                worst = wrong
                at = i
        if at < 0:
            return k
        sign[rows[at]] = 0.0
        before = k
        k = qp_remove(G, rows, L, lam, before, at)
    return 0


def qp_worst(
    r: np.ndarray, lower: np.ndarray, upper: np.ndarray, sign: np.ndarray, tolerance: float
) -> tuple[int, float]:
    """Return the row furthest beyond its bound, with the side as the sign of how far; (-1, 0) if there is none."""
    at = -1
    far = tolerance
    side = 0.0
    for p in range(r.shape[0]):
        if sign[p] == 0.0:  # active rows stand on their bounds
            if r[p] - upper[p] > far:
                far = r[p] - upper[p]
                at = p
                side = 1.0
            elif lower[p] - r[p] > far:
                far = lower[p] - r[p]
                at = p
                side = -1.0
    return at, side * far if at >= 0 else 0.0


def qp_solve(
    G: np.ndarray, c: np.ndarray, lower: np.ndarray, upper: np.ndarray, sign: np.ndarray, multipliers: np.ndarray,
    budget: int, tolerance: float, rank: int,
) -> int:  # fmt: skip
    """Solve; return the iterations, or QP_FAILED when `budget` did not do or QP_INFEASIBLE.

    Args:
        G: (m, m); c: (m,) values of the rows at z0.
        lower, upper: (m,) bounds; +-1e30 for none.
        sign: (m,) in: which rows may be active, +1 at the upper, -1 at the lower bound; out: which are.
        multipliers: (m,) out.
        budget: largest number of rows added and dropped.
        tolerance: by which a row may be beyond its bound.
        rank: number of variables, the most rows that can be active.
    """
    m = c.shape[0]
    rows = np.zeros(rank + 1, dtype=np.int64)
    L = np.zeros((rank + 1, rank + 1))
    lam = np.zeros(rank + 1)
    w = np.zeros(rank + 1)
    r = np.empty(m)
    multipliers[:] = 0.0
    k = qp_start(G, c, lower, upper, sign, rows, L, lam)
    iterations = 0
    while True:
        # r = c - G w.
        r[:] = c
        for i in range(k):
            for p in range(m):
                r[p] -= G[rows[i], p] * lam[i]
        p, far = qp_worst(r, lower, upper, sign, tolerance)
        if p < 0:
            break
        s = 1.0 if far > 0.0 else -1.0
        far = abs(far)
        mine = 0.0
        while True:
            iterations += 1
            if iterations > budget:
                return QP_FAILED
            # G_WW w = G_Wp: as row p's multiplier grows by s t, those of the active rows fall by s t w.
            for i in range(k):
                w[i] = G[rows[i], p]
            qp_backward(L, k, w)
            # How fast row p comes back by it: the Schur complement of G_WW.
            curve = G[p, p]
            for i in range(k):
                curve -= G[rows[i], p] * w[i]
            # The step at which row p is on its bound; never, if it depends on the active rows.
            full = far / curve if curve > QP_DEPENDENT * G[p, p] else 1e300
            # The step at which the first multiplier of an active row would change sign.
            part = 1e300
            at = -1
            for i in range(k):
                falls = s * w[i] * sign[rows[i]]
                if falls > 0.0 and abs(lam[i]) < part * falls:
                    part = abs(lam[i]) / falls
                    at = i
            t = min(full, part)
            # Neither: the active rows contradict row p.
            if t >= 1e300:
                return QP_INFEASIBLE
            for i in range(k):
                lam[i] -= s * t * w[i]
            mine += s * t
            far -= t * curve
            if full <= part:
                if k >= rank or not qp_append(G, rows, L, k, p):
                    return QP_FAILED
                lam[k] = mine
                sign[p] = s
                k += 1
                break
            # The row that blocks goes; row p keeps what its multiplier has gained.
            sign[rows[at]] = 0.0
            k = qp_remove(G, rows, L, lam, k, at)
    # From the bounds anew: what the steps have added up to is off by their rounding.
    qp_multipliers(c, lower, upper, sign, rows, L, k, lam)
    for i in range(k):
        multipliers[rows[i]] = lam[i]
    return iterations
