"""Likelihood of noise levels: the filter's own innovations over a recording (Schweppe 1965)."""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import KalmanArrays
from softneck.estimation._kalman_runtime import KalmanFullState, step
from softneck.estimation._kalman_runtime import initialise as initialise
from softneck.estimation._nonlinear_parts_runtime import nonlinear_grow, nonlinear_update


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
    missed: np.ndarray, motion: np.ndarray, walked: np.ndarray, noise: float, timing: np.ndarray, start: int
) -> float:
    """Return sum of log det S + e' S^-1 e over the measured rows (time, m) of `missed`, NaN elsewhere, from `start` on.

    `motion` (time, m) of the model in a sample; `walked` (time,) is added to the disturbance's variance before each
    row; `timing`: its variance at the start, that of the timing error, and what a sample keeps of this.
    """
    m = missed.shape[1]
    told, P, none = np.zeros(2 * m), np.zeros(4 * m * m), np.zeros(m)
    for i in range(m):
        P[i * 2 * m + i] = timing[0]
        P[(m + i) * 2 * m + m + i] = timing[1]
    total = 0.0
    for k in range(missed.shape[0]):
        told[m:] *= timing[2]
        nonlinear_grow(P, m, 2 * m, walked[k], timing[1], timing[2])
        if np.isfinite(missed[k]).all():
            innovation, log_det = nonlinear_update(P, told, motion[k], none, missed[k], noise)
            if k >= start:
                total += log_det + innovation
    return total
