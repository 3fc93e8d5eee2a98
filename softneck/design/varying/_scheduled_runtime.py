"""Linear controllers interpolated over the inclination.

Every matrix of the linear controller (see `_linear_parts_runtime`) is linear between the controllers of two
neighbouring inclinations and constant beyond the outermost. Their states mean the same at all of them - what the
integral adds to the tilt - so a change of the inclination alone moves no motor where the error is zero.

The inclination is that of the angles, `atan |(tan pitch, tan roll)|`, through a first-order lag: it must not change
faster than the loop it schedules (Shamma and Athans 1990, IEEE TAC 35:898).

Arrays: 0 to 3 Af, Bf, Cf, Df; 4 to 11 A, Br, By, C, Dr, Dy, L, align of all inclinations below each other; 12 to 15
rest, T, T_inverse, constants; 16 inclinations (m,); 17 the lag's memory (1,).
State vector: that of the linear controller without its flag, inclination, whether started.
"""

import math

import numpy as np

from softneck.design.linear._linear_parts_runtime import linear_align, linear_control
from softneck.design.linear._rest_runtime import initialise as initialise


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return arrays[0].shape[0] + arrays[4].shape[1] + 5


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Compute the set-points for now, and the state for the next sample; ports as of the linear controller."""
    m, n = arrays[0].shape[0], arrays[4].shape[1]
    active = inputs[8] > 0.5 and inputs[9] > 0.5
    started = state[-1] > 0.5
    if not started:
        state[m + n : m + n + 3] = inputs[5:8]
    tilt = scheduled_inclination(inputs[3], inputs[4])
    if not started or not active:
        # Nothing moves: the lag has nothing to protect.
        state[-2] = tilt
    else:
        memory = arrays[17][0]
        state[-2] = memory * state[-2] + (1.0 - memory) * tilt
    now = scheduled_arrays(arrays, state[-2])
    if not started or not active:
        linear_align(now, state, inputs[3:5])
        scheduled_exactly(now, state, inputs[3:5])
    state[-1] = 1.0
    if active:
        linear_control(now, parameters, state, inputs)
    outputs[:] = state[m + n : m + n + 3]


def scheduled_inclination(pitch: float, roll: float) -> float:
    """Return the inclination [rad]."""
    return math.atan(math.hypot(math.tan(pitch), math.tan(roll)))


def scheduled_blend(stacked: np.ndarray, knots: int, low: int, part: float) -> np.ndarray:
    """Return the matrix that lies `part` of the way from inclination `low` to the next."""
    rows = stacked.shape[0] // knots
    high = min(low + 1, knots - 1)
    return (1.0 - part) * stacked[low * rows : (low + 1) * rows] + part * stacked[high * rows : (high + 1) * rows]


def scheduled_arrays(arrays: tuple[np.ndarray, ...], tilt: float) -> tuple[np.ndarray, ...]:
    """Return the arrays of the linear controller at inclination `tilt` [rad]."""
    knots = arrays[16]
    m = knots.shape[0]
    low, part = m - 1, 0.0
    for i in range(1, m):
        if tilt < knots[i]:
            low = i - 1
            part = max(0.0, (tilt - knots[low]) / (knots[i] - knots[low]))
            break
    return (
        arrays[0],
        arrays[1],
        arrays[2],
        arrays[3],
        scheduled_blend(arrays[4], m, low, part),
        scheduled_blend(arrays[5], m, low, part),
        scheduled_blend(arrays[6], m, low, part),
        scheduled_blend(arrays[7], m, low, part),
        scheduled_blend(arrays[8], m, low, part),
        scheduled_blend(arrays[9], m, low, part),
        scheduled_blend(arrays[10], m, low, part),
        scheduled_blend(arrays[11], m, low, part),
        arrays[12],
        arrays[13],
        arrays[14],
        arrays[15],
    )


def scheduled_exactly(arrays: tuple[np.ndarray, ...], state: np.ndarray, y: np.ndarray) -> None:
    """Correct the aligned state until it asks for exactly the held set-points: a blend of alignments does not."""
    m, n = arrays[0].shape[0], arrays[4].shape[0]
    x = state[m : m + n]
    v = np.dot(arrays[13], state[m + n : m + n + 3])
    asked = np.dot(arrays[7], x) + np.dot(arrays[8], y) + np.dot(arrays[9], y)
    for i in range(2):
        row = arrays[7][i]
        size = np.dot(row, row)
        if size > 0.0:
            # Rows of C belong to one axis each, so the other axis' answer stays.
            x += row * ((v[i] - asked[i]) / size)
