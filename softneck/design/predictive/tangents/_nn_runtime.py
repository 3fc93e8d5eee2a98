"""Kind `nn` with what the planned moves make of its angles; `tangent` is the derivative of `step` in free run.

The disturbance d of the network moves by nothing: in free run the histories hold network + d, so nothing is missed.
"""

import numpy as np

from softneck.design.predictive.tangents._shared_runtime import tangent_drives, tangent_load, tangent_motors
from softneck.identification.models._histories_runtime import narx_regressor
from softneck.identification.networks._nn_runtime import initialise as initialise
from softneck.identification.networks._nn_runtime import state_size as state_size
from softneck.identification.networks._nn_runtime import step as step


def tangent_network(arrays: tuple[np.ndarray, ...], axis: int, x: np.ndarray) -> np.ndarray:
    """Return the gradient of `nn_output` at the regressor `x`."""
    z = (x - arrays[9][axis, 0]) / arrays[9][axis, 1]
    first = np.tanh(np.dot(arrays[3][axis], z) + arrays[4][axis])
    second = np.tanh(np.dot(arrays[5][axis], first) + arrays[6][axis])
    back = arrays[7][axis] * (1.0 - second * second)
    back = np.dot(back, arrays[5][axis]) * (1.0 - first * first)
    return arrays[10][axis, 1] * np.dot(back, arrays[3][axis]) / arrays[9][axis, 1]


def tangent(
    arrays: tuple[np.ndarray, ...],
    k: int,
    before: np.ndarray,
    state: np.ndarray,
    line: np.ndarray,
    rows: np.ndarray,
    slopes: np.ndarray,
) -> None:
    """Move `line` and `rows` on over [t_k, t_k+1) and fill `slopes` (2, nz) of pitch and roll at t_k+1.

    before, state: the model's state at t_k and, after its step, at t_k+1.
    """
    tangent_motors(arrays, k, line)
    tangent_load(arrays[11], k, line, rows)
    table = arrays[2]
    x = np.empty(table.shape[0])
    for axis in range(2):
        narx_regressor(arrays, table, state, axis, x)
        gradient = tangent_network(arrays, axis, x)
        slopes[axis] = 0.0
        for i in range(table.shape[0]):
            source = int(table[i, 0])
            at = k + 1 - int(table[i, 2])
            if at >= 0:
                row = 8 * at + int(table[i, 1])
                if source == 0:
                    row = 8 * at + 6 + axis
                elif source == 2:
                    row += 3
                elif source == 3:
                    row += 6
                slopes[axis] += gradient[i] * line[row]
    tangent_drives(arrays, arrays[11], k, state, line, rows)
    for axis in range(2):
        line[8 * k + 14 + axis] = slopes[axis]
