"""Any linear two-degree-of-freedom controller of all axes: equations, conditioning, alignment.

    reference filter   rf = Cf xf + Df r,               xf+ = Af xf + Bf r
    controller          v = C x + Dr rf + Dy y,          x+ = A x + Br rf + By y + L (v_limited - v)

L = Br Dr^-1 is the conditioning technique: the state is what it would be had the reference asked for no more
than the motors can do (Hanus, Kinnaert and Henrotte 1987, Automatica 23:729).
"""

import math

import numpy as np

from softneck.design.linear._allocation_runtime import allocate
from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._products_runtime import add_product, product
from softneck.runtime._rest_runtime import REST

LINEAR_REFERENCE_LIMIT = 0.8  # [rad], as the ports' min and max
LINEAR_MOTOR_LIMIT = 6.0  # [rad], the paper's largest rotation (section 3.1)


def linear_outputs(direct: np.ndarray) -> int:
    """Return the number of outputs: the references are one more, co-contraction."""
    return direct.shape[0] - 1


def linear_motors(inverse: np.ndarray) -> int:
    """Return the number of motors."""
    return inverse.shape[0]


class FilterArrays(Arrays):
    """The reference filter, from r = (pitch, roll, co-contraction) to rf."""

    Af = array("m, m", "rf = Cf xf + Df r, xf+ = Af xf + Bf r")
    Bf = array("m, references", "")
    Cf = array("references, m", "")
    Df = array("references, references", "")
    outputs = value("Df", function=linear_outputs, written=True)


class LinearArrays(FilterArrays):
    """A controller from rf and y = (pitch, roll) to v = (theta_i, phi_i)."""

    A = array("n, n", "v = C x + Dr rf + Dy y, x+ = A x + Br rf + By y + L (v_limited - v)")
    Br = array("n, outputs", "")
    By = array("n, outputs", "")
    C = array("outputs, n", "")
    Dr = array("outputs, outputs", "")
    Dy = array("outputs, outputs", "")
    L = array("n, outputs", "conditioning")
    align = array("n, 2 * outputs", "from y and v to the state nearest to rest that asks for v")
    rest = array("m, references", "from r to the filter's state at rest")
    T = array("references, motors", "of Eq. 9-11: motors to (theta_i, phi_i, delta_i)")
    T_inverse = array("motors, references", "redefined inputs to motors")
    constants = array(
        "numbers = 1 | 1 + 2 * motors + 2 * references",
        "sample time [s]; of other robots than the neck also the lowest and highest set-points, and references",
    )
    motors = value("T_inverse", function=linear_motors, written=True)


class LinearState(StateVector):
    """State of every linear controller; kinds add their own."""

    xf = cells("m", "state of the reference filter")
    x = cells("n", "state of the controller")
    held = cells("motors", "set-points held [rad]")
    started = cells("", "1 from the first step on")


def linear_align(p: LinearArrays, x: LinearState, y: np.ndarray) -> None:
    """Choose the state that asks for the held set-points while the reference is where the neck is: no bump."""
    v = product(p.T, x.held)
    known = np.empty(2 * p.outputs)
    known[: p.outputs] = y
    known[p.outputs :] = v[: p.outputs]
    # As if the references had been y and the co-contraction of now for ever.
    rest = np.empty(p.outputs + 1)
    rest[: p.outputs] = y
    rest[p.outputs] = v[p.outputs]
    x.xf[:] = product(p.rest, rest)
    x.x[:] = product(p.align, known)


def linear_finite(inputs: np.ndarray) -> bool:
    """Return whether references, angles and motor positions are numbers: all inputs but the two flags."""
    total = 0.0  # one that is none makes the sum none
    for i in range(inputs.shape[0] - 2):
        total += inputs[i]
    return math.isfinite(total)


