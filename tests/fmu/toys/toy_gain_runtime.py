"""An integrating controller: u = gain (r - y) + sum."""

import numpy as np


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    return 1


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    outputs[0] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    error = inputs[0] - inputs[1]
    state[0] += arrays[0][0] * error
    outputs[0] = parameters[0] * error + state[0]
