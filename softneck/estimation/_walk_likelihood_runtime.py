"""Likelihood of a random walk measured with noise: a Kalman filter with one variance (Schweppe 1965)."""

import math

import numpy as np


def walk_cost(
    missed: np.ndarray, came: np.ndarray, walked: np.ndarray, noise: float, variance: float, start: int
) -> float:
    """Return sum of m log S + e' e / S over the measured rows (time, m), from row `start` on.

    `walked` (time,) is added to the variance before each row, `variance` is the initial one, `noise` the measurement's.
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
