"""Likelihood of a walk that is seen through noise: Kalman's filter of one variance in all outputs (Schweppe 1965)."""

import math

import numpy as np


def walk_cost(
    missed: np.ndarray, came: np.ndarray, walked: np.ndarray, noise: float, variance: float, start: int
) -> float:
    """Return sum of m log S + e' e / S over the rows (time, m) that came, from row `start` on.

    walked: (time,) by how much the variance grows before each row; `variance` it has before the first; `noise` is the
    measurement's.
    """
    m = missed.shape[1]
    said = np.zeros(m)
    total = 0.0
    for k in range(missed.shape[0]):
        variance += walked[k]
        if came[k]:
            S = variance + noise
            error = 0.0
            for i in range(m):
                e = missed[k, i] - said[i]
                error += e * e / S
                said[i] += variance / S * e
            if k >= start:
                total += m * math.log(S) + error
            variance *= noise / S
    return total
