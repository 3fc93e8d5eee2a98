"""Kalman filter over two delayed linear axes with output disturbances; equations of Kalman 1960, Joseph form.

State vector: x (n,), P (n, n), set-point lines (2, length), samples since the last accepted measurement,
rejections in a row, samples seen (counted until the lines are full).
"""

import numpy as np


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    n = arrays[0].shape[0]
    return n + n * n + 2 * kalman_line_length(arrays) + 3


def kalman_line_length(arrays: tuple[np.ndarray, ...]) -> int:
    """Return how many past set-points each axis keeps."""
    c = arrays[7]
    return int(max(c[0], c[1])) + 1


def initialise(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,  # noqa: ARG001
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start at rest, uncertain by P0, with no measurement accepted yet."""
    n = arrays[0].shape[0]
    state[:] = 0.0
    state[n : n + n * n] = arrays[5].reshape(n * n)
    state[-3] = arrays[7][4]
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Predict with the set-points held until now, then take in the measurement where there is a credible one.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy.
    parameters: measurement, model and disturbance noise (standard deviations).
    """
    F, B, H, QM, QW, c = arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], arrays[7]
    n = F.shape[0]
    u = np.zeros(2)
    kalman_delay(arrays, state, inputs, u)

    x = np.dot(F, state[:n]) + np.dot(B, u)
    P = np.dot(np.dot(F, state[n : n + n * n].reshape((n, n))), F.T)
    P = P + parameters[1] * parameters[1] * QM + parameters[2] * parameters[2] * QW
    forced = state[-2] >= c[3]
    if forced or state[-1] < kalman_line_length(arrays):
        # So many rejections, or set-points from before the start still on their way: the model has no say.
        P = P + arrays[5]

    innovation = 0.0
    accepted = False
    if inputs[5] > 0.5 and np.isfinite(inputs[3]) and np.isfinite(inputs[4]):
        e = inputs[3:5] - np.dot(H, x)
        S = np.dot(np.dot(H, P), H.T)
        S[0, 0] += parameters[0] * parameters[0]
        S[1, 1] += parameters[0] * parameters[0]
        SI = kalman_inverse(S)
        innovation = np.dot(e, np.dot(SI, e))
        accepted = forced or innovation <= c[2]
        state[-2] = 0.0 if accepted else state[-2] + 1.0
        if accepted:
            K = np.dot(np.dot(P, H.T), SI)
            x = x + np.dot(K, e)
            J = np.eye(n) - np.dot(K, H)
            P = np.dot(np.dot(J, P), J.T) + parameters[0] * parameters[0] * np.dot(K, K.T)
    state[-3] = 0.0 if accepted else min(state[-3] + 1.0, c[4])
    state[-1] = min(state[-1] + 1.0, float(kalman_line_length(arrays)))

    state[:n] = x
    state[n : n + n * n] = P.reshape(n * n)
    angle = np.dot(H, x)
    ahead = np.dot(H, np.dot(F, x) + np.dot(B, u))
    outputs[0] = angle[0]
    outputs[1] = angle[1]
    outputs[2] = (ahead[0] - angle[0]) / c[5]
    outputs[3] = (ahead[1] - angle[1]) / c[5]
    outputs[4] = innovation
    outputs[5] = 1.0 if state[-3] < c[4] else 0.0


def kalman_delay(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray, u: np.ndarray) -> None:
    """Push theta_i, phi_i of the set-points into their lines; fill `u` (2,) with those that act now."""
    n = arrays[0].shape[0]
    T, c = arrays[6], arrays[7]
    length = kalman_line_length(arrays)
    for axis in range(2):
        first = n + n * n + axis * length
        new = T[axis, 0] * inputs[0] + T[axis, 1] * inputs[1] + T[axis, 2] * inputs[2]
        if state[-1] == 0.0:
            # Nothing is known of the past: the set-points stood still.
            state[first : first + length] = new
        for i in range(length - 1, 0, -1):
            state[first + i] = state[first + i - 1]
        state[first] = new
        u[axis] = state[first + int(c[axis])]


def kalman_inverse(S: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite (2, 2)."""
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    inverse = np.empty((2, 2))
    inverse[0, 0] = S[1, 1] / determinant
    inverse[1, 1] = S[0, 0] / determinant
    inverse[0, 1] = -S[0, 1] / determinant
    inverse[1, 0] = -S[1, 0] / determinant
    return inverse
