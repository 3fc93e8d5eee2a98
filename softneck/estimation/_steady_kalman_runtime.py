"""Kalman filter with constant gains: no covariance to carry, and little to compute."""

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GATE,
    KalmanArrays,
    KalmanState,
    kalman_ahead,
    kalman_clear,
    kalman_count,
    kalman_dot,
    kalman_first,
    kalman_forced,
    kalman_push,
    kalman_row,
    kalman_tell,
    kalman_usable,
)
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class SteadyKalmanArrays(KalmanArrays):
    """K and S^-1 when measurements came for long, at the start, and where one is taken in by force."""

    gain = array("n, outputs", "K in steady state")
    inverse_spread = array("outputs, outputs", "S^-1 in steady state")
    start_gain = array("n, outputs", "while inputs from before the start are on their way")
    start_inverse_spread = array("outputs, outputs", "S^-1 then")
    forced_gain = array("n, outputs", "by force")
    forced_inverse_spread = array("outputs, outputs", "S^-1 then")


def initialise(p: SteadyKalmanArrays, parameters: np.ndarray, x: KalmanState, outputs: np.ndarray) -> None:
    """Start at rest with no measurement accepted yet."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0


def step(
    p: SteadyKalmanArrays, parameters: np.ndarray, x: KalmanState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Predict, then correct by the constant gain where there is a credible measurement; ports as of the full filter.

    parameters: the measurement noise, which only tells a frozen sensor from a noise-free one.
    """
    c = p.constants
    m = p.outputs
    u = np.empty(m)
    kalman_push(p, x, inputs, u)
    first = kalman_first(p, inputs)
    usable = kalman_usable(c, x, inputs[first : first + m], float(inputs[first + m]), parameters[0])
    forced = kalman_forced(c, x)
    # Two gains more stand for what the full filter adds to P.
    K, SI = p.gain, p.inverse_spread
    if x.samples < p.length:
        K, SI = p.start_gain, p.start_inverse_spread
    elif forced:
        K, SI = p.forced_gain, p.forced_inverse_spread
    estimate = kalman_ahead(p.F, x.x, p.B, u)
    innovation, accepted = 0.0, False
    if usable:
        e = inputs[first : first + m] - kalman_dot(p.H, estimate)
        # e' S^-1 e, S of these noise levels: the gate is that of the full filter.
        for i in range(m):
            innovation += SI[i, i] * e[i] * e[i]
            for j in range(i + 1, m):
                innovation += (SI[i, j] + SI[j, i]) * e[i] * e[j]
        accepted = forced or innovation <= c[KALMAN_GATE]
        if accepted:
            for i in range(p.n):
                estimate[i] += kalman_row(K, i, e)  # x = x- + K e
    x.x[:] = (estimate + REST) - REST
    kalman_count(c, x, usable, accepted)
    kalman_tell(p, x, parameters[0], outputs)
    outputs[2 * m] = innovation
    x.samples += 1.0
