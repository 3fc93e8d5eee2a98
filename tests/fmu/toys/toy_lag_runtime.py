"""A noisy first-order lag: y+ = a y + (1 - a) u, measured with noise; one array (a, lead)."""

import numpy as np

from softneck.runtime._random_runtime import random_normal, random_seed


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    return 7


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Parameters: y_start, noise_std, noise_seed, biased."""
    random_seed(state[1:7], parameters[2])
    state[0] = parameters[0]
    outputs[0] = state[0] + 10.0 * parameters[3]
    outputs[1] = 1.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    a = arrays[0][0, 0]
    drive = inputs[0]
    if inputs[2] == inputs[2]:
        drive += inputs[2]
    if inputs[1] > 0.5:
        state[0] = a * state[0] + (1.0 - a) * drive
    outputs[0] = state[0] + parameters[1] * random_normal(state[1:7]) + 10.0 * parameters[3]
    outputs[1] = 1.0 if abs(state[0]) < 1e3 else 0.0
