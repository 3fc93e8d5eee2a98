"""`lqgsyn`: linear quadratic Gaussian control with integral action of a `control` system of any size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, require_positive

from ._synthesis import _dt_of, _named

if TYPE_CHECKING:
    import control

# Where the directions of loads are read off: near rest, beside integrators of the plant's own.
_NEAR_REST = 1e-3


def lqgsyn(
    G: Any,
    *,
    output_weight: Any = 1.0,
    control_weight: Any = 0.1,
    input_noise: float = 1.0,
    load_rate: float = 1.0,
) -> control.StateSpace:
    """Return K of `u = K (r - y)`: an LQR on the states of a Kalman filter that also estimates loads at the inputs.

    The regulator minimises the sum of `y'Qy + u'Ru`, the filter is that of white noise on inputs and outputs and of
    loads that walk at random; taking these away is the integral action (Astrom and Wittenmark 1997, Computer-Controlled
    Systems, sec. 9.2 and 11.4). Where there are more inputs than outputs, loads act along those that move the outputs
    most near rest.

    Args:
        G: plant of n inputs and m outputs, continuous or discrete, a dead time as poles at zero.
        output_weight, control_weight: Q (m, m) and R (n, n), positive definite, or numbers, that of each signal.
        input_noise: standard deviation at each input, that at each output is 1.
        load_rate: of the loads' walk, in a second (continuous: a root of its spectral density).

    Raises:
        SettingsError: weights that are none, or a plant that nothing stabilises.
    """
    import control

    dt = _dt_of(G)
    system: Any = control.ss(G)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (system.A, system.B, system.C, system.D))
    n, m = B.shape[1], C.shape[0]
    Q, R = _weight("output_weight", output_weight, m), _weight("control_weight", control_weight, n)
    require_positive("input_noise", input_noise)
    require_positive("load_rate", load_rate)
    L = _load_directions(system, dt)
    states, loads = A.shape[0], L.shape[1]
    # The plant with its loads d behind its own states: u + L d enters.
    hold = np.eye(loads) if dt else np.zeros((loads, loads))
    Aa = np.block([[A, B @ L], [np.zeros((loads, states)), hold]])
    Ba, Ca = np.vstack([B, np.zeros((loads, n))]), np.hstack([C, D @ L])
    walk = load_rate**2 * (dt if dt else 1.0)
    noise = np.zeros((states + loads, states + loads))
    noise[:states, :states], noise[states:, states:] = input_noise**2 * B @ B.T, walk * np.eye(loads)
    try:
        F = _regulator(A, B, C.T @ Q @ C, R + D.T @ Q @ D, C.T @ Q @ D, discrete=dt > 0.0)
        M = _regulator(Aa.T, Ca.T, noise, np.eye(m) + input_noise**2 * D @ D.T,
                       np.vstack([input_noise**2 * B @ D.T, np.zeros((loads, m))]), discrete=dt > 0.0).T  # fmt: skip
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SettingsError(
            "no LQG controller stabilises the plant: a mode that is not stable is not seen or not moved, or it has a "
            "zero at rest, where loads are not seen."
        ) from error
    Fa = np.hstack([F, L])
    # The filter's estimate of the sample ahead, fed with what the controller itself tells the inputs.
    Ak = Aa - Ba @ Fa - M @ (Ca - D @ Fa)
    return _named(control.StateSpace(Ak, M, Fa, np.zeros((n, m)), dt), G, dt)


def _regulator(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, N: Matrix, *, discrete: bool) -> Matrix:
    """Return F of `u = -F x`."""
    from scipy.linalg import solve_continuous_are, solve_discrete_are

    if discrete:
        P = solve_discrete_are(A, B, Q, R, s=N)
        return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T)
    P = solve_continuous_are(A, B, Q, R, s=N)
    return np.linalg.solve(R, B.T @ P + N.T)


def _load_directions(system: Any, dt: float) -> Matrix:
    """Return (n, min(n, m)) along which inputs loads act, orthonormal."""
    n, m = system.ninputs, system.noutputs
    if n <= m:
        return np.eye(n)
    response = np.asarray(system(1.0 + _NEAR_REST if dt else _NEAR_REST, squeeze=False)).reshape(m, n)
    return np.linalg.svd(np.real(response))[2][:m].T


def _weight(name: str, value: Any, size: int) -> Matrix:
    """Return a weight (size, size)."""
    given = np.asarray(value, dtype=np.float64)
    matrix = given * np.eye(size) if given.ndim == 0 else given
    if matrix.shape != (size, size) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        raise SettingsError(f"`{name}` must be a number or symmetric, ({size}, {size}); got shape {given.shape}.")
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise SettingsError(f"`{name}` must be positive definite; give each signal a weight of its own.")
    return matrix
