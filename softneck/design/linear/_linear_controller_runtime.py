"""A linear controller of both axes with limits and tendon allocation; see `_linear_parts_runtime` for its equations.

State vector: xf (m,), x (n,), set-points held (3,), whether started.
"""

import numpy as np

from softneck.design.linear._linear_parts_runtime import linear_align, linear_control
from softneck.design.linear._rest_runtime import initialise as initialise


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return arrays[0].shape[0] + arrays[4].shape[0] + 4


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position of a motor [rad], least
    co-contraction [rad].
    """
    m, n = arrays[0].shape[0], arrays[4].shape[0]
    if state[-1] == 0.0:
        state[m + n : m + n + 3] = inputs[5:8]
    active = inputs[8] > 0.5 and inputs[9] > 0.5
    if state[-1] == 0.0 or not active:
        linear_align(arrays, state, inputs[3:5])
    state[-1] = 1.0
    if active:
        linear_control(arrays, parameters, state, inputs)
    outputs[:] = state[m + n : m + n + 3]
