"""Kind `nss` with what the planned moves make of its angles; `tangent` is the derivative of `step` in free run."""

import numpy as np

from softneck.design.predictive.tangents._shared_runtime import tangent_drives, tangent_load, tangent_motors
from softneck.identification.networks._nss_map_runtime import nss_inputs, nss_next
from softneck.identification.networks._nss_runtime import initialise as initialise
from softneck.identification.networks._nss_runtime import state_size as state_size
from softneck.identification.networks._nss_runtime import step as step


def tangent_inputs(
    arrays: tuple[np.ndarray, ...],
    at: int,
    motors: np.ndarray,
    plays: np.ndarray,
    line: np.ndarray,
    rows: np.ndarray,
    moved: np.ndarray,
) -> None:
    """Fill the rows of v and move those of the plays on, as `nss_inputs` does; `plays` as they were."""
    count = arrays[4].shape[0]
    for c in range(3):
        v = 0.0
        first = c * (count + 1)
        moved[first] = 0.0
        for j in range(3):
            v += arrays[3][c, j] * motors[j]
            if at >= 0:
                moved[first] += arrays[3][c, j] * line[8 * at + 3 + j]
        for i in range(count):
            play = c * count + i
            if abs(v - plays[play]) > arrays[4][i]:
                rows[3 + play] = moved[first]
            moved[first + 1 + i] = rows[3 + play]


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
    h, count, back = int(arrays[0][0]), arrays[4].shape[0], int(arrays[5][0])
    tangent_motors(arrays, k, line)
    tangent_load(arrays[2], k, line, rows)
    own, late = 8 * h + 16, 3 * h + 3 * back
    plays = before[own : own + 3 * count].copy()
    motors = state[late : late + 3]
    moved = np.zeros((arrays[7].shape[1], line.shape[1]))
    tangent_inputs(arrays, k - back, motors, plays, line, rows, moved)
    v = np.empty(arrays[7].shape[1])
    nss_inputs(arrays[3], arrays[4], motors, plays, v)
    x = before[own + 3 * count :]
    t = np.empty(arrays[11].shape[0])
    ahead = np.empty(x.shape[0])
    nss_next(arrays[6], arrays[7], arrays[8], arrays[9], arrays[10], arrays[11], arrays[12], x, v, t, ahead)
    body = rows[3 + 3 * count :].copy()
    turned = np.dot(arrays[9], body) + np.dot(arrays[10], moved)
    for i in range(t.shape[0]):
        for j in range(i):
            turned[i] += arrays[12][i, j] * turned[j]
        turned[i] *= 1.0 - t[i] * t[i]
    rows[3 + 3 * count :] = np.dot(arrays[6], body) + np.dot(arrays[7], moved) + np.dot(arrays[8], turned)
    for axis in range(2):
        y = arrays[14][axis]
        slopes[axis] = 0.0
        for i in range(ahead.shape[0]):
            y += arrays[13][axis, i] * ahead[i]
            slopes[axis] += arrays[13][axis, i] * rows[3 + 3 * count + i]
        if not arrays[15][axis, 0] < y < arrays[15][axis, 1]:
            slopes[axis] = 0.0
    tangent_drives(arrays, arrays[2], k, state, line, rows)
