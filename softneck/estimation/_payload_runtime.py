"""The observer over a model with a payload parameter: two copies of it, and the payload as a further state."""

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_LAG,
    kalman_clear,
    kalman_count,
    kalman_forced,
    kalman_healthy,
    kalman_usable,
)
from softneck.estimation._nonlinear_parts_runtime import (
    NONLINEAR_START,
    NONLINEAR_TIMING,
    NONLINEAR_TIMING_KEEP,
    PAYLOAD_LEAST,
    PAYLOAD_MOST,
    PAYLOAD_WALK,
    NonlinearArrays,
    NonlinearState,
    nonlinear_correct,
    nonlinear_faster,
    nonlinear_move,
    nonlinear_settle,
    nonlinear_slew,
    nonlinear_tell,
    nonlinear_widen,
)
from softneck.runtime._members_runtime import member_size

# Difference of the payload between both copies [kg]: far above rounding, and small beside the curvature.
PAYLOAD_STEP = 0.02


def state_size(p: NonlinearArrays) -> int:
    """Return the length of the state vector."""
    return NonlinearState.size(p) + p.copies * member_size(p, 0)


def initialise(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, outputs: np.ndarray) -> None:
    """Start with an unknown output; the first sample sets the motors."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0
    x.payload = p.load[PAYLOAD_MOST]
    if p.copies > 1:
        outputs[2 * p.outputs + 2] = x.payload


def step(
    p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Simulate one sample, then correct if there is a measurement that passes the gate.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy, and of two copies payload.
    parameters: standard deviations of measurement and disturbance at rest, ratio of the disturbance to the motion.
    """
    c, n, m = p.constants, p.motors, p.outputs
    asked, measured = inputs[:n], inputs[n : n + m]
    start = p.setup[NONLINEAR_START]
    if x.samples == 0.0:
        payload_start(p, x, asked)
    usable = kalman_usable(c, x, measured, float(inputs[n + m]), parameters[0])
    forced = kalman_forced(c, x)
    payload_predict(p, parameters, x, asked)
    if forced:
        # Large enough for the estimate to jump to the measurement.
        for i in range(m):
            x.P[i, i] += start * start
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = nonlinear_correct(p, parameters[0], x, measured, forced)
    kalman_count(c, x, usable, accepted)
    models = x.models
    # Copies: the filter's model stays at the time of the measurement.
    nonlinear_tell(
        p,
        payload_free(p, x.payload),
        models[: member_size(p, 0)].copy(),
        x.angles.copy(),
        x.motion.copy(),
        x.told,
        x.reached.copy(),
        asked,
        outputs,
    )
    outputs[2 * m] = innovation
    outputs[2 * m + 1] = 1.0 if kalman_healthy(c, x, parameters[0]) else 0.0
    if p.copies > 1:
        outputs[2 * m + 2] = x.payload
    x.samples += 1.0


def payload_free(p: NonlinearArrays, payload: float) -> np.ndarray:
    """Return the model's parameters in simulation; with two copies the payload is the last one."""
    free = np.empty(p.free.shape[0])
    free[:] = p.free
    if p.copies > 1:
        free[free.shape[0] - 1] = payload
    return free


def payload_start(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Start at the heaviest payload, with the range as standard deviation.

    A controller keeps tendons taut for the estimate. Too light an estimate leaves them slack, and a slack neck does not
    show its payload.
    """
    start, timing, models, size = p.setup[NONLINEAR_START], p.setup[NONLINEAR_TIMING], x.models, member_size(p, 0)
    m = p.outputs
    for i in range(m):
        x.P[i, i] = start * start
        x.P[m + i, m + i] = timing * timing
    x.P[2 * m, 2 * m] = (p.load[PAYLOAD_MOST] - p.load[PAYLOAD_LEAST]) ** 2
    x.held[:] = asked
    x.reached[:] = asked
    more = np.empty(m)
    nonlinear_settle(p, payload_free(p, x.payload), models[:size], asked, x.angles)
    if p.copies > 1:
        nonlinear_settle(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], asked, more)


def payload_predict(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, asked: np.ndarray) -> None:
    """Simulate the copies for one sample, and increase the covariance."""
    m, models, size, before, more = p.outputs, x.models, member_size(p, 0), x.angles.copy(), np.empty(p.outputs)
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    x.held[:] = asked
    nonlinear_move(p, payload_free(p, x.payload), models[:size], x.reached, x.angles)
    if p.copies > 1:
        nonlinear_move(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], x.reached, more)
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    for i in range(m):
        x.motion[i] = x.angles[i] - before[i]
        if p.copies > 1:
            x.slopes[i] = (more[i] - x.angles[i]) / PAYLOAD_STEP
        x.told[m + i] *= p.setup[NONLINEAR_TIMING_KEEP]
    walked = parameters[1] * parameters[1] + (parameters[2] * x.fastest) ** 2
    nonlinear_widen(x.P, m, 2 * m + 1, walked, p.setup[NONLINEAR_TIMING] ** 2, p.setup[NONLINEAR_TIMING_KEEP])
    x.P[2 * m, 2 * m] += p.load[PAYLOAD_WALK] ** 2
