"""Simulation of a continuous-time system with a held, delayed input, and of a filter of errors linear between samples.

State (3n,): x of `x' = A x + e u(t - L)`, z of `z' = A z`, w of `w' = A w + e (C x + z_1)`, all in controllable form,
e the last unit vector: x_j = s^j/A u, w_j = s^j/A yhat.
"""

import numpy as np


def ct_simulate(
    transition: np.ndarray,
    old: np.ndarray,
    new: np.ndarray,
    inputs: np.ndarray,
    delay: int,
    start: np.ndarray,
    states: np.ndarray,
) -> None:
    """Fill `states` (time, m) from `start` (m,); the input acts `delay` samples late, and one more until L is over.

    `transition` (m, m) is over one sample; `old` (m,) weighs u(k - delay - 1) and `new` (m,) u(k - delay).
    """
    m = start.shape[0]
    states[0] = start
    # With a delay between two samples the input changes within the step: `old` acts before, `new` after the change.
    for k in range(states.shape[0] - 1):
        first = inputs[max(k - delay - 1, 0)]  # before the record the first input was held
        second = inputs[max(k - delay, 0)]
        for i in range(m):
            value = old[i] * first + new[i] * second
            for j in range(m):
                value += transition[i, j] * states[k, j]
            states[k + 1, i] = value


def ct_filter(
    transition: np.ndarray, now: np.ndarray, ahead: np.ndarray, errors: np.ndarray, states: np.ndarray
) -> None:
    """Fill `states` (time, n) with the response from zero to `errors` (time,) joined by straight lines."""
    n = now.shape[0]
    states[0] = 0.0
    for k in range(states.shape[0] - 1):
        for i in range(n):
            # Exact for errors that run straight from one sample to the next.
            value = now[i] * errors[k] + ahead[i] * errors[k + 1]
            for j in range(n):
                value += transition[i, j] * states[k, j]
            states[k + 1, i] = value
