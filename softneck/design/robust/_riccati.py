"""H-infinity synthesis by two Riccati equations, on scipy alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError

# Gamma is found to 0.01 %: what is built is 5 % above it.
_CLOSENESS = 1e-4
_LARGEST = 1e8
# An eigenvalue of the Hamiltonian this close to the axis (relative to the largest) counts as on it.
_ON_AXIS = 1e-13
# X and Y may come out negative by rounding: relative to their size.
_NEGATIVE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """A generalised plant with D12 = [0; I], D21 = [0 I] and D22 = 0, after scaling of its signals.

    Attributes:
        A, B1, B2, C1, C2: as usual.
        D11: (p1, m1).
        left, right: K of the original plant is `left @ K @ right`.
        D22: what was taken away.
    """

    A: Matrix
    B1: Matrix
    B2: Matrix
    C1: Matrix
    C2: Matrix
    D11: Matrix
    left: Matrix
    right: Matrix
    D22: Matrix


def partition(A: Matrix, B: Matrix, C: Matrix, D: Matrix, *, nmeas: int, ncon: int) -> Partition:
    """Return the plant scaled to the form of Zhou, Doyle and Glover (1996), sec. 17.1.

    Raises:
        SettingsError: D12 without full column rank, or D21 without full row rank; both make solvers hang or lie.
    """
    m1, p1 = B.shape[1] - ncon, C.shape[0] - nmeas
    D11, D12, D21, D22 = D[:p1, :m1], D[:p1, m1:], D[p1:, :m1], D[p1:, m1:]
    U, s, Vh = np.linalg.svd(D12)
    if p1 < ncon or s.min(initial=np.inf) < 1e-9 * max(1.0, s.max(initial=0.0)):
        raise SettingsError(
            "the control effort is not weighted at high frequencies (D12 has not full rank), where the search for a "
            "controller hangs: give W2 a gain there, a number for example, or a W3 with as many zeros as poles."
        )
    V, t, Wh = np.linalg.svd(D21)
    if m1 < nmeas or t.min(initial=np.inf) < 1e-9 * max(1.0, t.max(initial=0.0)):
        raise SettingsError("the measurement has no input of its own (D21 has not full rank); add sensor noise to it.")
    # z = Uz z', u = left u', y' = right y, w = Ww w'.
    Uz = np.hstack([U[:, ncon:], U[:, :ncon]])
    left = Vh.T / s
    Ww = np.hstack([Wh[nmeas:].T, Wh[:nmeas].T])
    right = (V / t).T
    return Partition(
        A, B[:, :m1] @ Ww, B[:, m1:] @ left, Uz.T @ C[:p1], right @ C[p1:], Uz.T @ D11 @ Ww, left, right, D22
    )


def least_gamma(plant: Partition) -> float:
    """Return the least gamma for which a controller exists, 0.01 % above at most.

    Raises:
        SettingsError: none up to 1e8.
    """
    low, high = 0.0, 1.0
    while solve_at(plant, high) is None:
        low, high = high, 4.0 * high
        if high > _LARGEST:
            raise SettingsError(
                "no controller exists for any gamma: the plant cannot be stabilised, or a weight is not stable."
            )
    while high - low > _CLOSENESS * high:
        middle = 0.5 * (low + high) if low > 0.0 else 0.25 * high
        if solve_at(plant, middle) is None:
            low = middle
        else:
            high = middle
        if high < 1e-8:
            break
    return high


def solve_at(plant: Partition, gamma: float) -> tuple[Matrix, Matrix, Matrix, Matrix] | None:
    """Return A, B, C, D of the central controller whose closed loop is below `gamma`, or None where none exists.

    Zhou, Doyle and Glover (1996), Theorem 17.1.
    """
    from scipy.linalg import cholesky

    A, B1, B2, C1, C2, D11 = plant.A, plant.B1, plant.B2, plant.C1, plant.C2, plant.D11
    n, m1, m2, p1, p2 = A.shape[0], B1.shape[1], B2.shape[1], C1.shape[0], C2.shape[0]
    a, b = p1 - m2, m1 - p2
    D1111, D1112, D1121, D1122 = D11[:a, :b], D11[:a, b:], D11[a:, :b], D11[a:, b:]
    if gamma <= max(_size(D11[:a]), _size(D11[:, :b])):
        return None
    g2 = gamma * gamma
    B, C = np.hstack([B1, B2]), np.vstack([C1, C2])
    D_row = np.hstack([D11, np.vstack([np.zeros((a, m2)), np.eye(m2)])])
    D_column = np.vstack([D11, np.hstack([np.zeros((p2, b)), np.eye(p2)])])
    R, S = D_row.T @ D_row, D_column @ D_column.T
    R[:m1, :m1] -= g2 * np.eye(m1)
    S[:p1, :p1] -= g2 * np.eye(p1)
    X = _riccati(A, B, C1.T @ C1, R, C1.T @ D_row)
    Y = None if X is None else _riccati(A.T, C.T, B1 @ B1.T, S, B1 @ D_column.T)
    if X is None or Y is None or np.abs(np.linalg.eigvals(X @ Y)).max(initial=0.0) >= g2:
        return None
    F = -np.linalg.solve(R, D_row.T @ C1 + B.T @ X)
    L = -np.linalg.solve(S, D_column @ B1.T + C @ Y).T
    F12, F2 = F[b:m1], F[m1:]
    L12, L2 = L[:, a:p1], L[:, p1:]
    inner = g2 * np.eye(a) - D1111 @ D1111.T
    D11h = -D1121 @ D1111.T @ np.linalg.solve(inner, D1112) - D1122
    other = g2 * np.eye(b) - D1111.T @ D1111
    D12h = cholesky(np.eye(m2) - D1121 @ np.linalg.solve(other, D1121.T), lower=True)
    D21h = cholesky(np.eye(p2) - D1112.T @ np.linalg.solve(inner, D1112), lower=False)
    Z = np.linalg.inv(np.eye(n) - Y @ X / g2)
    B2h, C2h = Z @ (B2 + L12) @ D12h, -D21h @ (C2 + F12)
    B1h = -Z @ L2 + B2h @ np.linalg.solve(D12h, D11h)
    C1h = F2 + D11h @ np.linalg.solve(D21h, C2h)
    Ah = A + B @ F + B1h @ np.linalg.solve(D21h, C2h)
    return _restored(plant, Ah, B1h, C1h, D11h)


def _restored(plant: Partition, A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Undo the scaling, and put D22 back: K (I + D22 K)^-1."""
    B, C, D = B @ plant.right, plant.left @ C, plant.left @ D @ plant.right
    E = np.linalg.inv(np.eye(D.shape[0]) + D @ plant.D22)
    C, D_new = E @ C, E @ D
    return A - B @ plant.D22 @ C, B - B @ plant.D22 @ D_new, C, D_new


