"""Two axes with cross gains, each a transfer function behind its delay, motors where they were told to be.

Arrays: numerator (2, q), denominator (2, q), delay (2,), cross (2,), T (3, 3) of Eq. 9-11.
State: random generator (6), observable form (2 q), inputs so far (2 (longest delay + 1)).
"""

import numpy as np

from softneck.runtime._random_runtime import random_normal, random_seed
from softneck.verification._axis_runtime import axis_advance


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return 6 + 2 * arrays[0].shape[1] + 2 * (int(arrays[2].max()) + 1)


def initialise(
    arrays: tuple[np.ndarray, ...],  # noqa: ARG001
    parameters: np.ndarray,
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Rest: motors and angles at zero."""
    state[:] = 0.0
    random_seed(state[:6], parameters[1])
    outputs[:] = 0.0
    if parameters[0] > 0.0:
        for axis in range(2):
            outputs[2 + axis] = parameters[0] * random_normal(state[:6])


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample.

    inputs: motor_setpoint_1..3, load_pitch, load_roll. parameters: noise_std [rad], noise_seed.
    outputs: pitch, roll, pitch_measured, roll_measured, motor_position_1..3.
    """
    q = arrays[0].shape[1]
    line = int(arrays[2].max()) + 1
    tilt = np.dot(arrays[4], inputs[:3])
    for axis in range(2):
        held = state[6 + 2 * q + axis * line : 6 + 2 * q + (axis + 1) * line]
        for j in range(line - 1, 0, -1):
            held[j] = held[j - 1]
        held[0] = tilt[axis] + arrays[3][axis] * tilt[1 - axis] + inputs[3 + axis]
        x = state[6 + axis * q : 6 + (axis + 1) * q]
        axis_advance(x, arrays[0][axis], arrays[1][axis], held[int(arrays[2][axis])])
        outputs[axis] = x[0]
        outputs[2 + axis] = x[0]
        if parameters[0] > 0.0:
            outputs[2 + axis] += parameters[0] * random_normal(state[:6])
    outputs[4:7] = inputs[:3]