def linear_step(
    p: LinearArrays, parameters: np.ndarray, x: LinearState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Compute the set-points for now, and the state for the next sample."""
    # One that is none would stay in the state for good: the motors hold until all are there again.
    if not linear_finite(inputs):
        outputs[:] = x.held
        return
    flags = 2 * p.outputs + 1 + p.motors
    # Whoever had the motors before: this controller takes over where they are.
    if x.started == 0.0:
        x.held[:] = inputs[2 * p.outputs + 1 : flags]
    active = inputs[flags] > 0.5 and inputs[flags + 1] > 0.5
    # Held set-points and an aligned state for as long as it may not act, so that it begins without a bump.
    if x.started == 0.0 or not active:
        linear_align(p, x, inputs[p.outputs + 1 : 2 * p.outputs + 1])
    x.started = 1.0
    if active:
        linear_control(p, parameters, x, inputs)
    outputs[:] = x.held


def linear_control(p: LinearArrays, parameters: np.ndarray, x: LinearState, inputs: np.ndarray) -> None:
    """One sample of filter, controller, limits and conditioning."""
    y = inputs[p.outputs + 1 : 2 * p.outputs + 1]
    r = linear_asked(p, p.constants, parameters, inputs)
    # Of now, before the filter moves on: r acts at once where Df lets it.
    rf = linear_reference(p, p.constants, parameters, x.xf, inputs)
    wanted = np.zeros(p.outputs + 1)
    add_product(p.C, x.x, wanted)
    add_product(p.Dr, rf, wanted)
    add_product(p.Dy, y, wanted)
    wanted[p.outputs] = rf[p.outputs]
    # Of other robots set-points may go from a pressure of zero on: co-contraction is raised to that always.
    taut = p.numbers > 1 or parameters[3] > -parameters[0]
    motors = inputs[2 * p.outputs + 1 : 2 * p.outputs + 1 + p.motors]
    allocate(p.T_inverse, wanted, linear_limits(p, parameters), taut, motors, x.held)
    # What the limits took away: the controller's state moves as if it had never been asked for.
    excess = -wanted
    add_product(p.T, x.held, excess)
    # Last, as v is of the states of now.
    filtered = product(p.Af, x.xf)
    add_product(p.Bf, r, filtered)
    x.xf[:] = (filtered + REST) - REST
    ahead = product(p.A, x.x)
    add_product(p.Br, rf, ahead)
    add_product(p.By, y, ahead)
    add_product(p.L, excess, ahead)
    x.x[:] = (ahead + REST) - REST


def linear_limits(p: LinearArrays, parameters: np.ndarray) -> np.ndarray:
    """Return the limits for `allocate`: lead, move in one sample, lower bound, lowest and highest set-points."""
    limits = np.empty(3 + 2 * p.motors)
    limits[0], limits[1], limits[2] = parameters[2], parameters[1] * p.constants[0], parameters[3]
    for j in range(p.motors):
        low, high = -parameters[0], parameters[0]
        if p.numbers > 1:
            low, high = max(low, p.constants[1 + j]), min(high, p.constants[1 + p.motors + j])
        limits[3 + j] = low
        limits[3 + p.motors + j] = high
    return limits


def linear_asked(p: FilterArrays, constants: np.ndarray, parameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the references (outputs + 1,) within their limits."""
    r = np.empty(p.outputs + 1)
    low, high, least, most = -LINEAR_REFERENCE_LIMIT, LINEAR_REFERENCE_LIMIT, -LINEAR_MOTOR_LIMIT, LINEAR_MOTOR_LIMIT
    # Of another robot the last constants: lowest, then highest of each reference.
    first = constants.shape[0] - 2 * (p.outputs + 1)
    for i in range(p.outputs):
        if first > 0:
            low, high = constants[first + i], constants[first + p.outputs + 1 + i]
        r[i] = min(max(inputs[i], low), high)
    if first > 0:
        least, most = constants[first + p.outputs], constants[first + 2 * p.outputs + 1]
    # Before the filter, so that motors which start below the least co-contraction come to it without a bump.
    r[p.outputs] = min(max(inputs[p.outputs], least, parameters[4]), most)
    return r


def linear_reference(
    p: FilterArrays, constants: np.ndarray, parameters: np.ndarray, xf: np.ndarray, inputs: np.ndarray
) -> np.ndarray:
    """Return the filtered references (outputs + 1,) of now."""
    rf = product(p.Cf, xf)
    add_product(p.Df, linear_asked(p, constants, parameters, inputs), rf)
    return rf
