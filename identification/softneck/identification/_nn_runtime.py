"""NLARX network with two tanh layers; arrays: H, drive, table, W1, b1, W2, b2, w3, b3, x mean/scale, y mean/scale."""

import numpy as np

from softneck.identification._narx_runtime import narx_advance, narx_observe, narx_regressor


def nn_output(arrays: tuple[np.ndarray, ...], axis: int, x: np.ndarray) -> float:
    """Return the network's y(k+1) of one axis for the regressor `x`."""
    z = (x - arrays[9][axis, 0]) / arrays[9][axis, 1]
    first = np.tanh(np.dot(arrays[3][axis], z) + arrays[4][axis])
    second = np.tanh(np.dot(arrays[5][axis], first) + arrays[6][axis])
    value = np.dot(arrays[7][axis], second) + arrays[8][axis]
    return arrays[10][axis, 0] + arrays[10][axis, 1] * value


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Advance by one sample."""
    narx_observe(arrays, parameters, state, inputs)
    table = arrays[2]
    x = np.empty(table.shape[0])
    narx_regressor(arrays, table, state, 0, x)
    pitch = nn_output(arrays, 0, x)
    narx_regressor(arrays, table, state, 1, x)
    roll = nn_output(arrays, 1, x)
    narx_advance(arrays, parameters, state, pitch, roll, outputs)
