"""Likelihood of noise levels: the filter's own innovations over a recording (Schweppe 1965)."""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import KalmanArrays
from softneck.estimation._kalman_runtime import KalmanFullState, step
from softneck.estimation._kalman_runtime import initialise as initialise


def kalman_cost(
    p: KalmanArrays, parameters: np.ndarray, x: KalmanFullState, inputs: np.ndarray, start: int
) -> tuple[float, int]:
    """Return sum of log det S + e' S^-1 e over the measurements from row `start` on, and their number.

    The arrays' gate must be open: with a gate, zero noise would fit the remaining measurements best.
    """
    outputs = np.zeros(2 * p.outputs + 2)
    total, count = 0.0, 0
    for k in range(inputs.shape[0]):
        # A step without a measurement leaves it.
        x.log_det = np.nan
        step(p, parameters, x, inputs[k], outputs)
        if k >= start and not math.isnan(x.log_det):
            # -2 log L but for a constant: e' S^-1 e is the output `innovation`.
            total += float(x.log_det + outputs[2 * p.outputs])
            count += 1
    return total, count


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
