"""Gains of the filter in steady state, for targets too small for its covariance."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, SettingsError

from ._kalman_parts_runtime import KALMAN_DIVIDER, KalmanArrays


def steady_covariance(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> Matrix:
    """Return the covariance (n, n) before a measurement, when one came every sensor period for long.

    Over the m samples of a period the state goes by F^m, with the noise of all m (Anderson and Moore 1979, sec. 4.4).
    """
    from scipy.linalg import solve_discrete_are

    F, H, Q, R = system(arrays, noise)
    Fm, Qm = np.eye(F.shape[0]), np.zeros_like(Q)
    for _ in range(int(KalmanArrays(arrays).constants[KALMAN_DIVIDER])):
        Fm, Qm = F @ Fm, F @ Qm @ F.T + Q
    try:
        P = np.asarray(solve_discrete_are(Fm.T, H.T, Qm, R))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SettingsError(f"these noise levels have no steady filter ({error}); give each process noise.") from error
    # The solver works to some 1e-10 of its largest number; what it left the recursion takes away.
    for _ in range(50):
        K, _ = gain(P, H, R)
        J = np.eye(len(P)) - K @ H
        P = Fm @ (J @ P @ J.T + K @ R @ K.T) @ Fm.T + Qm
    return 0.5 * (P + P.T)


def steady_gains(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, ...]:
    """Return gain and inverse innovation covariance in steady state, at the start and by force: six matrices."""
    P, p, R = steady_covariance(arrays, noise), KalmanArrays(arrays), noise[0] ** 2 * np.eye(2)
    pairs = (gain(P, p.H, R), gain(P + p.P0, p.H, R), gain(P + p.PF, p.H, R))
    return tuple(np.ascontiguousarray(matrix) for pair in pairs for matrix in pair)


def gain(P: Matrix, H: Matrix, R: Matrix) -> tuple[Matrix, Matrix]:
    """Return K = P H' S^-1 (n, 2) and S^-1 (2, 2)."""
    SI = np.linalg.inv(H @ P @ H.T + R)
    return P @ H.T @ SI, SI


def system(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return F, H, Q and R of one sample."""
    p = KalmanArrays(arrays)
    measurement, first, second = noise
    return p.F, p.H, first**2 * p.first_noise + second**2 * p.second_noise, measurement**2 * np.eye(2)
