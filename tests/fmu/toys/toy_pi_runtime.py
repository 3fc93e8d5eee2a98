"""Two PI controllers and the inverse of the redefinition."""

import numpy as np


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    return 2


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    pitch_error = inputs[0] - inputs[3]
    roll_error = inputs[1] - inputs[4]
    state[0] += arrays[0][1] * pitch_error
    state[1] += arrays[0][1] * roll_error
    theta = parameters[0] * pitch_error + state[0]
    phi = parameters[0] * roll_error + state[1]
    outputs[0] = 2.0 / 3.0 * theta + inputs[2]
    outputs[1] = -theta / 3.0 + 0.5 / 0.866 * phi + inputs[2]
    outputs[2] = -theta / 3.0 - 0.5 / 0.866 * phi + inputs[2]
