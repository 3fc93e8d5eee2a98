"""Kalman filter with its covariance; equations of Kalman 1960, update in the form of Joseph (Bucy and Joseph 1968).

State vector: x (n,), P (n, n), lines of past inputs (2, length), tail (see `_kalman_parts_runtime`, which also tells
what the arrays hold). The noise levels are parameters, so Q and R are built in every step.
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GAP,
    KALMAN_GATE,
    KALMAN_REJECTIONS,
    KALMAN_TAIL,
    kalman_ahead,
    kalman_clear,
    kalman_count,
    kalman_dot,
    kalman_frozen,
    kalman_line_length,
    kalman_push,
    kalman_tell,
    kalman_usable,
)
from softneck.runtime._compiled_runtime import COMPILED


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    n = arrays[0].shape[0]
    return n + n * n + 2 * kalman_line_length(arrays[8]) + KALMAN_TAIL


def initialise(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start at rest, uncertain by P0, with no measurement accepted yet."""
    n = arrays[0].shape[0]
    state[:] = 0.0
    state[n : n + n * n] = arrays[5].reshape(n * n)
    kalman_clear(arrays[8], state)
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Predict with the inputs that acted until now, then take in the measurement where there is a credible one.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid; with gyro pitch_rate_measured,
    roll_rate_measured.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy.
    parameters: measurement noise and two process noises (standard deviations).
    """
    c = arrays[8]
    n = arrays[0].shape[0]
    length = kalman_line_length(c)
    u = np.empty(2)
    lost = kalman_push(arrays, state, inputs, length, u)
    usable = kalman_usable(c, state, inputs, parameters[0])
    forced = state[-2] >= c[KALMAN_REJECTIONS]
    P = state[n : n + n * n].reshape((n, n))
    kalman_predict(arrays, parameters, state[:n], P, u)
    if lost:
        P += c[KALMAN_GAP] * c[KALMAN_GAP] * arrays[3] / arrays[3].max()
    if state[-1] < length:
        # Inputs from before the start are still on their way: the model has no say.
        P += arrays[5]
    elif forced:
        P += arrays[6]
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = kalman_correct(arrays, parameters[0], state, P, inputs, forced)
    kalman_count(c, state, usable, accepted)
    kalman_tell(arrays, state, kalman_frozen(c, state, parameters[0]), length, outputs)
    outputs[4] = innovation
    state[-1] += 1.0


def kalman_predict(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, x: np.ndarray, P: np.ndarray, u: np.ndarray
) -> None:
    """Replace `x` by F x + B u and `P` by F P F' + Q."""
    F, QM, QW = arrays[0], arrays[3], arrays[4]
    q1, q2 = parameters[1] * parameters[1], parameters[2] * parameters[2]
    x[:] = kalman_ahead(F, x, arrays[1], u)
    if not COMPILED:
        np.dot(np.dot(F, P), F.T, P)
        P += q1 * QM
        P += q2 * QW
        return
    kalman_sandwich(F, P)
    for i in range(F.shape[0]):
        for j in range(F.shape[0]):
            P[i, j] += q1 * QM[i, j] + q2 * QW[i, j]


def kalman_correct(
    arrays: tuple[np.ndarray, ...],
    noise: float,
    state: np.ndarray,
    P: np.ndarray,
    inputs: np.ndarray,
    forced: bool,
) -> tuple[float, bool]:
    """Take the measurement into x and P unless the gate refuses; return e' S^-1 e and whether it was taken in."""
    H, c = arrays[2], arrays[8]
    n = H.shape[1]
    x = state[:n]
    e = inputs[3:5] - kalman_dot(H, x)
    e0, e1, r = float(e[0]), float(e[1]), float(noise * noise)
    PH = kalman_columns(P, H)
    S = kalman_columns(H, PH.T)
    s00, s01, s11 = float(S[0, 0]) + r, 0.5 * float(S[0, 1] + S[1, 0]), float(S[1, 1]) + r
    determinant = s00 * s11 - s01 * s01
    innovation = (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / determinant
    state[-9] = math.log(determinant)
    if not (forced or innovation <= c[KALMAN_GATE]):
        return innovation, False
    S[0, 0] = s11 / determinant
    S[1, 1] = s00 / determinant
    S[0, 1] = S[1, 0] = -s01 / determinant
    K = kalman_columns(PH, S)
    x += kalman_dot(K, e)
    kalman_joseph(P, K, H, r)
    return innovation, True


def kalman_joseph(P: np.ndarray, K: np.ndarray, H: np.ndarray, r: float) -> None:
    """Replace `P` by (I - K H) P (I - K H)' + r K K', which no rounding makes indefinite."""
    n = P.shape[0]
    if not COMPILED:
        J = np.dot(K, H)
        J *= -1.0
        J.ravel()[:: n + 1] += 1.0
        np.dot(np.dot(J, P), J.T, P)
        P += np.dot(r * K, K.T)
        return
    J = np.zeros((n, n))
    for i in range(n):
        J[i, i] = 1.0
        for j in range(n):
            J[i, j] -= K[i, 0] * H[0, j] + K[i, 1] * H[1, j]
    kalman_sandwich(J, P)
    for i in range(n):
        for j in range(n):
            P[i, j] += r * (K[i, 0] * K[j, 0] + K[i, 1] * K[j, 1])


def kalman_columns(A: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return A H', two columns."""
    if not COMPILED:
        return np.dot(A, H.T)
    Y = np.zeros((A.shape[0], 2))
    for k in range(A.shape[1]):
        h0, h1 = H[0, k], H[1, k]
        for i in range(A.shape[0]):
            Y[i, 0] += A[i, k] * h0
            Y[i, 1] += A[i, k] * h1
    return Y


def kalman_sandwich(A: np.ndarray, P: np.ndarray) -> None:
    """Replace the symmetric `P` by A P A'; small matrices are faster in loops than through BLAS."""
    n = A.shape[0]
    W = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            if A[i, k] != 0.0:
                for j in range(n):
                    W[i, j] += A[i, k] * P[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += W[i, k] * A[j, k]
            P[i, j] = total
            P[j, i] = total
