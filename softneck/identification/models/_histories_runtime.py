"""What all plants share: histories, the drive model, measured or simulated signals, output noise.

State: set-points u (H, 3), motor positions m (H, 3), outputs y (H, 2), newest first; then the motor
positions and outputs of now, the random generator (6), and how far each output of now is above what goes
into its history (2): form `residual` of set membership remembers only its base there, all else keeps 0.
arrays[0] = [H], arrays[1] = drive (3, 2): pole a and delay d of `m(k+1) = a m(k) + (1 - a) u(k+1-d)`;
d = 0 says that the position is the set-point.
"""

import numpy as np

from softneck.runtime._random_runtime import random_normal, random_seed

# Parameters, in this order.
NARX_START = 0  # pitch_start, roll_start
NARX_USE_MEASUREMENT = 2
NARX_NOISE_STD = 3
NARX_NOISE_SEED = 4


def narx_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector, without what a kind remembers beyond it."""
    return 8 * int(arrays[0][0]) + 13


def narx_rest(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    h = int(arrays[0][0])
    state[:] = 0.0
    for j in range(h):
        state[6 * h + 2 * j] = parameters[NARX_START]
        state[6 * h + 2 * j + 1] = parameters[NARX_START + 1]
    state[8 * h + 3] = parameters[NARX_START]
    state[8 * h + 4] = parameters[NARX_START + 1]
    random_seed(state[8 * h + 5 : 8 * h + 11], parameters[NARX_NOISE_SEED])
    outputs[:] = 0.0
    outputs[0] = parameters[NARX_START]
    outputs[1] = parameters[NARX_START + 1]
    if outputs.shape[0] == 9:  # bounds, which hold nothing but the start yet
        outputs[5:7] = parameters[NARX_START]
        outputs[7:9] = parameters[NARX_START + 1]


def narx_observe(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray) -> None:
    """Push what is known at t_k into the histories: set-points, motors and outputs, measured where they are."""
    h = int(arrays[0][0])
    now = 8 * h
    drive = arrays[1]
    if parameters[NARX_USE_MEASUREMENT] > 0.5:
        for j in range(2):
            if np.isfinite(inputs[3 + j]):
                state[now + 3 + j] = inputs[3 + j]
    for j in range(3):
        if drive[j, 1] == 0.0:
            state[now + j] = inputs[j]
        if parameters[NARX_USE_MEASUREMENT] > 0.5 and np.isfinite(inputs[5 + j]):
            state[now + j] = inputs[5 + j]
    # The newest sample stands first; numpy and numba both copy before they overwrite.
    state[3 : 3 * h] = state[: 3 * h - 3].copy()
    state[3 * h + 3 : 6 * h] = state[3 * h : 6 * h - 3].copy()
    state[6 * h + 2 : 8 * h] = state[6 * h : 8 * h - 2].copy()
    state[:3] = inputs[:3]
    state[3 * h : 3 * h + 3] = state[now : now + 3]
    state[6 * h : 6 * h + 2] = state[now + 3 : now + 5] - state[now + 11 : now + 13]


def narx_advance(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    pitch: float,
    roll: float,
    outputs: np.ndarray,
) -> None:
    """Take pitch and roll at t_k+1 as the new outputs, move the motors on, write the outputs."""
    h = int(arrays[0][0])
    now = 8 * h
    drive = arrays[1]
    for j in range(3):
        d = int(drive[j, 1])
        if d > 0:
            a = drive[j, 0]
            state[now + j] = a * state[now + j] + (1.0 - a) * state[3 * (d - 1) + j]
        outputs[2 + j] = state[now + j]
    state[now + 3] = pitch
    state[now + 4] = roll
    outputs[0] = pitch
    outputs[1] = roll
    if parameters[NARX_NOISE_STD] > 0.0:
        outputs[0] += parameters[NARX_NOISE_STD] * random_normal(state[now + 5 :])
        outputs[1] += parameters[NARX_NOISE_STD] * random_normal(state[now + 5 :])


def narx_regressor(
    arrays: tuple[np.ndarray, ...], table: np.ndarray, state: np.ndarray, axis: int, regressor: np.ndarray
) -> None:
    """Fill the regressor of y(k+1); row (source, channel, lag) of `table`: source 0 own output, 1 u, 2 m, 3 outputs."""
    h = int(arrays[0][0])
    for i in range(table.shape[0]):
        source = int(table[i, 0])
        channel = int(table[i, 1])
        back = int(table[i, 2]) - 1
        if source == 0:
            regressor[i] = state[6 * h + 2 * back + axis]
        elif source == 1:
            regressor[i] = state[3 * back + channel]
        elif source == 2:
            regressor[i] = state[3 * h + 3 * back + channel]
        else:
            regressor[i] = state[6 * h + 2 * back + channel]
