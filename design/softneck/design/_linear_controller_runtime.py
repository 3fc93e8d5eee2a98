"""Any linear two-degree-of-freedom controller of both axes, with limits, conditioning and tendon allocation.

    reference filter   rf = Cf xf + Df r,               xf+ = Af xf + Bf r
    controller          v = C x + Dr rf + Dy y,          x+ = A x + Br rf + By y + L (v_limited - v)

L = Br Dr^-1 is the conditioning technique: the state is what it would be had the reference asked for no more
than the motors can do (Hanus, Kinnaert and Henrotte 1987, Automatica 23:729).

State vector: xf (m,), x (n,), set-points held (3,), whether started.
"""

import numpy as np

LINEAR_REFERENCE_LIMIT = 0.8
LINEAR_MOTOR_LIMIT = 6.0


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return arrays[0].shape[0] + arrays[4].shape[0] + 4


def initialise(
    arrays: tuple[np.ndarray, ...],  # noqa: ARG001
    parameters: np.ndarray,  # noqa: ARG001
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start with motors at rest; the first step takes over where they really are."""
    state[:] = 0.0
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad].
    """
    m, n = arrays[0].shape[0], arrays[4].shape[0]
    if state[-1] == 0.0:
        state[m + n : m + n + 3] = inputs[5:8]
    active = inputs[8] > 0.5 and inputs[9] > 0.5
    if state[-1] == 0.0 or not active:
        linear_align(arrays, state, inputs[3:5])
    state[-1] = 1.0
    if active:
        linear_control(arrays, parameters, state, inputs)
    outputs[:] = state[m + n : m + n + 3]


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
    r = np.empty(3)
    for i in range(2):
        r[i] = min(max(inputs[i], -LINEAR_REFERENCE_LIMIT), LINEAR_REFERENCE_LIMIT)
    r[2] = min(max(inputs[2], -LINEAR_MOTOR_LIMIT), LINEAR_MOTOR_LIMIT)
    y = inputs[3:5]

    rf = np.dot(arrays[2], xf) + np.dot(arrays[3], r)
    wanted = np.empty(3)
    wanted[:2] = np.dot(arrays[7], x) + np.dot(arrays[8], rf[:2]) + np.dot(arrays[9], y)
    wanted[2] = rf[2]
    target = np.empty(3)
    linear_allocate(arrays[14], wanted, parameters[0], target)
    for j in range(3):
        target[j] = min(max(target[j], inputs[5 + j] - parameters[2]), inputs[5 + j] + parameters[2])
    linear_move(target, parameters[1] * arrays[15][0], held)

    excess = np.dot(arrays[13], held)[:2] - wanted[:2]
    state[:m] = np.dot(arrays[0], xf) + np.dot(arrays[1], r)
    x = np.dot(arrays[4], x) + np.dot(arrays[5], rf[:2]) + np.dot(arrays[6], y) + np.dot(arrays[10], excess)
    state[m : m + n] = x


def linear_allocate(inverse: np.ndarray, wanted: np.ndarray, position: float, target: np.ndarray) -> None:
    """Fill `target` (3,) with the motors of `wanted` (theta_i, phi_i, delta_i), within +-position.

    The limit is shared: the tilt is scaled as a whole, so its direction stays. Co-contraction comes before
    tilt; `inverse` is that of Eq. 9-11.
    """
    common = np.empty(3)
    tilt = np.empty(3)
    scale = 1.0
    for j in range(3):
        common[j] = min(max(inverse[j, 2] * wanted[2], -position), position)
        tilt[j] = inverse[j, 0] * wanted[0] + inverse[j, 1] * wanted[1]
        if tilt[j] > 0.0:
            scale = min(scale, (position - common[j]) / tilt[j])
        elif tilt[j] < 0.0:
            scale = min(scale, (position + common[j]) / -tilt[j])
    for j in range(3):
        target[j] = common[j] + scale * tilt[j]


def linear_move(target: np.ndarray, move: float, held: np.ndarray) -> None:
    """Move `held` (3,) straight towards `target`, no motor further than `move` [rad]."""
    largest = 0.0
    for j in range(3):
        largest = max(largest, abs(target[j] - held[j]))
    share = 1.0 if largest <= move else move / largest
    for j in range(3):
        held[j] += share * (target[j] - held[j])
