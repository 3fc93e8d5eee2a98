"""How a model's histories and drives answer to the planned moves, common to all kinds; see `_nmpc_runtime`.

`line` (8 (N + 1), nz) holds by sample what each history is moved by: rows 8 k + (0..2) set-points, + (3..5) motor
positions, + (6, 7) angles, all at t_k. What is before t_0 is known and moves by nothing, so that a lag is a row further
up and nothing is shifted. In free run the measured echo of a kind is fed by itself alone: no move reaches it.
"""

import numpy as np

from softneck.identification.models._bank_runtime import drive_limit


def tangent_motors(arrays: tuple[np.ndarray, ...], k: int, line: np.ndarray) -> None:
    """Let motors without delay be where their set-points are."""
    for j in range(3):
        if arrays[1][j, 1] == 0.0:
            line[8 * k + 3 + j] = line[8 * k + j]


def tangent_load(load: np.ndarray, k: int, line: np.ndarray, rows: np.ndarray) -> None:
    """Move the rows of q (the first three of `rows`) on, as `load_advance` moves q."""
    for j in range(3):
        rows[j] = load[0] * rows[j] + (1.0 - load[0]) * line[8 * k + 3 + j]


def tangent_drives(
    arrays: tuple[np.ndarray, ...], load: np.ndarray, k: int, state: np.ndarray, line: np.ndarray, rows: np.ndarray
) -> None:
    """Fill the rows of the motor positions at t_k+1, as `drive_advance` moves them; `state` is that of t_k+1."""
    h = int(arrays[0][0])
    q = state[8 * h + 13 : 8 * h + 16]
    for j in range(3):
        d = int(arrays[1][j, 1])
        if d > 0:
            pole = arrays[1][j, 0]
            m = state[3 * h + j]
            limit = drive_limit(load, q, j)
            mine = line[8 * k + 3 + j]
            ahead = pole * mine
            if k - d + 1 >= 0:
                ahead = ahead + (1.0 - pole) * line[8 * (k - d + 1) + j]
            if pole * m + (1.0 - pole) * state[3 * (d - 1) + j] > max(limit, m):
                ahead = 1.0 * mine
                if limit > m:
                    mean = (rows[0] + rows[1] + rows[2]) / 3.0
                    ahead = load[2] * (rows[j] - mean) + load[3] * mean
            line[8 * k + 11 + j] = ahead
