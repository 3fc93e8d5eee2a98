"""The recursion of recursive least squares (Eq. 28-30)."""

import numpy as np


def rls_recursion(
    regressors: np.ndarray, targets: np.ndarray, theta: np.ndarray, covariance: np.ndarray, forgetting: float
) -> None:
    """Run through all rows, updating `theta` (n,) and F `covariance` (n, n) in place.

    `regressors` (rows, n) holds phi(t) and `targets` (rows,) y(t+1); `forgetting` 1 is Eq. 29, below 1 CFF-RLS.
    """
    for t in range(regressors.shape[0]):
        phi = regressors[t]
        F_phi = np.dot(covariance, phi)
        denominator = forgetting + np.dot(phi, F_phi)  # Eq. 29 has 1 for lambda
        error = targets[t] - np.dot(theta, phi)  # Eq. 30
        gain = F_phi / denominator  # = F(t+1) phi
        theta += gain * error  # Eq. 28
        covariance -= np.outer(gain, F_phi)  # Eq. 29
        covariance /= forgetting  # F grows by what is forgotten; lambda = 1 leaves Eq. 29
