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
    kalman_forced,
    kalman_push,
    kalman_tell,
    kalman_usable,
)
from softneck.runtime._layout import array
from softneck.runtime._rest_runtime import REST


class SteadyKalmanArrays(KalmanArrays):
    """K and S^-1 when measurements came for long, at the start, and where one is taken in by force."""

    gain = array("n, 2", "K in steady state")
    inverse_spread = array("2, 2", "S^-1 in steady state")
    start_gain = array("n, 2", "while inputs from before the start are on their way")
    start_inverse_spread = array("2, 2", "S^-1 then")
    forced_gain = array("n, 2", "by force")
    forced_inverse_spread = array("2, 2", "S^-1 then")


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
    u = np.empty(2)
    kalman_push(p, x, inputs, u)
    usable = kalman_usable(c, x, inputs, parameters[0])
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
        y = kalman_dot(p.H, estimate)
        e0, e1 = inputs[3] - y[0], inputs[4] - y[1]
        # e' S^-1 e, S of these noise levels: the gate is that of the full filter.
        innovation = SI[0, 0] * e0 * e0 + (SI[0, 1] + SI[1, 0]) * e0 * e1 + SI[1, 1] * e1 * e1
        accepted = forced or innovation <= c[KALMAN_GATE]
        if accepted:
            estimate += e0 * K[:, 0] + e1 * K[:, 1]  # x = x- + K e
    x.x[:] = (estimate + REST) - REST
    kalman_count(c, x, usable, accepted)
    kalman_tell(p, x, parameters[0], outputs)
    outputs[4] = innovation
    x.samples += 1.0
