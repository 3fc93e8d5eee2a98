"""The observer over a model with a payload parameter: it estimates the payload and the disturbance of the outputs.

Two copies of the model are simulated, one with the estimated payload and one with a little more. Their difference is
the derivative of the outputs, and the Kalman filter has the payload as a further random-walk state (a recursive
prediction error method, Ljung and Soderstrom 1983, sec. 3.3). It is kept within the payloads of the recordings.
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GATE,
    KALMAN_LAG,
    KalmanCounters,
    kalman_clear,
    kalman_count,
    kalman_forced,
    kalman_healthy,
    kalman_usable,
)
from softneck.estimation._nonlinear_parts_runtime import (
    NONLINEAR_START,
    NonlinearArrays,
    nonlinear_faster,
    nonlinear_move,
    nonlinear_settle,
    nonlinear_slew,
    nonlinear_tell,
)
from softneck.runtime._layout import array, cells, rest
from softneck.runtime._members_runtime import member_size

# Places in `load`.
PAYLOAD_LEAST = 0
PAYLOAD_MOST = 1
PAYLOAD_WALK = 2
# Difference of the payload between both copies [kg]: far above rounding, and small beside the curvature.
PAYLOAD_STEP = 0.02


class PayloadArrays(NonlinearArrays):
    """The arrays of `NonlinearArrays` and the payload's; the model's last parameter is the payload."""

    load = array("3", "least and most payload [kg], standard deviation of its walk in a sample [kg]")


class PayloadState(KalmanCounters):
    """Counters, the estimates and their covariance; the states of both copies follow."""

    fastest = cells("", "motion of the model in a sample, of late")
    payload = cells("", "estimated [kg]")
    angles = cells("outputs", "of the model at the filter's time")
    slopes = cells("outputs", "of these over the payload [1/kg]")
    disturbance = cells("outputs", "what the model misses")
    P = cells("outputs + 1, outputs + 1", "covariance of the disturbances and the payload")
    held = cells("motors", "set-points that came last")
    reached = cells("motors", "set-points that moved the model last: no faster than the drives take them")
    models = rest("states of both copies")


def state_size(p: PayloadArrays) -> int:
    """Return the length of the state vector."""
    return PayloadState.size(p) + 2 * member_size(p, 0)


def initialise(p: PayloadArrays, parameters: np.ndarray, x: PayloadState, outputs: np.ndarray) -> None:
    """Start with an unknown output; the first sample sets the motors."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0
    outputs[2 * p.outputs + 2] = p.load[PAYLOAD_MOST]


def step(p: PayloadArrays, parameters: np.ndarray, x: PayloadState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Simulate both copies, then correct if there is a measurement that passes the gate.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy, payload.
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
        innovation, accepted = payload_correct(p, parameters[0], x, measured, forced)
    kalman_count(c, x, usable, accepted)
    models = x.models
    # Copies: the filter's model stays at the time of the measurement.
    nonlinear_tell(
        p,
        payload_free(p, x.payload),
        models[: member_size(p, 0)].copy(),
        x.angles.copy(),
        x.disturbance,
        x.reached.copy(),
        asked,
        outputs,
    )
    outputs[2 * m] = innovation
    outputs[2 * m + 1] = 1.0 if kalman_healthy(c, x, parameters[0]) else 0.0
    outputs[2 * m + 2] = x.payload
    x.samples += 1.0


def payload_free(p: PayloadArrays, payload: float) -> np.ndarray:
    """Return the model's parameters in simulation with a payload."""
    free = p.free.copy()
    free[free.shape[0] - 1] = payload
    return free


def payload_start(p: PayloadArrays, x: PayloadState, asked: np.ndarray) -> None:
    """Start at the heaviest payload, with the range as standard deviation.

    A controller keeps tendons taut for the estimate. Too light an estimate leaves them slack, and a slack neck does not
    show its payload.
    """
    start, models, size = p.setup[NONLINEAR_START], x.models, member_size(p, 0)
    x.payload = p.load[PAYLOAD_MOST]
    for i in range(p.outputs):
        x.P[i, i] = start * start
    x.P[p.outputs, p.outputs] = (p.load[PAYLOAD_MOST] - p.load[PAYLOAD_LEAST]) ** 2
    x.held[:] = asked
    x.reached[:] = asked
    more = np.empty(p.outputs)
    nonlinear_settle(p, payload_free(p, x.payload), models[:size], asked, x.angles)
    nonlinear_settle(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], asked, more)


def payload_predict(p: PayloadArrays, parameters: np.ndarray, x: PayloadState, asked: np.ndarray) -> None:
    """Simulate both copies for one sample, and increase the covariance."""
    models, size, before, more = x.models, member_size(p, 0), x.angles.copy(), np.empty(p.outputs)
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    nonlinear_move(p, payload_free(p, x.payload), models[:size], x.reached, x.angles)
    nonlinear_move(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], x.reached, more)
    x.held[:] = asked
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    walked = parameters[1] * parameters[1] + (parameters[2] * x.fastest) ** 2
    for i in range(p.outputs):
        x.slopes[i] = (more[i] - x.angles[i]) / PAYLOAD_STEP
        x.P[i, i] += walked
    x.P[p.outputs, p.outputs] += p.load[PAYLOAD_WALK] ** 2


def payload_correct(
    p: PayloadArrays, noise: float, x: PayloadState, measured: np.ndarray, forced: bool
) -> tuple[float, bool]:
    """Correct with one output after the other, unless the gate rejects them; return the NIS and whether accepted."""
    m = p.outputs
    # The state: disturbances, and the payload less that of the copies.
    told, P = np.zeros(m + 1), x.P.copy().reshape((m + 1, m + 1))
    told[:m] = x.disturbance
    innovation, log_det = 0.0, 0.0
    for i in range(m):
        h = np.zeros(m + 1)
        h[i] = 1.0
        h[m] = x.slopes[i]
        Ph = np.zeros(m + 1)
        for j in range(m + 1):
            for k in range(m + 1):
                Ph[j] += P[j, k] * h[k]
        S = noise * noise
        e = measured[i] - x.angles[i]
        for j in range(m + 1):
            S += h[j] * Ph[j]
            e -= h[j] * told[j]
        innovation += e * e / S
        log_det += math.log(S)
        for j in range(m + 1):
            told[j] += Ph[j] / S * e
            for k in range(m + 1):
                P[j, k] -= Ph[j] * Ph[k] / S
    x.log_det = log_det
    if not (forced or innovation <= p.constants[KALMAN_GATE]):
        return innovation, False
    x.disturbance[:] = told[:m]
    x.P[:] = P.reshape((m + 1) * (m + 1))
    x.payload = min(max(x.payload + told[m], p.load[PAYLOAD_LEAST]), p.load[PAYLOAD_MOST])
    return innovation, True
