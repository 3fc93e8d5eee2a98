"""Drives that stall under load, and a bank of play operators and low-pass filters driven by them.

Drive: `m_j` moves towards its delayed set-point as a first-order lag, but no further than
`c + c1 (q_j - mean q) + c2 mean q`, where q is m after a low-pass: a drive at its current limit stalls at a tension,
which depends on the pose of the neck and so on m. It never moves away from its set-point.
load = [pole of q, c, c1, c2]. With two numbers more, poles of a valve that fills and vents a chamber at different
speeds, m_j is the pressure that follows its set-point, with the first pole upwards and the second downwards.

Bank: each redefined input (theta, phi, delta) directly and through play operators (Visintin 1994, sec. III.2), each of
these through `order` equal low-pass filters. The order * c * (1 + widths) signals for c redefined inputs stay between
the smallest and the largest input.
"""

import numpy as np

from softneck.runtime._rest_runtime import REST


def drive_limit(load: np.ndarray, q: float, mean: float) -> float:
    """Return the largest position of a motor under the present load, from its own q and the mean of all."""
    # Differences between motors bend the neck, their mean compresses it: two slopes of tension.
    return load[1] + load[2] * (q - mean) + load[3] * mean


def drive_advance(pole: float, target: float, m: float, limit: float) -> float:
    """Return the motor's next position by its lag, stopped at the limit but never moved back by it."""
    return min(pole * m + (1.0 - pole) * target, max(limit, m))


def valve_advance(load: np.ndarray, target: float, m: float) -> float:
    """Return the next pressure of a chamber, which fills towards a higher target and vents towards a lower one."""
    return m + (1.0 - load[4]) * max(target - m, 0.0) + (1.0 - load[5]) * min(target - m, 0.0)


def load_advance(load: np.ndarray, m: np.ndarray, q: np.ndarray) -> None:
    """Update q by the low-pass of m (3,)."""
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
    """Return the product of the signals with the indices in a row of `table` (n, 3); -1 means a factor of 1."""
    value = 1.0
    # Up to three factors: terms of degree three at most.
    for i in range(3):
        at = int(table[row, i])
        if at >= 0:
            value *= bank[at]
    return value
