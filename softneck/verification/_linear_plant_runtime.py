"""Two axes with cross gains, each a transfer function behind its delay, motors where they were told to be."""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._random_runtime import random_normal, random_seed
from softneck.verification._axis_runtime import axis_advance


def linear_plant_line(delay: np.ndarray) -> int:
    """Return how many inputs each axis keeps: those of its delay, and the one of now."""
    return int(delay.max()) + 1


class LinearPlantArrays(Arrays):
    """Transfer functions of pitch and roll from redefined inputs."""

    numerator = array("2, q", "b of each axis, highest power first; begins with 0")
    denominator = array("2, q", "a of each axis; begins with 1")
    delay = array("2", "samples beyond the first until an input acts")
    cross = array("2", "what of the other axis' input is added to an axis' own")
    T = array("3, 3", "of Eq. 9-11: motors to redefined inputs")
    line = value("delay", function=linear_plant_line)


class LinearPlantState(StateVector):
    """What each axis remembers."""

    random = cells("6", "generator of the measurement noise")
    x = cells("2, q", "observable form of each axis, its angle first [rad]; the last entry stays zero")
    u = cells("2, line", "inputs of each axis, newest first [rad]")


def initialise(p: LinearPlantArrays, parameters: np.ndarray, x: LinearPlantState, outputs: np.ndarray) -> None:
    """Rest: motors and angles at zero."""
    x[:] = 0.0
    random_seed(x.random, parameters[1])
    outputs[:] = 0.0
    if parameters[0] > 0.0:
        for axis in range(2):
            outputs[2 + axis] = parameters[0] * random_normal(x.random)


def step(
    p: LinearPlantArrays, parameters: np.ndarray, x: LinearPlantState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance by one sample.

    inputs: motor_setpoint_1..3, load_pitch, load_roll. parameters: noise_std [rad], noise_seed.
    outputs: pitch, roll, pitch_measured, roll_measured, motor_position_1..3.
    """
    tilt = np.dot(p.T, inputs[:3])  # Eq. 9-11
    for axis in range(2):
        held, own = x.u[axis], x.x[axis]
        for j in range(p.line - 1, 0, -1):
            held[j] = held[j - 1]
        # The other axis' input leaks in; a load acts as an input does, before the dead time.
        held[0] = tilt[axis] + p.cross[axis] * tilt[1 - axis] + inputs[3 + axis]
        axis_advance(own, p.numerator[axis], p.denominator[axis], held[int(p.delay[axis])])
        outputs[axis] = own[0]
        outputs[2 + axis] = own[0]
        if parameters[0] > 0.0:
            outputs[2 + axis] += parameters[0] * random_normal(x.random)
    # No drives between: set-points are reached at once.
    outputs[4:7] = inputs[:3]
