"""Kalman filter with constant gains: no covariance to carry, and little to compute.

State vector: x (n,), lines of past inputs (2, length), tail (see `_kalman_parts_runtime`). Arrays 9 to 14 are gain
(n, 2) and inverse innovation covariance (2, 2) in steady state, at the start, and when taking in by force.
"""

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GATE,
    KALMAN_REJECTIONS,
    KALMAN_TAIL,
    kalman_ahead,
    kalman_clear,
    kalman_count,
    kalman_dot,
    kalman_frozen,
    kalman_line_length,
    kalman_push,
    kalman_tell,
    kalman_usable,
)


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return arrays[0].shape[0] + 2 * kalman_line_length(arrays[8]) + KALMAN_TAIL


def initialise(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start at rest with no measurement accepted yet."""
    state[:] = 0.0
    kalman_clear(arrays[8], state)
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Predict, then correct by the constant gain where there is a credible measurement; ports as of the full filter.

    parameters: the measurement noise, which only tells a frozen sensor from a noise-free one.
    """
    F, B, H, c = arrays[0], arrays[1], arrays[2], arrays[8]
    n = F.shape[0]
    length = kalman_line_length(c)
    u = np.empty(2)
    kalman_push(arrays, state, inputs, length, u)
    usable = kalman_usable(c, state, inputs, parameters[0])
    forced = state[-2] >= c[KALMAN_REJECTIONS]
    K, SI = arrays[9], arrays[10]
    if state[-1] < length:
        K, SI = arrays[11], arrays[12]
    elif forced:
        K, SI = arrays[13], arrays[14]
    x = kalman_ahead(F, state[:n], B, u)
    innovation, accepted = 0.0, False
    if usable:
        y = kalman_dot(H, x)
        e0, e1 = inputs[3] - y[0], inputs[4] - y[1]
        innovation = SI[0, 0] * e0 * e0 + (SI[0, 1] + SI[1, 0]) * e0 * e1 + SI[1, 1] * e1 * e1
        accepted = forced or innovation <= c[KALMAN_GATE]
        if accepted:
            x += e0 * K[:, 0] + e1 * K[:, 1]
    state[:n] = x
    kalman_count(c, state, usable, accepted)
    kalman_tell(arrays, state, kalman_frozen(c, state, parameters[0]), length, outputs)
    outputs[4] = innovation
    state[-1] += 1.0
