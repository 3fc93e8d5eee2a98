"""What kinds whose output has no feedback share: an echo of what was measured, and drives that stall under load.

The histories (see `_histories_runtime`) hold what the outputs were above the kind's own part f, which is never fed
back: y(k+1) = f(k+1) + sum_i echo_i (y - f)(k+1-i). In free run the echo dies out.
"""

import numpy as np

from softneck.identification.models._bank_runtime import drive_advance, drive_limit


def echo_rest(arrays: tuple[np.ndarray, ...], state: np.ndarray, axis: int, f: float) -> None:
    """Remember what the start is above `f` as if it had been measured for ever."""
    h = int(arrays[0][0])
    state[8 * h + 11 + axis] = f
    for j in range(h):
        state[6 * h + 2 * j + axis] -= f


def echo_added(arrays: tuple[np.ndarray, ...], echo: np.ndarray, state: np.ndarray, axis: int, f: float) -> float:
    """Return y(k+1) of one axis, and note `f`; echo (2, p)."""
    h = int(arrays[0][0])
    total = 0.0
    for i in range(echo.shape[1]):
        total += echo[axis, i] * state[6 * h + 2 * i + axis]
    state[8 * h + 11 + axis] = f
    return f + total


def stalling_drives(
    arrays: tuple[np.ndarray, ...], load: np.ndarray, q: np.ndarray, state: np.ndarray, outputs: np.ndarray
) -> None:
    """Move the motors of now on from the newest of the histories, no further than their load lets them."""
    h = int(arrays[0][0])
    for j in range(3):
        d = int(arrays[1][j, 1])
        if d > 0:
            limit = drive_limit(load, q, j)
            state[8 * h + j] = drive_advance(arrays[1][j, 0], state[3 * (d - 1) + j], state[3 * h + j], limit)
            outputs[2 + j] = state[8 * h + j]
