"""The observer over a model with a payload parameter: it estimates the payload too.

Two copies of the model are simulated, one with the estimated payload and one with a little more. Their difference is
the derivative of the outputs, and the payload is a further random-walk state (a recursive prediction error method,
Ljung and Soderstrom 1983, sec. 3.3). It is kept within the payloads of the recordings.
"""

import numpy as np

from softneck.estimation._kalman_parts_runtime import kalman_clear
from softneck.estimation._nonlinear_parts_runtime import (
    PAYLOAD_LEAST,
    PAYLOAD_MOST,
    PAYLOAD_WALK,
    NonlinearArrays,
    NonlinearState,
    nonlinear_answer,
    nonlinear_begin,
    nonlinear_judge,
    nonlinear_move,
    nonlinear_reach,
    nonlinear_settle,
    nonlinear_widen,
)
from softneck.runtime._members_runtime import member_size

# Difference of the payload between both copies [kg]: far above rounding, and small beside the curvature.
PAYLOAD_STEP = 0.02


def state_size(p: NonlinearArrays) -> int:
    """Return the length of the state vector."""
    return NonlinearState.size(p) + 2 * member_size(p, 0)


def initialise(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, outputs: np.ndarray) -> None:
    """Start with an unknown output; the first sample sets the motors."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0
    x.payload = p.load[PAYLOAD_MOST]
    outputs[2 * p.outputs + 2] = x.payload


def step(
    p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Simulate one sample, then correct if there is a measurement that passes the gate.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy, payload.
    parameters: standard deviations of measurement and disturbance at rest, ratio of the disturbance to the motion.
    """
    asked = inputs[: p.motors]
    if x.samples == 0.0:
        payload_start(p, x, asked)
    payload_predict(p, parameters, x, asked)
    innovation = nonlinear_judge(p, parameters[0], x, inputs)
    nonlinear_answer(p, parameters[0], payload_free(p, x.payload), x, asked, innovation, outputs)
    outputs[2 * p.outputs + 2] = x.payload


def payload_free(p: NonlinearArrays, payload: float) -> np.ndarray:
    """Return the model's parameters in simulation, of which the payload is the last."""
    free = p.free.copy()
    free[free.shape[0] - 1] = payload
    return free


def payload_start(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Start at the heaviest payload, with the range as standard deviation.

    A controller keeps tendons taut for the estimate. Too light an estimate leaves them slack, and a slack neck does not
    show its payload.
    """
    models, size = x.models, member_size(p, 0)
    m = p.outputs
    nonlinear_begin(p, x, asked)
    x.P[2 * m, 2 * m] = (p.load[PAYLOAD_MOST] - p.load[PAYLOAD_LEAST]) ** 2
    more = np.empty(m)
    nonlinear_settle(p, payload_free(p, x.payload), models[:size], asked, x.angles)
    nonlinear_settle(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], asked, more)


def payload_predict(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, asked: np.ndarray) -> None:
    """Simulate both copies for one sample, and increase the covariance."""
    models, size, before, more = x.models, member_size(p, 0), x.angles.copy(), np.empty(p.outputs)
    nonlinear_reach(p, x, asked)
    nonlinear_move(p, payload_free(p, x.payload), models[:size], x.reached, x.angles)
    nonlinear_move(p, payload_free(p, x.payload + PAYLOAD_STEP), models[size:], x.reached, more)
    for i in range(p.outputs):
        x.slopes[i] = (more[i] - x.angles[i]) / PAYLOAD_STEP
    nonlinear_widen(p, parameters, x, before)
    x.P[2 * p.outputs, 2 * p.outputs] += p.load[PAYLOAD_WALK] ** 2
