"""Simulation of a nonlinear model, and what it misses: a disturbance of its outputs and a timing error.

Member 0 is the model. Its state is not corrected, so it stays reachable, and the model needs no derivatives. The
disturbance is a random walk whose step grows with the motion. Delays and time constants that the model has wrong, or
that change with the motion, make it early or late: this shifts an output by its rate times the timing error.
"""

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
    NonlinearArrays,
    NonlinearState,
    nonlinear_correct,
    nonlinear_move,
    nonlinear_settle,
    nonlinear_slew,
    nonlinear_tell,
    nonlinear_widen,
)
from softneck.runtime._members_runtime import member_size


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
        nonlinear_start(p, x, asked)
    usable = kalman_usable(c, x, measured, float(inputs[n + m]), parameters[0])
    forced = kalman_forced(c, x)
    nonlinear_predict(p, parameters, x, asked)
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
        p.free,
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
    x.samples += 1.0


def nonlinear_start(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Bring the model to rest; nothing is known of what it misses."""
    start, timing, models, size = p.setup[NONLINEAR_START], p.setup[NONLINEAR_TIMING], x.models, member_size(p, 0)
    m = p.outputs
    for i in range(m):
        x.P[i, i] = start * start
        x.P[m + i, m + i] = timing * timing
    x.held[:] = asked
    x.reached[:] = asked
    nonlinear_settle(p, p.free, models[:size], asked, x.angles)


def nonlinear_predict(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, asked: np.ndarray) -> None:
    """Simulate the model for one sample, and increase the covariance."""
    models, size, before = x.models, member_size(p, 0), x.angles.copy()
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    x.held[:] = asked
    nonlinear_move(p, p.free, models[:size], x.reached, x.angles)
    nonlinear_widen(p, parameters, x, before)
