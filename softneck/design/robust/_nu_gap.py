"""The nu-gap between two systems, by their normalised coprime factors (Vinnicombe 1993, IEEE TAC 38:1371)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector

from ._mu import Array
from ._robustness import grid, highest, is_data

# The phase of the winding number may turn by this much [rad] between two frequencies; beyond it the grid is refined.
_LARGEST_TURN = 0.8
_REFINEMENTS = 12


def nugap(P1: Any, P2: Any) -> float:
    """Return the nu-gap of two systems of one size and time domain: 0 alike, 1 apart.

    A controller whose normalised coprime margin with P1 is above the gap stabilises P2 too. Poles on the border of
    stability, such as integrators, are allowed: with the normalised factors `P = N M^-1` the gap is the largest
    `|-M2~ N1 + N2~ M1|` where `det(N2* N1 + M2* M1)` has no zero and no winding, else 1.

    Raises:
        SettingsError: systems of another kind, size or sample time, or ones without such factors.
    """
    systems = [_state_space(P) for P in (P1, P2)]
    first, second = systems
    if (first.noutputs, first.ninputs) != (second.noutputs, second.ninputs):
        raise SettingsError("`P1` and `P2` must have the same inputs and outputs.")
    if first.dt != second.dt:
        raise SettingsError(f"`P1` and `P2` must have one sample time; they have {first.dt} and {second.dt}.")
    w = np.union1d(grid(first, None), grid(second, None))
    dt = 0.0 if first.dt in (0, None) else 1.0 if isinstance(first.dt, bool) else float(first.dt)
    right = [_right_factors(system, dt) for system in systems]
    left = [_transposed(_right_factors(_transpose(system), dt)) for system in systems]

    def graphs(at: Vector) -> tuple[Array, Array, Array]:
        s = 1j * at if dt == 0.0 else np.exp(1j * at * dt)
        return _value(right[0], s), _value(right[1], s), _value(left[1], s)

    if _winding(graphs, w, dt) != 0:
        return 1.0

    def gap(at: Vector) -> Vector:
        G1, _, L2 = graphs(at)
        outputs = first.noutputs
        # Right factors are [N; M]; left ones [N~, M~], side by side.
        N1, M1 = G1[:, :outputs], G1[:, outputs:]
        Nl, Ml = L2[:, :, : first.ninputs], L2[:, :, first.ninputs :]
        return np.linalg.norm(Nl @ M1 - Ml @ N1, 2, axis=(1, 2))

    return min(1.0, highest(gap, w)[1])


Realisation = tuple[Matrix, Matrix, Matrix, Matrix]


def _state_space(P: Any) -> Any:
    import control

    if is_data(P):
        raise SettingsError("the nu-gap needs poles: give state space or transfer functions, not frequency data.")
    return control.ss(P)


def _transpose(system: Any) -> Any:
    import control

    return control.StateSpace(system.A.T, system.C.T, system.B.T, system.D.T, system.dt)


def _transposed(factors: Realisation) -> Realisation:
    A, B, C, D = factors
    return A.T, C.T, B.T, D.T


def _right_factors(system: Any, dt: float) -> Realisation:
    """Return [N; M], stable, with `N* N + M* M = I` and `P = N M^-1` (Zhou, Doyle and Glover 1996, sec. 13.8)."""
    from scipy.linalg import solve_continuous_are, solve_discrete_are, sqrtm

    A, B, C, D = (np.asarray(item, dtype=np.float64) for item in (system.A, system.B, system.C, system.D))
    n, m = A.shape[0], B.shape[1]
    R = np.eye(m) + D.T @ D
    if n == 0:
        root = np.real(np.asarray(sqrtm(np.linalg.inv(R))))
        return A, B, np.zeros((C.shape[0] + m, 0)), np.vstack([D @ root, root])
    try:
        if dt == 0.0:
            X = solve_continuous_are(A, B, C.T @ C, R, s=C.T @ D)
            S, F = R, -np.linalg.solve(R, B.T @ X + D.T @ C)
        else:
            X = solve_discrete_are(A, B, C.T @ C, R, s=C.T @ D)
            S = R + B.T @ X @ B
            F = -np.linalg.solve(S, B.T @ X @ A + D.T @ C)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SettingsError(
            f"a system has no normalised coprime factors ({error}): an unstable part that its input or output misses?"
        ) from error
    root = np.real(np.asarray(sqrtm(np.linalg.inv(S))))
    return A + B @ F, B @ root, np.vstack([C + D @ F, F]), np.vstack([D, np.eye(m)]) @ root


def _value(system: Realisation, s: Array) -> Array:
    A, B, C, D = system
    if A.shape[0] == 0:
        return np.broadcast_to(D.astype(complex), (s.size, *D.shape))
    return C @ np.linalg.solve(s[:, None, None] * np.eye(A.shape[0]) - A, np.broadcast_to(B, (s.size, *B.shape))) + D


def _winding(graphs: Any, w: Vector, dt: float) -> int:
    """Return how often det(G2* G1) winds around zero over all frequencies; 99 where it comes too near to zero.

    The systems are real: the negative frequencies double the turn of the positive ones, and at both ends the
    determinant is real.
    """
    at = np.concatenate([[0.0], w, [] if dt else [w[-1] * 1e6]])
    turns = np.zeros(0)
    for _ in range(_REFINEMENTS):
        G1, G2, _ = graphs(at)
        value = np.linalg.det(np.conj(np.swapaxes(G2, 1, 2)) @ G1)
        if np.abs(value).min() < 1e-9:
            return 99
        turns = np.angle(value[1:] / value[:-1])
        coarse = np.flatnonzero(np.abs(turns) > _LARGEST_TURN)
        if coarse.size == 0:
            break
        at = np.sort(np.concatenate([at, 0.5 * (at[coarse] + at[coarse + 1])]))
    return round(2.0 * float(turns.sum()) / (2.0 * math.pi))
