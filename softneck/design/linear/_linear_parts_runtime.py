"""Any linear two-degree-of-freedom controller of both axes: equations, conditioning, alignment.

    reference filter   rf = Cf xf + Df r,               xf+ = Af xf + Bf r
    controller          v = C x + Dr rf + Dy y,          x+ = A x + Br rf + By y + L (v_limited - v)

L = Br Dr^-1 is the conditioning technique: the state is what it would be had the reference asked for no more
than the motors can do (Hanus, Kinnaert and Henrotte 1987, Automatica 23:729).

The state vector begins with xf (m,), x (n,), set-points held (3,). Arrays: Af, Bf, Cf, Df, A, Br, By, C, Dr, Dy, L,
align, rest, T, T_inverse, constants (sample time [s]).
"""

import numpy as np

from softneck.design.linear._allocation_runtime import allocate

LINEAR_REFERENCE_LIMIT = 0.8
LINEAR_MOTOR_LIMIT = 6.0


def linear_align(arrays: tuple[np.ndarray, ...], state: np.ndarray, y: np.ndarray) -> None:
    """Choose the state that asks for the held set-points while the reference is where the neck is: no bump."""
    m, n = arrays[0].shape[0], arrays[4].shape[0]
    v = np.dot(arrays[13], state[m + n : m + n + 3])
    known = np.empty(4)
    known[:2] = y
    known[2:] = v[:2]
    rest = np.empty(3)
    rest[:2] = y
    rest[2] = v[2]
    state[:m] = np.dot(arrays[12], rest)
    state[m : m + n] = np.dot(arrays[11], known)


def linear_control(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray
) -> None:
    """One sample of filter, controller, limits and conditioning."""
    m, n = arrays[0].shape[0], arrays[4].shape[0]
    xf, x, held = state[:m].copy(), state[m : m + n].copy(), state[m + n : m + n + 3]
    y = inputs[3:5]

    r = linear_asked(parameters, inputs)
    rf = linear_reference(arrays, parameters, xf, inputs)
    wanted = np.empty(3)
    wanted[:2] = np.dot(arrays[7], x) + np.dot(arrays[8], rf[:2]) + np.dot(arrays[9], y)
    wanted[2] = rf[2]
    limits = np.array([parameters[0], parameters[2], parameters[1] * arrays[15][0], parameters[3]])
    allocate(arrays[14], wanted, limits, inputs[5:8], held)

    excess = np.dot(arrays[13], held)[:2] - wanted[:2]
    state[:m] = np.dot(arrays[0], xf) + np.dot(arrays[1], r)
    x = np.dot(arrays[4], x) + np.dot(arrays[5], rf[:2]) + np.dot(arrays[6], y) + np.dot(arrays[10], excess)
    state[m : m + n] = x


def linear_asked(parameters: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Return the references (3,) within what may be asked for."""
    r = np.empty(3)
    for i in range(2):
        r[i] = min(max(inputs[i], -LINEAR_REFERENCE_LIMIT), LINEAR_REFERENCE_LIMIT)
    # Before the filter, so that motors which start below the least co-contraction come to it without a bump.
    r[2] = min(max(inputs[2], -LINEAR_MOTOR_LIMIT, parameters[4]), LINEAR_MOTOR_LIMIT)
    return r


def linear_reference(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, xf: np.ndarray, inputs: np.ndarray
) -> np.ndarray:
    """Return the filtered references (3,) of now."""
    return np.dot(arrays[2], xf) + np.dot(arrays[3], linear_asked(parameters, inputs))
