"""Kalman filter with its covariance; equations of Kalman 1960, update in the form of Joseph (Bucy and Joseph 1968).

The noise levels are parameters, so Q and R are built in every step.
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GAP,
    KALMAN_GATE,
    KalmanArrays,
    KalmanState,
    kalman_clear,
    kalman_count,
    kalman_first,
    kalman_forced,
    kalman_push,
    kalman_tell,
    kalman_usable,
)
from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._layout import cells
from softneck.runtime._products_runtime import add_product, product
from softneck.runtime._rest_runtime import REST


class KalmanFullState(KalmanState):
    """The estimate and its covariance."""

    P = cells("n, n", "covariance of x")


def initialise(p: KalmanArrays, parameters: np.ndarray, x: KalmanFullState, outputs: np.ndarray) -> None:
    """Start at rest with covariance P0, without an accepted measurement."""
    x[:] = 0.0
    x.P[:] = p.P0.reshape(p.n * p.n)
    kalman_clear(p.constants, x)
    outputs[:] = 0.0


def step(p: KalmanArrays, parameters: np.ndarray, x: KalmanFullState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Predict with the delayed inputs, then correct if there is a measurement that passes the gate.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid; with gyro pitch_rate_measured,
    roll_rate_measured. Another robot has its own outputs instead of pitch and roll.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy.
    parameters: measurement noise and two process noises (standard deviations).
    """
    c = p.constants
    u = np.empty(p.outputs)
    lost = kalman_push(p, x, inputs, u)
    first = kalman_first(p, inputs)
    measured = inputs[first : first + p.outputs]
    usable = kalman_usable(c, x, measured, float(inputs[first + p.outputs]), parameters[0])
    forced = kalman_forced(c, x)
    P = x.P.reshape((p.n, p.n))
    kalman_predict(p, parameters, x.x, P, u)
    if lost:
        # In the gyro form `first_noise` is diag(T^2, 0): by its largest entry it is 1 on the angles.
        P += c[KALMAN_GAP] * c[KALMAN_GAP] * p.first_noise / p.first_noise.max()
    if x.samples < p.length:
        # Inputs from before the start still act and are unknown.
        P += p.P0
    elif forced:
        # Large enough for the estimate to jump to the measurement.
        P += p.PF
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = kalman_correct(p, parameters[0], x, P, measured, forced)
    kalman_count(c, x, usable, accepted)
    kalman_tell(p, x, parameters[0], outputs)
    outputs[2 * p.outputs] = innovation
    x.samples += 1.0


def kalman_predict(p: KalmanArrays, parameters: np.ndarray, x: np.ndarray, P: np.ndarray, u: np.ndarray) -> None:
    """Replace `x` by F x + B u and `P` by F P F' + Q."""
    q1, q2 = parameters[1] * parameters[1], parameters[2] * parameters[2]
    QM, QW = p.first_noise, p.second_noise  # numba counts references where a loop takes them from `p`
    ahead = product(p.F, x)
    add_product(p.B, u, ahead)
    x[:] = (ahead + REST) - REST
    if not COMPILED:
        np.dot(np.dot(p.F, P), p.F.T, P)
        P += q1 * QM
        P += q2 * QW
        return
    kalman_sandwich(p.F, P)
    for i in range(p.n):
        for j in range(p.n):
            P[i, j] += q1 * QM[i, j] + q2 * QW[i, j]


def kalman_correct(
    p: KalmanArrays, noise: float, x: KalmanFullState, P: np.ndarray, measured: np.ndarray, forced: bool
) -> tuple[float, bool]:
    """Correct x and P unless the gate rejects the measurement; return e' S^-1 e and whether it was accepted."""
    e = measured - product(p.H, x.x)
    r = float(noise * noise)
    PH = kalman_columns(P, p.H)
    S = kalman_columns(p.H, PH.T)
    if p.outputs == 2:
        innovation, log_det = kalman_two(S, e, r)
    else:
        innovation, log_det = kalman_more(S, e, r)
    x.log_det = log_det
    # The gate; x and P stay as predicted if it rejects.
    if not (forced or innovation <= p.constants[KALMAN_GATE]):
        return innovation, False
    K = kalman_columns(PH, S)  # P H' S^-1, which is its own transpose
    estimate = x.x  # numba would copy the slice for `x.x[:] +=`
    estimate += product(K, e)
    kalman_joseph(P, K, p.H, r)
    return innovation, True


