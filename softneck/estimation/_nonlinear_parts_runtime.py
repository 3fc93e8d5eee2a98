"""Shared by observers over nonlinear models: simulation of the model, and the prediction to the present."""

import numpy as np

from softneck.estimation._kalman_parts_runtime import KALMAN_LEAD, KALMAN_PERIOD
from softneck.runtime._layout import Arrays, array, value
from softneck.runtime._members_runtime import member_initialise, member_step

# Places in `setup`; the model has more outputs than the measured ones.
NONLINEAR_MOTORS = 0
NONLINEAR_OUTPUTS = 1
NONLINEAR_TOLD = 2
NONLINEAR_SETTLE = 3
NONLINEAR_START = 4
NONLINEAR_KEEP = 5
NONLINEAR_SLEW = 6  # one a motor


class NonlinearArrays(Arrays):
    """The observer's own arrays; those of the model follow."""

    setup = array(
        "places",
        "motors, outputs, outputs of the model, samples until it stands, standard deviation of the disturbance at "
        "the start, part of the fastest motion that a sample keeps, then of each motor the most that its set-point "
        "moves the model in a sample",
    )
    constants = array("numbers", "see KALMAN_*; a lag of 1: the set-points come a sample early")
    free = array("parameters", "of the model in free run")
    motors = value("setup", NONLINEAR_MOTORS)
    outputs = value("setup", NONLINEAR_OUTPUTS)


def nonlinear_settle(
    p: NonlinearArrays, free: np.ndarray, model: np.ndarray, motors: np.ndarray, angles: np.ndarray
) -> None:
    """Bring the model to its steady state under `motors`; fill its `angles`."""
    member_initialise(p, 0, free, model, np.zeros(int(p.setup[NONLINEAR_TOLD])))
    for _ in range(int(p.setup[NONLINEAR_SETTLE])):
        nonlinear_move(p, free, model, motors, angles)


def nonlinear_move(
    p: NonlinearArrays, free: np.ndarray, model: np.ndarray, motors: np.ndarray, angles: np.ndarray
) -> None:
    """Simulate the model for one sample under `motors` and fill its `angles`; `free` are its parameters."""
    u = np.empty(2 * p.motors + p.outputs)
    u[: p.motors] = motors
    u[p.motors :] = np.nan  # NaN: nothing is measured
    out = np.zeros(int(p.setup[NONLINEAR_TOLD]))
    member_step(p, 0, free, model, u, out)
    angles[:] = out[: p.outputs]


def nonlinear_slew(p: NonlinearArrays, reached: np.ndarray, motors: np.ndarray) -> None:
    """Move `reached`, the model's set-points, towards `motors` at the rate limit of the drives."""
    for j in range(p.motors):
        most = p.setup[NONLINEAR_SLEW + j]
        reached[j] += min(max(motors[j] - reached[j], -most), most)


def nonlinear_faster(p: NonlinearArrays, fastest: float, angles: np.ndarray, before: np.ndarray) -> float:
    """Return the recent motion: a maximum that decays, updated with the change over the last sample."""
    motion = p.setup[NONLINEAR_KEEP] * fastest
    for i in range(p.outputs):
        motion = max(motion, abs(angles[i] - before[i]))
    return motion


def nonlinear_tell(
    p: NonlinearArrays,
    free: np.ndarray,
    model: np.ndarray,
    angles: np.ndarray,
    disturbance: np.ndarray,
    reached: np.ndarray,
    motors: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Predict from the filter's time to now under the newest set-points; fill angles and rates.

    `model`, `angles` and `reached` are overwritten.
    """
    c, m = p.constants, p.outputs
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    before = np.empty(m)
    for _ in range(whole + 1):
        before[:] = angles
        nonlinear_slew(p, reached, motors)
        nonlinear_move(p, free, model, reached, angles)
    for i in range(m):
        # Linear interpolation between samples; the rate is its slope.
        outputs[i] = before[i] + part * (angles[i] - before[i]) + disturbance[i]
        outputs[m + i] = (angles[i] - before[i]) / c[KALMAN_PERIOD]
