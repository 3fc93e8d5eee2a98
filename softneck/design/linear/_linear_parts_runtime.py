"""Any linear two-degree-of-freedom controller of both axes: equations, conditioning, alignment.

    reference filter   rf = Cf xf + Df r,               xf+ = Af xf + Bf r
    controller          v = C x + Dr rf + Dy y,          x+ = A x + Br rf + By y + L (v_limited - v)

L = Br Dr^-1 is the conditioning technique: the state is what it would be had the reference asked for no more
than the motors can do (Hanus, Kinnaert and Henrotte 1987, Automatica 23:729).
"""

import math

import numpy as np

from softneck.design.linear._allocation_runtime import allocate
from softneck.runtime._layout import Arrays, StateVector, array, cells
from softneck.runtime._rest_runtime import REST

LINEAR_REFERENCE_LIMIT = 0.8  # [rad], as the ports' min and max
LINEAR_MOTOR_LIMIT = 6.0  # [rad], the paper's largest rotation (section 3.1)


class FilterArrays(Arrays):
    """The reference filter, from r = (pitch, roll, co-contraction) to rf."""

    Af = array("m, m", "rf = Cf xf + Df r, xf+ = Af xf + Bf r")
    Bf = array("m, 3", "")
    Cf = array("3, m", "")
    Df = array("3, 3", "")


class LinearArrays(FilterArrays):
    """A controller from rf and y = (pitch, roll) to v = (theta_i, phi_i)."""

    A = array("n, n", "v = C x + Dr rf + Dy y, x+ = A x + Br rf + By y + L (v_limited - v)")
    Br = array("n, 2", "")
    By = array("n, 2", "")
    C = array("2, n", "")
    Dr = array("2, 2", "")
    Dy = array("2, 2", "")
    L = array("n, 2", "conditioning")
    align = array("n, 4", "from y and v to the state nearest to rest that asks for v")
    rest = array("m, 3", "from r to the filter's state at rest")
    T = array("3, 3", "of Eq. 9-11: motors to (theta_i, phi_i, delta_i)")
    T_inverse = array("3, 3", "redefined inputs to motors")
    constants = array("1", "sample time [s]")


class LinearState(StateVector):
    """What every linear controller remembers; kinds add what else they do."""

    xf = cells("m", "state of the reference filter")
    x = cells("n", "state of the controller")
    held = cells("3", "set-points held [rad]")
    started = cells("", "1 from the first step on")


def linear_align(p: LinearArrays, x: LinearState, y: np.ndarray) -> None:
    """Choose the state that asks for the held set-points while the reference is where the neck is: no bump."""
    v = np.dot(p.T, x.held)
    known = np.empty(4)
    known[:2] = y
    known[2:] = v[:2]
    # As if the references had been y and the co-contraction of now for ever.
    rest = np.empty(3)
    rest[:2] = y
    rest[2] = v[2]
    x.xf[:] = np.dot(p.rest, rest)
    x.x[:] = np.dot(p.align, known)


def linear_finite(inputs: np.ndarray) -> bool:
    """Return whether references, angles and motor positions are numbers."""
    total = 0.0  # one that is none makes the sum none
    for i in range(8):
        total += inputs[i]
    return math.isfinite(total)


def linear_control(p: LinearArrays, parameters: np.ndarray, x: LinearState, inputs: np.ndarray) -> None:
    """One sample of filter, controller, limits and conditioning."""
    y = inputs[3:5]
    r = linear_asked(parameters, inputs)
    # Of now, before the filter moves on: r acts at once where Df lets it.
    rf = linear_reference(p, parameters, x.xf, inputs)
    wanted = np.empty(3)
    wanted[:2] = np.dot(p.C, x.x) + np.dot(p.Dr, rf[:2]) + np.dot(p.Dy, y)
    wanted[2] = rf[2]
    # Position, lead, move in one sample, least position.
    limits = np.array([parameters[0], parameters[2], parameters[1] * p.constants[0], parameters[3]])
    allocate(p.T_inverse, wanted, limits, inputs[5:8], x.held)
    # What the limits took away: the controller's state moves as if it had never been asked for.
    excess = np.dot(p.T, x.held)[:2] - wanted[:2]
    # Last, as v is of the states of now.
    x.xf[:] = (np.dot(p.Af, x.xf) + np.dot(p.Bf, r) + REST) - REST
    ahead = np.dot(p.A, x.x) + np.dot(p.Br, rf[:2]) + np.dot(p.By, y) + np.dot(p.L, excess)
    x.x[:] = (ahead + REST) - REST


def linear_asked(parameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the references (3,) within what may be asked for."""
    r = np.empty(3)
    for i in range(2):
        r[i] = min(max(inputs[i], -LINEAR_REFERENCE_LIMIT), LINEAR_REFERENCE_LIMIT)
    # Before the filter, so that motors which start below the least co-contraction come to it without a bump.
    r[2] = min(max(inputs[2], -LINEAR_MOTOR_LIMIT, parameters[4]), LINEAR_MOTOR_LIMIT)
    return r


def linear_reference(p: FilterArrays, parameters: np.ndarray, xf: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the filtered references (3,) of now."""
    return np.dot(p.Cf, xf) + np.dot(p.Df, linear_asked(parameters, inputs))
