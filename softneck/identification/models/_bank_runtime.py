"""A drive that stalls under load, and a bank of play operators and low-pass filters behind it.

Drive: `m_j` moves towards its delayed set-point as a first-order lag does, but no further than
`c + c1 (q_j - mean q) + c2 mean q`, where q is m behind a low-pass: a drive that pulls against its current limit
gets as far as the tension lets it, and the tension is set by how the neck hangs, which follows m. It never moves
away from its set-point, so it stays between the set-points it was given.
load = [pole of q, c, c1, c2].

Bank: each redefined input (theta, phi, delta) as it is and behind play operators (Visintin 1994, sec. III.2), and
each of those through `order` equal low-pass filters: order * c * (1 + widths) signals for c redefined inputs (three of
a neck), all of them between the least and the largest input ever given.
"""

import numpy as np

from softneck.runtime._rest_runtime import REST


def drive_limit(load: np.ndarray, q: float, mean: float) -> float:
    """Return how far a motor gets under the load of now: its own q, and the mean of all."""
    # What one motor pulls beyond the others bends the neck, what all pull presses it together: two slopes of tension.
    return load[1] + load[2] * (q - mean) + load[3] * mean


def drive_advance(pole: float, target: float, m: float, limit: float) -> float:
    """Return the motor's next position: a lag, stopped at the limit but never driven back by it."""
    return min(pole * m + (1.0 - pole) * target, max(limit, m))


def load_advance(load: np.ndarray, m: np.ndarray, q: np.ndarray) -> None:
    """Let q follow m (3,)."""
    for j in range(q.shape[0]):
        q[j] = (load[0] * q[j] + (1.0 - load[0]) * m[j] + REST) - REST


def bank_advance(
    redefinition: np.ndarray, widths: np.ndarray, chain: np.ndarray, m: np.ndarray, plays: np.ndarray, bank: np.ndarray
) -> None:
    """Move `plays` (c widths,) to m(k), and `bank` (c (1 + widths) order,) to k+1; chain = [pole, order].

    c is the number of redefined inputs, the rows of `redefinition` (c, motors).
    """
    n = int(chain[1])
    count = widths.shape[0]
    for c in range(redefinition.shape[0]):
        v = 0.0
        # Eq. 9-11: theta, phi, delta.
        for j in range(redefinition.shape[1]):
            v += redefinition[c, j] * m[j]
        for i in range(count + 1):
            x = v
            if i > 0:
                at = c * count + i - 1
                # The play follows v at its width and stands still within.
                plays[at] = max(v - widths[i - 1], min(v + widths[i - 1], plays[at]))
                x = plays[at]
            first = (c * (count + 1) + i) * n
            # Last filter first: each takes what the one before it held a sample ago.
            for o in range(n - 1, 0, -1):
                before = bank[first + o - 1]
                bank[first + o] = (chain[0] * bank[first + o] + (1.0 - chain[0]) * before + REST) - REST
            bank[first] = (chain[0] * bank[first] + (1.0 - chain[0]) * x + REST) - REST


def monomial(table: np.ndarray, row: int, bank: np.ndarray) -> float:
    """Return the product of the signals that a row of `table` (n, 3) names; -1 stands for 1."""
    value = 1.0
    # Up to three factors: terms of degree three at most.
    for i in range(3):
        at = int(table[row, i])
        if at >= 0:
            value *= bank[at]
    return value
