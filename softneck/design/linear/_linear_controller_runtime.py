"""A linear controller of all axes with limits and tendon allocation; see `_linear_parts_runtime` for its equations."""

import numpy as np

from softneck.design.linear._linear_parts_runtime import LinearArrays, LinearState, linear_step
from softneck.design.linear._rest_runtime import initialise as initialise


def step(p: LinearArrays, parameters: np.ndarray, x: LinearState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; the outputs of
    another robot stand for pitch and roll.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position of a motor [rad], least
    co-contraction [rad].
    """
    linear_step(p, parameters, x, inputs, outputs)
