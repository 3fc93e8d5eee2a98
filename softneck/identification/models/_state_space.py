"""State-space models as the arrays that `_lss_runtime` reads, and back."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Matrix, Vector

# A free run starts after 25 samples; an observer slower than this many starts from what it knows by then.
_LONGEST_SETTLING = 200
# What the Kalman gain of a model without a noise model takes for granted, scaled: of a neck inputs that act by 0.3 rad
# otherwise than asked (slack, hysteresis), and 0.1 deg on the angles (the paper's inclinometer has 0.05 to 0.1).
_INPUT_NOISE, _OUTPUT_NOISE = 0.3, 0.0017


def lss_arrays(
    system: tuple[Matrix, Matrix, Matrix, Matrix],
    *,
    delay: int,
    drive: Matrix,
    source: int = 0,
    history: int | None = None,
) -> dict[str, Matrix]:
    """Return the runtime's arrays of `x+ = A x + B u(k-delay) + K (y - C x)`, `y = C x`.

    The states are changed so that the first are the outputs and all others say (y, y, ...) where the model
    stands with outputs y: that is how the runtime starts.

    Args:
        system: A (n, n), B (n, motors), C (outputs, n), K (n, outputs), with n >= outputs.
        delay: dead time of all inputs in samples.
        drive: (motors, 2), see `_narx_runtime`.
        source: 1 where u are motor positions.
        history: samples held when a run starts; None takes as many as the observer needs to settle.
    """
    from scipy.linalg import null_space

    A, B, C, K = system
    n, outputs = A.shape[0], C.shape[0]
    start = _standing(A, C)
    other = null_space(C).T
    wanted = np.tile(np.eye(outputs), (n // outputs + 1, 1))[outputs:n]
    M = np.vstack([C, other + (wanted - other @ start) @ C])
    inverse = np.linalg.inv(M)
    if history is None:
        radius = float(np.abs(np.linalg.eigvals(A - K @ C)).max(initial=0.0))
        settles = np.log(1e-3) / np.log(radius) if 0.0 < radius < 1.0 else 1.0
        history = int(min(np.ceil(settles), _LONGEST_SETTLING))
    length = max(history, delay + 1, -(-n // outputs), int(drive[:, 1].max(initial=0.0)), 1)
    return {
        "history": history_array(length, outputs),
        "drive": drive,
        "A": M @ A @ inverse,
        "B": M @ B,
        "K": M @ K,
        "delay": np.array([float(delay), float(source)]),
    }


def system_of(arrays: Mapping[str, Matrix]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, K of the arrays, without the dead time."""
    n = arrays["A"].shape[0]
    return arrays["A"], arrays["B"], np.eye(arrays["K"].shape[1], n), arrays["K"]


def history_array(length: int, outputs: int) -> Vector:
    """Return the array `history` of a model's file: how long it is, and the number of outputs where that is not two."""
    return np.array([float(length)] if outputs == 2 else [float(length), float(outputs)])


def varx_system(A: Matrix, B: Matrix) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return the observer form of `y(k) = -sum A_i y(k-i) + sum B_i u(k-i)`, with A (p, y, y) and B (p, y, u).

    Its observer is dead-beat: after p samples its prediction is that of the difference equation.
    """
    p, y = A.shape[:2]
    n = y * p
    F = np.zeros((n, n))
    F[: n - y, y:] = np.eye(n - y)
    K = -A.reshape(n, y)
    C = np.eye(y, n)
    return F + K @ C, B.reshape(n, B.shape[2]), C, K


def axes_system(
    a: list[Vector],
    b: list[Vector],
    directions: Matrix,
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return transfer functions over redefined inputs as one system over the motors, with a Kalman gain.

    Args:
        a: denominators without their leading ones, of each output.
        b: numerators, b_1 first.
        directions: (outputs, motors) the redefined input of each output, of a neck theta_i and phi_i.
    """
    from scipy.linalg import block_diag

    parts = [_observer_form(*axis) for axis in zip(a, b, strict=True)]
    A, C = np.asarray(block_diag(*(F for F, _, _ in parts))), np.zeros((len(a), sum(len(F) for F, _, _ in parts)))
    B = np.vstack([np.outer(G, directions[axis]) for axis, (_, G, _) in enumerate(parts)])
    at = 0
    for axis, (F, _, _) in enumerate(parts):
        C[axis, at] = 1.0
        at += len(F)
    return A, B, C, np.asarray(block_diag(*(K[:, None] for _, _, K in parts)))


def _observer_form(a: Vector, b: Vector) -> tuple[Matrix, Vector, Vector]:
    """Return A (n, n), B (n,) and the gain K (n,) of one axis, its output the first state."""
    from scipy.linalg import solve_discrete_are

    n = max(a.size, b.size)
    F = np.eye(n, k=1)
    F[: a.size, 0] = -a
    G = np.zeros(n)
    G[: b.size] = b
    # Beside the output's noise 1e-12: enough that the equation has a solution.
    noise = _INPUT_NOISE**2 * np.outer(G, G) + 1e-12 * np.eye(n)
    P = np.asarray(solve_discrete_are(F.T, np.eye(n, 1), noise, _OUTPUT_NOISE**2 * np.eye(1)))
    return F, G, F @ P[:, 0] / (P[0, 0] + _OUTPUT_NOISE**2)


def _standing(A: Matrix, C: Matrix) -> Matrix:
    """Return X (n, outputs), the states with C X = I that move least in one sample."""
    from scipy.linalg import null_space

    n = A.shape[0]
    P = np.linalg.pinv(C)
    N = null_space(C)
    if N.shape[1] == 0:
        return P
    D = A - np.eye(n)
    return P - N @ np.linalg.lstsq(D @ N, D @ P)[0]
