"""A linear controller of all axes with limits and tendon allocation; see `_linear_parts_runtime` for its equations."""

import numpy as np

from softneck.design.linear._linear_parts_runtime import (
    LinearArrays,
    LinearState,
    linear_align,
    linear_control,
    linear_finite,
)
from softneck.design.linear._rest_runtime import initialise as initialise


def step(p: LinearArrays, parameters: np.ndarray, x: LinearState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; the outputs of
    another robot stand for pitch and roll.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position of a motor [rad], least
    co-contraction [rad].
    """
    # One that is none would stay in the state for good: the motors hold until all are there again.
    if not linear_finite(inputs):
        outputs[:] = x.held
        return
    flags = 2 * p.outputs + 1 + p.motors
    # Whoever had the motors before: this controller takes over where they are.
    if x.started == 0.0:
        x.held[:] = inputs[2 * p.outputs + 1 : flags]
    active = inputs[flags] > 0.5 and inputs[flags + 1] > 0.5
    # Held set-points and an aligned state for as long as it may not act, so that it begins without a bump.
    if x.started == 0.0 or not active:
        linear_align(p, x, inputs[p.outputs + 1 : 2 * p.outputs + 1])
    x.started = 1.0
    if active:
        linear_control(p, parameters, x, inputs)
    outputs[:] = x.held
