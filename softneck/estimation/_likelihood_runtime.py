"""Likelihood of noise levels: the filter's own innovations over a recording (Schweppe 1965)."""

import math

import numpy as np

from softneck.estimation._kalman_runtime import step


def kalman_cost(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray, start: int
) -> tuple[float, int]:
    """Return sum of log det S + e' S^-1 e over the measurements from row `start` on, and their number.

    The arrays' gate must be open: with a gate, no noise at all would be the best fit to what is left.
    """
    outputs = np.zeros(6)
    total, count = 0.0, 0
    for k in range(inputs.shape[0]):
        state[-9] = np.nan
        step(arrays, parameters, state, inputs[k], outputs)
        if k >= start and not math.isnan(state[-9]):
            total += state[-9] + outputs[4]
            count += 1
    return total, count
