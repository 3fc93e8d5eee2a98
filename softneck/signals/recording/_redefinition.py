"""The input redefinition of the paper's section 2.1 and its inverse, for any tendon angles."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, SettingsError, Vector

#: Where the three tendons stand around the neck [rad], motors at 0, 120 and 240 deg (Eq. 6 and 8).
TENDON_ANGLES = np.radians([0.0, 120.0, 240.0])


def redefinition_matrix(angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return T (3, 3) with (theta_i, phi_i, delta_i) = T (P1, P2, P3) (Eq. 4, 5, 7, 11).

    Args:
        angles: (3,) tendon angles gamma_j [rad].

    Raises:
        SettingsError: the angles do not span the plane, so that T has no inverse.
    """
    gamma = np.asarray(angles, dtype=np.float64)
    if gamma.shape != (3,) or not np.isfinite(gamma).all():
        raise SettingsError(f"three finite tendon angles are needed [rad]; got {gamma.tolist()}.")
    T = np.array([np.cos(gamma), np.sin(gamma), np.full(3, 1.0 / 3.0)])
    # Below this two tendons all but coincide and the inverse would ask for huge motor angles.
    if abs(np.linalg.det(T)) < 1e-3:
        raise SettingsError(f"three tendon angles that span the plane are needed [rad]; got {gamma.tolist()}.")
    T[np.abs(T) < 1e-15] = 0.0
    return T


def redefine(motors: Matrix, angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return theta_i, phi_i, delta_i (time, 3) of motor positions (time, 3) [rad] (Eq. 9-11)."""
    return np.asarray(motors) @ redefinition_matrix(angles).T


def motors_from(inputs: Matrix, angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return the motor positions (time, 3) [rad] that give theta_i, phi_i, delta_i (time, 3): the inverse."""
    return np.asarray(inputs) @ np.linalg.inv(redefinition_matrix(angles)).T
