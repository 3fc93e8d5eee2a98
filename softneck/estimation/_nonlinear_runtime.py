"""Simulation of a nonlinear model, and a random-walk disturbance of its outputs whose step grows with the motion.

Member 0 is the model. Its state is not corrected, so it stays reachable, and the model needs no derivatives. The
disturbance is the model's error, which is large in motion.
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
from softneck.runtime._layout import cells, rest
from softneck.runtime._members_runtime import member_size


class NonlinearState(KalmanCounters):
    """Counters, outputs of the model and the disturbance; the model's state follows."""

    variance = cells("", "of each output's disturbance")
    fastest = cells("", "motion of the model in a sample, of late")
    angles = cells("outputs", "of the model at the filter's time")
    disturbance = cells("outputs", "what it misses")
    held = cells("motors", "set-points that came last")
    reached = cells("motors", "set-points that moved the model last: no faster than the drives take them")
    model = rest("state of the model")


def state_size(p: NonlinearArrays) -> int:
    """Return the length of the state vector."""
    return NonlinearState.size(p) + member_size(p, 0)


def initialise(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, outputs: np.ndarray) -> None:
    """Start with an unknown output; the first sample sets the motors."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0


def step(
    p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Simulate one sample, then correct if there is a measurement that passes the gate.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy.
    parameters: standard deviations of measurement and disturbance at rest, ratio of the disturbance to the motion.
    """
    c, n, m = p.constants, p.motors, p.outputs
    asked, measured = inputs[:n], inputs[n : n + m]
    start = p.setup[NONLINEAR_START]
    if x.samples == 0.0:
        x.held[:] = asked
        x.reached[:] = asked
        nonlinear_settle(p, p.free, x.model, asked, x.angles)
        x.variance = start * start
    usable = kalman_usable(c, x, measured, float(inputs[n + m]), parameters[0])
    forced = kalman_forced(c, x)
    nonlinear_predict(p, parameters, x, asked)
    if forced:
        # Large enough for the estimate to jump to the measurement.
        x.variance += start * start
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = nonlinear_correct(p, parameters[0], x, measured, forced)
    kalman_count(c, x, usable, accepted)
    # Copies: the filter's model stays at the time of the measurement.
    nonlinear_tell(p, p.free, x.model.copy(), x.angles.copy(), x.disturbance, x.reached.copy(), asked, outputs)
    outputs[2 * m] = innovation
    outputs[2 * m + 1] = 1.0 if kalman_healthy(c, x, parameters[0]) else 0.0
    x.samples += 1.0


def nonlinear_predict(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, asked: np.ndarray) -> None:
    """Simulate one sample, and increase the disturbance's variance by the model's motion."""
    before = x.angles.copy()
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    nonlinear_move(p, p.free, x.model, x.reached, x.angles)
    x.held[:] = asked
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    x.variance += parameters[1] * parameters[1] + (parameters[2] * x.fastest) ** 2


def nonlinear_correct(
    p: NonlinearArrays, noise: float, x: NonlinearState, measured: np.ndarray, forced: bool
) -> tuple[float, bool]:
    """Correct the disturbance unless the gate rejects the measurement; return the NIS and whether it was accepted."""
    S = x.variance + noise * noise
    x.log_det = p.outputs * math.log(S)
    innovation = 0.0
    for i in range(p.outputs):
        innovation += (measured[i] - x.angles[i] - x.disturbance[i]) ** 2 / S
    if not (forced or innovation <= p.constants[KALMAN_GATE]):
        return innovation, False
    gain = x.variance / S
    for i in range(p.outputs):
        x.disturbance[i] += gain * (measured[i] - x.angles[i] - x.disturbance[i])
    x.variance *= 1.0 - gain
    return innovation, True
