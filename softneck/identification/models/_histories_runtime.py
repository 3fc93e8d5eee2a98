"""What all plants share: histories, the drive model, measured or simulated signals, output noise."""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._random_runtime import random_normal, random_seed
from softneck.runtime._rest_runtime import REST

# Parameters, in this order.
NARX_START = 0  # pitch_start, roll_start
NARX_USE_MEASUREMENT = 2
NARX_NOISE_STD = 3
NARX_NOISE_SEED = 4


class NarxArrays(Arrays):
    """The first arrays of every plant."""

    history = array("1", "H: how many samples of each signal are kept")
    drive = array("3, 2", "a and d of each motor: m(k+1) = a m(k) + (1 - a) u(k+1-d); d = 0: it is where it is sent")
    H = value("history", 0)


class NarxState(StateVector):
    """Histories, newest first, and what holds now; kinds add what else they remember."""

    u = cells("H, 3", "motor set-points [rad]")
    m = cells("H, 3", "motor positions [rad]")
    y = cells("H, 2", "pitch and roll [rad], or only their base where a kind adds something to it")
    motors = cells("3", "motor positions of now [rad]")
    angles = cells("2", "pitch and roll of now [rad]")
    random = cells("6", "generator of the output noise")
    added = cells("2", "how far the angles of now are above what goes into their history [rad]")


def narx_rest(p: NarxArrays, parameters: np.ndarray, x: NarxState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs at their start values for ever."""
    x[:] = 0.0
    for j in range(p.H):
        for axis in range(2):
            x.y[j, axis] = parameters[NARX_START + axis]
    for axis in range(2):
        x.angles[axis] = parameters[NARX_START + axis]
    random_seed(x.random, parameters[NARX_NOISE_SEED])
    outputs[:] = 0.0
    outputs[0] = parameters[NARX_START]
    outputs[1] = parameters[NARX_START + 1]
    if outputs.shape[0] == 9:  # bounds, which hold nothing but the start yet
        outputs[5:7] = parameters[NARX_START]
        outputs[7:9] = parameters[NARX_START + 1]


def narx_push(history: np.ndarray, newest: np.ndarray) -> None:
    """Put the newest sample in front of a history; the oldest falls out."""
    width = newest.shape[0]
    # numpy and numba both copy before they overwrite.
    history[width:] = history[: history.shape[0] - width].copy()
    history[:width] = newest


def narx_known(p: NarxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Take in where angles and motors are at t_k: as measured, where they are."""
    measured = parameters[NARX_USE_MEASUREMENT] > 0.5  # a Boolean parameter as a number
    for axis in range(2):
        if measured and np.isfinite(inputs[3 + axis]):  # NaN: not measured now
            x.angles[axis] = inputs[3 + axis]
    for j in range(3):
        # A drive without delay is where it is sent, unless an encoder says otherwise.
        if p.drive[j, 1] == 0.0:
            x.motors[j] = inputs[j]
        if measured and np.isfinite(inputs[5 + j]):
            x.motors[j] = inputs[5 + j]


def narx_observe(p: NarxArrays, parameters: np.ndarray, x: NarxState, inputs: np.ndarray) -> None:
    """Push what is known at t_k into the histories: set-points, motors and outputs, measured where they are."""
    narx_known(p, parameters, x, inputs)
    narx_push(x.u, inputs[:3])
    narx_push(x.m, x.motors)
    # What a kind adds is never fed back: its history holds the outputs without it.
    base = x.angles - x.added
    narx_push(x.y, base)


def narx_advance(
    p: NarxArrays, parameters: np.ndarray, x: NarxState, pitch: float, roll: float, outputs: np.ndarray
) -> None:
    """Take pitch and roll at t_k+1 as the new outputs, move the motors on, write the outputs."""
    for j in range(3):
        d = int(p.drive[j, 1])
        if d > 0:
            a = p.drive[j, 0]
            # Row 0 of the history is u(k), so that u(k+1-d) is row d - 1; m is measured where it is.
            x.motors[j] = (a * x.motors[j] + (1.0 - a) * x.u[d - 1, j] + REST) - REST
        outputs[2 + j] = x.motors[j]
    x.angles[0] = (pitch + REST) - REST
    x.angles[1] = (roll + REST) - REST
    outputs[0] = x.angles[0]
    outputs[1] = x.angles[1]
    # What a sensor would add is seen outside and never fed back.
    if parameters[NARX_NOISE_STD] > 0.0:
        outputs[0] += parameters[NARX_NOISE_STD] * random_normal(x.random)
        outputs[1] += parameters[NARX_NOISE_STD] * random_normal(x.random)


def narx_regressor(p: NarxArrays, table: np.ndarray, x: NarxState, axis: int, regressor: np.ndarray) -> None:
    """Fill the regressor of y(k+1); row (source, channel, lag) of `table`: source 0 own output, 1 u, 2 m, 3 outputs."""
    # Eq. 13 in the order of the table.
    for i in range(table.shape[0]):
        source = int(table[i, 0])
        channel = int(table[i, 1])
        back = int(table[i, 2]) - 1  # lag 1 of y(k+1) is sample k, the newest
        if source == 0:
            regressor[i] = x.y[back, axis]
        elif source == 1:
            regressor[i] = x.u[back, channel]
        elif source == 2:
            regressor[i] = x.m[back, channel]
        else:
            regressor[i] = x.y[back, channel]
