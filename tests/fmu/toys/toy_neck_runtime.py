"""A neck of two first-order tilts over the redefined inputs (Eq. 9, 10)."""

import numpy as np


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    return 2


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    state[0] = parameters[0]
    state[1] = parameters[1]
    outputs[:] = 0.0
    outputs[0] = state[0]
    outputs[1] = state[1]


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    a = arrays[0][0]
    theta = inputs[0] - 0.5 * (inputs[1] + inputs[2])
    phi = 0.866 * (inputs[1] - inputs[2])
    state[0] = a * state[0] + (1.0 - a) * 0.1 * theta - 1e-3 * inputs[3]
    state[1] = a * state[1] + (1.0 - a) * 0.1 * phi
    outputs[0] = state[0]
    outputs[1] = state[1]
    for j in range(3):
        outputs[2 + j] = inputs[j]