def kalman_two(S: np.ndarray, e: np.ndarray, r: float) -> tuple[float, float]:
    """Add R to H P H' of two outputs, replace it by its inverse S^-1; return e' S^-1 e and log det S.

    Written out with the symmetric part and the determinant.
    """
    e0, e1 = float(e[0]), float(e[1])
    s00, s01, s11 = float(S[0, 0]) + r, 0.5 * float(S[0, 1] + S[1, 0]), float(S[1, 1]) + r
    determinant = s00 * s11 - s01 * s01
    # e' S^-1 e, the NIS: chi-square with 2 degrees of freedom for a consistent filter.
    innovation = (s11 * e0 * e0 - 2.0 * s01 * e0 * e1 + s00 * e1 * e1) / determinant
    S[0, 0] = s11 / determinant
    S[1, 1] = s00 / determinant
    S[0, 1] = S[1, 0] = -s01 / determinant
    return innovation, math.log(determinant)


def kalman_more(S: np.ndarray, e: np.ndarray, r: float) -> tuple[float, float]:
    """Invert S for any number of outputs as `kalman_two` does, by S = L L' (Golub and Van Loan, sec. 4.2)."""
    m = S.shape[0]
    L, inverse = np.zeros((m, m)), np.zeros((m, m))
    log_det, innovation = 0.0, 0.0
    for i in range(m):
        for j in range(i + 1):
            total = S[i, i] + r if i == j else 0.5 * (S[i, j] + S[j, i])
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
        log_det += 2.0 * math.log(L[i, i])
        # Row i of L^-1, with which the NIS is the square of L^-1 e.
        whitened = 0.0
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= L[i, k] * inverse[k, j]
            inverse[i, j] = total / L[i, i]
            whitened += inverse[i, j] * e[j]
        innovation += whitened * whitened
    for i in range(m):
        for j in range(m):
            total = 0.0
            for k in range(max(i, j), m):
                total += inverse[k, i] * inverse[k, j]
            S[i, j] = total
    return innovation, log_det


def kalman_joseph(P: np.ndarray, K: np.ndarray, H: np.ndarray, r: float) -> None:
    """Replace `P` by (I - K H) P (I - K H)' + r K K', which stays positive semidefinite under rounding."""
    n = P.shape[0]
    if not COMPILED:
        J = np.dot(K, H)
        J *= -1.0
        # The diagonal of J = I - K H, as a view.
        J.ravel()[:: n + 1] += 1.0
        np.dot(np.dot(J, P), J.T, P)
        P += np.dot(r * K, K.T)
        return
    J = np.zeros((n, n))
    for i in range(n):
        J[i, i] = 1.0
        for j in range(n):
            total = 0.0
            for k in range(K.shape[1]):
                total += K[i, k] * H[k, j]
            J[i, j] -= total
    kalman_sandwich(J, P)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(K.shape[1]):
                total += K[i, k] * K[j, k]
            P[i, j] += r * total


def kalman_columns(A: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return A H', a column for each output."""
    if not COMPILED:
        return np.dot(A, H.T)
    m = H.shape[0]
    Y = np.zeros((A.shape[0], m))
    for k in range(A.shape[1]):
        for i in range(A.shape[0]):
            for j in range(m):
                Y[i, j] += A[i, k] * H[j, k]
    return Y


def kalman_sandwich(A: np.ndarray, P: np.ndarray) -> None:
    """Replace the symmetric `P` by A P A'; small matrices are faster in loops than through BLAS."""
    n = A.shape[0]
    W = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            # The axes are coupled only by the gate: half of F and of I - K H is zero.
            if A[i, k] != 0.0:
                for j in range(n):
                    W[i, j] += A[i, k] * P[k, j]
    for i in range(n):
        # Half is computed and mirrored: P stays exactly symmetric.
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += W[i, k] * A[j, k]
            P[i, j] = total
            P[j, i] = total
