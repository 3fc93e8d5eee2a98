"""NLARX network with two tanh layers over drives that stall under load (see `_bank_runtime`).

Arrays: H, drive, table, W1, b1, W2, b2, w3, b3, x mean/scale, y mean/scale, load, correction (2, 2).
State: that of `_histories_runtime`, then q (3), the network's part of the outputs of now (2), the disturbance d (2).
y(k) = network + d(k), d(k+1) = memory (d + gain (y - network - d)): what the network misses where outputs are
measured; where none are, d dies out. A tanh layer is bounded, so the output is, whatever it is fed back.
"""

import numpy as np

from softneck.identification.models._bank_runtime import drive_advance, drive_limit, load_advance
from softneck.identification.models._histories_runtime import (
    narx_advance,
    narx_observe,
    narx_regressor,
    narx_rest,
    narx_size,
)


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return narx_size(arrays) + 7


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    narx_rest(arrays, parameters, state, outputs)
    state[narx_size(arrays) + 3] = parameters[0]
    state[narx_size(arrays) + 4] = parameters[1]


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
    h = int(arrays[0][0])
    m = state[3 * h : 3 * h + 3]
    q = state[narx_size(arrays) : narx_size(arrays) + 3]
    load_advance(arrays[11], m, q)
    own = state[narx_size(arrays) + 3 : narx_size(arrays) + 5]
    disturbance = state[narx_size(arrays) + 5 : narx_size(arrays) + 7]
    table = arrays[2]
    x = np.empty(table.shape[0])
    angles = np.empty(2)
    for axis in range(2):
        missed = state[6 * h + axis] - own[axis] - disturbance[axis]
        disturbance[axis] = arrays[12][axis, 0] * (disturbance[axis] + arrays[12][axis, 1] * missed)
        narx_regressor(arrays, table, state, axis, x)
        own[axis] = nn_output(arrays, axis, x)
        angles[axis] = own[axis] + disturbance[axis]
    narx_advance(arrays, parameters, state, angles[0], angles[1], outputs)
    for j in range(3):
        d = int(arrays[1][j, 1])
        if d > 0:
            target = state[3 * (d - 1) + j]
            state[8 * h + j] = drive_advance(arrays[1][j, 0], target, m[j], drive_limit(arrays[11], q, j))
            outputs[2 + j] = state[8 * h + j]