def _riccati(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, S: Matrix) -> Matrix | None:
    """Return the stabilising X >= 0 of A'X + XA + Q - (XB + S) R^-1 (B'X + S') = 0, R of any sign; None if none is."""
    from scipy.linalg import schur, solve

    n = A.shape[0]
    RB, RS = solve(R, B.T, assume_a="sym"), solve(R, S.T, assume_a="sym")
    H = np.block([[A - B @ RS, -B @ RB], [-Q + S @ RS, -(A - B @ RS).T]])
    values = np.linalg.eigvals(H)
    if np.abs(values.real).min(initial=np.inf) <= _ON_AXIS * max(1.0, np.abs(values).max(initial=0.0)):
        return None
    ordered: Any = schur(H, output="real", sort="lhp")
    _, U, stable = ordered
    if stable != n:
        return None
    try:
        X = np.linalg.solve(U[:n, :n].T, U[n:, :n].T).T
    except np.linalg.LinAlgError:
        return None
    X = 0.5 * (X + X.T)
    lowest = float(np.linalg.eigvalsh(X).min(initial=0.0))
    return X if lowest >= -_NEGATIVE * max(1.0, float(np.abs(X).max(initial=0.0))) else None


def _size(D: Matrix) -> float:
    return float(np.linalg.norm(D, 2)) if D.size else 0.0
