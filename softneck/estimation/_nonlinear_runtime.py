"""Simulation of a nonlinear model, and what it misses: a disturbance of its outputs and a timing error.

Member 0 is the model. Its state is not corrected, so it stays reachable, and the model needs no derivatives. The
disturbance is a random walk whose step grows with the motion. Delays and time constants that the model has wrong, or
that change with the motion, make it early or late: this shifts an output by its rate times the timing error.
"""

import numpy as np

from softneck.estimation._kalman_parts_runtime import kalman_clear
from softneck.estimation._nonlinear_parts_runtime import (
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
    asked = inputs[: p.motors]
    if x.samples == 0.0:
        nonlinear_start(p, x, asked)
    nonlinear_predict(p, parameters, x, asked)
    innovation = nonlinear_judge(p, parameters[0], x, inputs)
    nonlinear_answer(p, parameters[0], p.free, x, asked, innovation, outputs)


def nonlinear_start(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Bring the model to rest; nothing is known of what it misses."""
    models, size = x.models, member_size(p, 0)
    nonlinear_begin(p, x, asked)
    nonlinear_settle(p, p.free, models[:size], asked, x.angles)


def nonlinear_predict(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, asked: np.ndarray) -> None:
    """Simulate the model for one sample, and increase the covariance."""
    models, size, before = x.models, member_size(p, 0), x.angles.copy()
    nonlinear_reach(p, x, asked)
    nonlinear_move(p, p.free, models[:size], x.reached, x.angles)
    nonlinear_widen(p, parameters, x, before)
