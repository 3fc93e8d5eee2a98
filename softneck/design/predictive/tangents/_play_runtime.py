"""Kind `play` with what the planned moves make of its angles; `tangent` is the derivative of `step` in free run.

Where a play operator or a limit has a corner, the derivative is that of one side.
"""

import numpy as np

from softneck.design.predictive.tangents._shared_runtime import tangent_drives, tangent_load, tangent_motors
from softneck.identification.models._bank_runtime import monomial
from softneck.identification.structured._play_runtime import initialise as initialise
from softneck.identification.structured._play_runtime import state_size as state_size
from softneck.identification.structured._play_runtime import step as step


def tangent_bank(
    arrays: tuple[np.ndarray, ...],
    k: int,
    before: np.ndarray,
    state: np.ndarray,
    line: np.ndarray,
    plays: np.ndarray,
    bank: np.ndarray,
) -> None:
    """Move the rows of plays and bank on, as `bank_advance` moves them."""
    h, count, order, pole = int(arrays[0][0]), arrays[4].shape[0], int(arrays[5][1]), arrays[5][0]
    old = before[8 * h + 16 : 8 * h + 16 + 3 * count]
    for c in range(3):
        v = 0.0
        for j in range(3):
            v += arrays[3][c, j] * state[3 * h + j]
        moved = arrays[3][c, 0] * line[8 * k + 3] + arrays[3][c, 1] * line[8 * k + 4]
        moved = moved + arrays[3][c, 2] * line[8 * k + 5]
        for i in range(count + 1):
            first = (c * (count + 1) + i) * order
            for o in range(order - 1, 0, -1):
                bank[first + o] = pole * bank[first + o] + (1.0 - pole) * bank[first + o - 1]
            bank[first] = pole * bank[first]
            if i == 0:
                bank[first] += (1.0 - pole) * moved
            else:
                at = c * count + i - 1
                if abs(v - old[at]) > arrays[4][i - 1]:
                    plays[at] = moved
                bank[first] += (1.0 - pole) * plays[at]


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
    h, count = int(arrays[0][0]), arrays[4].shape[0]
    tangent_motors(arrays, k, line)
    tangent_load(arrays[2], k, line, rows)
    tangent_bank(arrays, k, before, state, line, rows[3 : 3 + 3 * count], rows[3 + 3 * count :])
    values = state[8 * h + 16 + 3 * count :]
    gradient = np.empty(values.shape[0])
    table = arrays[6]
    for axis in range(2):
        gradient[:] = 0.0
        total = 0.0
        for i in range(table.shape[0]):
            total += arrays[7][axis, i] * monomial(table, i, values)
            for place in range(3):
                at = int(table[i, place])
                if at >= 0:
                    others = arrays[7][axis, i]
                    for other in range(3):
                        to = int(table[i, other])
                        if other != place and to >= 0:
                            others *= values[to]
                    gradient[at] += others
        slopes[axis] = 0.0
        if arrays[8][axis, 0] < total < arrays[8][axis, 1]:
            for i in range(values.shape[0]):
                slopes[axis] += gradient[i] * rows[3 + 3 * count + i]
    tangent_drives(arrays, arrays[2], k, state, line, rows)
