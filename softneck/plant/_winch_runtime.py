"""The neck with torques on its winches instead of set-points: what simulated drives turn.

The state vector is that of `_neck_runtime`; the three integrals of its speed loops carry the torques, and its
drives have no bandwidth of their own, so that the differential equation stays one and the same.
"""

import numpy as np

from softneck.plant._geometry_runtime import bend_functions, lean_angles
from softneck.plant._inclinometer_runtime import inclinometer_store
from softneck.plant._index_runtime import NECK_SENSOR_LAG
from softneck.plant._mechanics_runtime import neck_constants, neck_load
from softneck.plant._neck_runtime import (
    NECK_QUEUE,
    neck_measure,
    neck_outputs,
    neck_read,
    neck_runge_kutta,
)

# No drive has so much torque [N m]: what limits it is the drive's business.
WINCH_NO_LIMIT = 1e3


def winch_constants(c: tuple) -> tuple:
    """Return the neck's constants `c` with drives that pass on the torque they are given."""
    d = c[5]
    passive = (d[0], d[1], 0.0, 0.0, WINCH_NO_LIMIT, d[5], d[6], d[7], d[8], d[9])
    return c[0], c[1], c[2], c[3], c[4], passive, c[6]


def winch_advance(
    x: tuple,
    torques: tuple[float, float, float],
    free: tuple[float, float, float],
    c: tuple,
    load: tuple,
    h: float,
    count: int,
) -> tuple:
    """Return the continuous states `h` [s] later under constant `torques` [N m] of the motors at the winches.

    `c` is of `winch_constants`, `load` of `neck_load`; `count` Runge-Kutta steps are taken.
    """
    x = (
        x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8], x[9], x[10], x[11], x[12], x[13],
        torques[0], torques[1], torques[2], x[17], x[18],
    )  # fmt: skip
    for _ in range(count):
        x = neck_runge_kutta(x, h / count, (0.0, 0.0, 0.0), free, c, load)
    return x


def winch_sense(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    disturbance: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Take one sample of the inclinometer and fill `outputs` (14,) as the neck's own step does.

    To be called once each sample time; `disturbance` is (payload, push x, push y, base tilt pitch and roll).
    """
    c = neck_constants(parameters)
    load = neck_load(
        parameters,
        float(disturbance[0]),
        float(disturbance[1]),
        float(disturbance[2]),
        float(disturbance[3]),
        float(disturbance[4]),
    )
    x = neck_read(state)
    lean = lean_angles((x[0], x[1], x[3], x[4]), bend_functions(x[0] * x[0] + x[1] * x[1]), load[2])
    lag = float(parameters[NECK_SENSOR_LAG])
    history = state[NECK_QUEUE + 3 * int(arrays[0][0, 2]) :]
    inclinometer_store(history, (x[17], x[18], (lean[0] - x[17]) / lag, (lean[1] - x[18]) / lag, lean[2], lean[3]))
    neck_measure(arrays[0][0], parameters, state)
    neck_outputs(parameters, state, c, load, outputs)
