"""Maps that contract, by parameters without any bound: whatever training does, two free runs draw together.

`x+ = A x + E t + ...`, `t = tanh(F x + D t + ...)`, D strictly lower triangular: each neuron sees those before it. With
any X and Y, H = X X' + eps I in blocks of n, q and n rows, and a rate r < 1 (Revay, Wang and Manchester 2024,
"Recurrent equilibrium networks", sec. V, contracting and acyclic):

`M = (H11 + H33 / r^2 + Y - Y') / 2`, `L = diag(H22) / 2`, `A = M^-1 H31`, `E = M^-1 H32`, `F = -L^-1 H21`,
`D = -L^-1 tril(H22)`.

The distance of two states under the same inputs, measured by `M' H33^-1 M`, then falls by r in each step: tanh has
slopes from 0 to 1, which H weighs by L (Schur complement and S-procedure).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector

# Keeps H positive definite beyond rounding; its entries are of order one.
_LEAST = 1e-6
# A start this far inside the bound leaves all derivatives alive.
_INSIDE = 1e-3


@dataclass(frozen=True, slots=True)
class Contraction:
    """Parameters of contracting maps.

    Attributes:
        states: n.
        neurons: q.
        rate: r, by which distances fall in each step.
    """

    states: int
    neurons: int
    rate: float

    @property
    def size(self) -> int:
        """Number of parameters: X lower triangular, row by row, then Y below its diagonal."""
        n, side = self.states, 2 * self.states + self.neurons
        return side * (side + 1) // 2 + n * (n - 1) // 2

    def matrices(self, theta: Vector) -> dict[str, Matrix]:
        """Return A (n, n), E (n, q), F (q, n) and D (q, q)."""
        H, M = self._blocks(theta)
        return self._solved(H, M)

    def metric(self, theta: Vector) -> Matrix:
        """Return W (n, n): `d' W d` falls by the rate squared, d the difference of two states."""
        H, M = self._blocks(theta)
        return M.T @ np.linalg.solve(H[-self.states :, -self.states :], M)

    def derivatives(self, theta: Vector) -> dict[str, np.ndarray]:
        """Return the derivatives of A, E, F and D by all parameters, (size, rows, columns) each."""
        n, side = self.states, 2 * self.states + self.neurons
        X, _ = self._parts(theta)
        H, M = self._blocks(theta)
        now = self._solved(H, M)
        rows, columns = np.tril_indices(side)
        dH = np.zeros((self.size, side, side))
        each = np.arange(rows.size)
        # d(X X') by X_ij is e_i x_j' + x_j e_i', x_j the column j.
        dH[each, rows, :] += X[:, columns].T
        dH[each, :, rows] += X[:, columns].T
        dM = (dH[:, :n, :n] + dH[:, -n:, -n:] / self.rate**2) / 2.0
        below = np.tril_indices(n, -1)
        for number, (i, j) in enumerate(zip(*below, strict=True), start=rows.size):
            dM[number, i, j], dM[number, j, i] = 0.5, -0.5
        inverse = np.linalg.inv(M)
        L = np.diag(H)[n:-n] / 2.0
        dL = np.diagonal(dH[:, n:-n, n:-n], axis1=1, axis2=2)[:, :, None] / 2.0
        return {
            "A": inverse @ (dH[:, -n:, :n] - dM @ now["A"]),
            "E": inverse @ (dH[:, -n:, n:-n] - dM @ now["E"]),
            "F": -(dH[:, n:-n, :n] + dL * now["F"]) / L[:, None],
            "D": -(np.tril(dH[:, n:-n, n:-n], -1) + dL * now["D"]) / L[:, None],
        }

    def start(self, A: Matrix, F: Matrix) -> Vector:
        """Return parameters of `A`, whose norm is below the rate, and of neurons that see `F x` and do nothing yet.

        F may be made smaller.
        """
        from scipy.linalg import cholesky

        n, q, r = self.states, self.neurons, self.rate
        # M = I. With H33 = I a norm up to sqrt(2 - 1/r^2) has room; with H33 = |A| r I any norm below r, 2 (1 - |A|/r).
        for h in (1.0, r * float(np.linalg.norm(A, 2))):
            H11 = (2.0 - h / r**2) * np.eye(n)
            room = float(np.linalg.eigvalsh(H11 - A.T @ A / h).min())
            if room > 10.0 * _LEAST:
                break
        # Of the room that A leaves, the neurons take half: `F' L F / 2`.
        weight = room / max(float(np.linalg.norm(F, 2)) ** 2, 1e-12)
        H = np.zeros((2 * n + q, 2 * n + q))
        H[:n, :n], H[n:-n, n:-n], H[-n:, -n:] = H11, 2.0 * weight * np.eye(q), h * np.eye(n)
        H[n:-n, :n], H[-n:, :n] = -weight * F, A
        H = np.tril(H) + np.tril(H, -1).T
        X = cholesky(H - _LEAST * np.eye(len(H)), lower=True)
        return np.concatenate([X[np.tril_indices(len(H))], np.zeros(n * (n - 1) // 2)])

    def _parts(self, theta: Vector) -> tuple[Matrix, Matrix]:
        n, side = self.states, 2 * self.states + self.neurons
        X, Y = np.zeros((side, side)), np.zeros((n, n))
        count = side * (side + 1) // 2
        X[np.tril_indices(side)] = theta[:count]
        Y[np.tril_indices(n, -1)] = theta[count:]
        return X, Y

    def _blocks(self, theta: Vector) -> tuple[Matrix, Matrix]:
        X, Y = self._parts(theta)
        n = self.states
        H = X @ X.T + _LEAST * np.eye(len(X))
        return H, (H[:n, :n] + H[-n:, -n:] / self.rate**2 + Y - Y.T) / 2.0

    def _solved(self, H: Matrix, M: Matrix) -> dict[str, Matrix]:
        n = self.states
        L = np.diag(H)[n:-n, None] / 2.0
        return {
            "A": np.linalg.solve(M, H[-n:, :n]),
            "E": np.linalg.solve(M, H[-n:, n:-n]),
            "F": -H[n:-n, :n] / L,
            "D": -np.tril(H[n:-n, n:-n], -1) / L,
        }


def whitening(A: Matrix, covariance: Matrix, rate: float) -> Matrix:
    """Return T (n, n), lower triangular, so that `T^-1 A T` has a norm below `rate` and states `T^-1 x` are white.

    T is the Cholesky factor of the states' covariance P, where that is a Lyapunov matrix, `P > A P A' / rate^2`; else
    of the smallest change of its driving noise that makes it one.

    Args:
        A: its poles are within `rate`.
        covariance: (n, n) P of the states.
        rate: below 1.
    """
    from scipy.linalg import cholesky, solve_discrete_lyapunov

    scaled = A / rate
    noise = covariance - scaled @ covariance @ scaled.T
    values, vectors = np.linalg.eigh((noise + noise.T) / 2.0)
    floor = _INSIDE * float(np.trace(covariance)) / len(A)
    P = solve_discrete_lyapunov(scaled, (vectors * np.maximum(values, floor)) @ vectors.T)
    return cholesky((P + P.T) / 2.0, lower=True)
