"""Linear axes with delays and cross gains as a plant; motors follow their set-points at once."""

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._products_runtime import product
from softneck.runtime._random_runtime import random_normal, random_seed


def axis_advance(x: np.ndarray, numerator: np.ndarray, denominator: np.ndarray, u: float) -> None:
    """Advance by one sample under the input `u`; x[0] is the angle, the last entry stays zero.

    numerator, denominator: as long as x, highest power of z first; they begin with 0 and 1.
    """
    y = x[0]
    # Observable form: x[j] is what past inputs and outputs still do to the angle j samples from now.
    for j in range(x.shape[0] - 1):
        x[j] = x[j + 1] - denominator[j + 1] * y + numerator[j + 1] * u


def linear_plant_line(delay: np.ndarray) -> int:
    """Return how many inputs each axis keeps: those of its delay, and the one of now."""
    return int(delay.max()) + 1


class LinearPlantArrays(Arrays):
    """Transfer functions of pitch and roll from redefined inputs, or of another robot's outputs."""

    numerator = array("axes, q", "b of each axis, highest power first; begins with 0")
    denominator = array("axes, q", "a of each axis; begins with 1")
    delay = array("axes", "samples beyond the first until an input acts")
    mixed = array("axes, axes", "ones, and what of the other axes' inputs is added to an axis' own")
    T = array("references, motors", "of Eq. 9-11: motors to redefined inputs")
    around = array("axes", "outputs around which the plant is linear")
    line = value("delay", function=linear_plant_line)


class LinearPlantState(StateVector):
    """State of each axis."""

    random = cells("6", "generator of the measurement noise")
    x = cells("axes, q", "observable form of each axis, its angle first [rad]; the last entry stays zero")
    u = cells("axes, line", "inputs of each axis, newest first [rad]")


def initialise(p: LinearPlantArrays, parameters: np.ndarray, x: LinearPlantState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, outputs where the plant is linear."""
    x[:] = 0.0
    random_seed(x.random, parameters[1])
    outputs[:] = 0.0
    for axis in range(p.axes):
        outputs[axis] = p.around[axis]
        outputs[p.axes + axis] = p.around[axis]
        if parameters[0] > 0.0:
            outputs[p.axes + axis] += parameters[0] * random_normal(x.random)


def step(
    p: LinearPlantArrays, parameters: np.ndarray, x: LinearPlantState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance by one sample.

    inputs: motor_setpoint_1..3, load_pitch, load_roll. parameters: noise_std [rad], noise_seed.
    outputs: pitch, roll, pitch_measured, roll_measured, motor_position_1..3.
    """
    tilt = product(p.T, inputs[: p.motors])  # Eq. 9-11
    for axis in range(p.axes):
        held, own = x.u[axis], x.x[axis]
        for j in range(p.line - 1, 0, -1):
            held[j] = held[j - 1]
        # The other axes' inputs leak in; a load acts as an input does, before the dead time.
        total = tilt[axis]
        for other in range(p.axes):
            if other != axis:
                total += p.mixed[axis, other] * tilt[other]
        held[0] = total + inputs[p.motors + axis]
        axis_advance(own, p.numerator[axis], p.denominator[axis], held[int(p.delay[axis])])
        outputs[axis] = p.around[axis] + own[0]
        outputs[p.axes + axis] = outputs[axis]
        if parameters[0] > 0.0:
            outputs[p.axes + axis] += parameters[0] * random_normal(x.random)
    # No drives between: set-points are reached at once.
    outputs[2 * p.axes : 2 * p.axes + p.motors] = inputs[: p.motors]
