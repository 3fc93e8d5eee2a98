"""H-infinity synthesis (`mixsyn`, `hinfsyn`) by two Riccati equations, and its kind of controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softneck.core import Matrix, SettingsError, require_between, require_positive
from softneck.identification import to_state_space

from ..linear._axis_loop import error_feedback
from ..linear._settings import AxisDesign, AxisSettings
from ..plants._coupled import grid_response
from ..plants._uncertain import UncertainAxis
from ._weights import makeweight, to_continuous, to_discrete, weight_image

if TYPE_CHECKING:
    import control

# The optimal controller has a pole near infinity (3e9 rad/s); a little above gamma it is an ordinary one.
_GAMMA_FACTOR = 1.05
# |T_zw| found on a grid may exceed gamma by rounding of the synthesis, not more.
_NORM_TOLERANCE = 1e-3
# A weight below this at infinity counts as strictly proper.
_LEAST_DIRECT = 1e-9


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Synthesis:
    """A controller and the norms of its loop.

    `controller`: K for negative feedback, `u = K (r - y)`, with the plant's dt and names. `gamma`: the least possible
    norm. `achieved`: the norm with this controller, on a grid of frequencies.
    """

    controller: control.StateSpace
    gamma: float
    achieved: float


def mixsyn(G: Any, W1: Any = None, W2: Any = None, W3: Any = None, *, above: float = _GAMMA_FACTOR) -> Synthesis:
    """Return the controller that keeps `|W1 S; W2 K S; W3 T|` small (Skogestad and Postlethwaite 2005, sec. 9.3.6).

    Args:
        G: plant of any number of inputs and outputs; a discrete one, dead time as poles at zero, is taken exactly
            through the bilinear map.
        W1, W2, W3: None, numbers or stable systems, continuous or of the plant's dt: of as many inputs as the plant
            has outputs (W1, W3) or inputs (W2), or scalar ones, which weigh each of the signals alike. Continuous
            weights of a discrete plant act at `2/Ts tan(w Ts/2)`.
        above: the controller is built at this factor above the least gamma.

    Raises:
        SettingsError: no weight, one that cannot be solved for, another dt, or no controller.
    """
    dt = _dt_of(G)
    outputs, inputs = G.noutputs, G.ninputs
    sized = (("W1", W1, outputs), ("W2", W2, inputs), ("W3", W3, outputs))
    weights = [weight_image(W, dt, name, size) for name, W, size in sized]
    if all(W is None for W in weights):
        raise SettingsError("`mixsyn` needs at least one weight.")
    if not any(W is not None and np.abs(np.asarray(W.D)).max() > _LEAST_DIRECT for W in weights[1:]):
        raise SettingsError(
            "the control effort is not weighted at high frequencies (D12 has not full rank), where the search for a "
            "controller hangs: give W2 a gain there, a number for example, or a W3 with as many zeros as poles."
        )
    found = hinfsyn(_augment(to_continuous(G), weights), outputs, inputs, above=above)
    K = to_discrete(found.controller, dt) if dt else found.controller
    return Synthesis(controller=_name_signals(K, G, dt), gamma=found.gamma, achieved=found.achieved)


def hinfsyn(P: Any, nmeas: int, ncon: int, *, above: float = _GAMMA_FACTOR) -> Synthesis:
    """Return the H-infinity controller of the generalised plant P, built at `above` times the optimal gamma.

    What makes the search hang is refused (D12 or D21 of less than full rank), and what comes out is verified: a stable
    loop and its norm. A discrete P gives a controller of its dt.

    Raises:
        SettingsError: as said, or no controller exists.
    """
    import control

    require_between("above", above, 1.001, 100.0)
    dt = _dt_of(P)
    image: Any = to_continuous(P)
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (image.A, image.B, image.C, image.D))
    plant = partition(A, B, C, D, nmeas=nmeas, ncon=ncon)
    gamma = least_gamma(plant)
    parts = solve_at(plant, above * gamma)
    if parts is None:
        raise SettingsError(f"no controller at {above:g} times gamma {gamma:.4g}; scale the weights.")
    K = control.StateSpace(*parts, 0)
    closed: Any = image.lft(K)
    return Synthesis(
        controller=to_discrete(K, dt) if dt else K, gamma=gamma, achieved=_verify_norm(closed, above * gamma)
    )


def _augment(G: Any, weights: list[Any]) -> control.StateSpace:
    """Return P from (r, u) to (W1 e, W2 u, W3 y, e) with e = r - G u (python-control's `augw`, which warns)."""
    import control

    n, ny, nu = G.nstates, G.noutputs, G.ninputs
    one = control.StateSpace([], [], [], np.eye(ny), 0)
    blocks = [(W, part) for W, part in zip(weights, ("e", "u", "y"), strict=True) if W is not None]
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (G.A, G.B, G.C, G.D))
    rows = {
        "e": (-C, np.hstack([np.eye(ny), -D])),
        "u": (np.zeros((nu, n)), np.hstack([np.zeros((nu, ny)), np.eye(nu)])),
        "y": (C, np.hstack([np.zeros((ny, ny)), D])),
    }
    states, inputs = A, np.hstack([np.zeros((n, ny)), B])
    outputs, direct = [], []
    for W, part in [*blocks, (one, "e")]:
        before = states.shape[0]
        row, gain = rows[part]
        row = np.hstack([row, np.zeros((len(row), before - row.shape[1]))])
        Aw, Bw, Cw, Dw = (np.asarray(item, dtype=np.float64) for item in (W.A, W.B, W.C, W.D))
        states = np.block([[states, np.zeros((before, Aw.shape[0]))], [Bw @ row, Aw]])
        inputs = np.vstack([inputs, Bw @ gain])
        outputs.append(np.hstack([Dw @ row, Cw]))
        direct.append(Dw @ gain)
    wide = [np.hstack([row, np.zeros((len(row), states.shape[0] - row.shape[1]))]) for row in outputs]
    return control.StateSpace(states, inputs, np.vstack(wide), np.vstack(direct), 0)


def _verify_norm(closed: Any, bound: float) -> float:
    """Return the norm of the closed loop on a grid; raise where it is not stable or beyond `bound`."""
    largest = float(np.max(np.linalg.eigvals(np.asarray(closed.A)).real, initial=-np.inf))
    if largest >= 0.0:
        raise SettingsError(
            f"the result is not stable (a pole at {largest:.3g} rad/s): the problem is near singular. Weigh the "
            "control effort more (W2), or build further `above` gamma."
        )
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (closed.A, closed.B, closed.C, closed.D))
    response = grid_response(A, B, C, D, 1j * np.geomspace(1e-4, 1e5, 400))
    # Of a single row or column both norms are one.
    size = float(np.linalg.norm(response, 2 if min(D.shape) > 1 else None, axis=(1, 2)).max())
    if size > (1.0 + _NORM_TOLERANCE) * bound:
        raise SettingsError(f"the result has a norm of {size:.4g}, beyond {bound:.4g}: scale the weights.")
    return size


def _dt_of(system: Any) -> float:
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction):
        raise SettingsError(f"a control.StateSpace or TransferFunction is needed; got {type(system).__name__}.")
    if system.dt is None or system.dt is True:
        raise SettingsError("the system must say its sample time: give it dt = 0 (continuous) or dt in seconds.")
    return float(system.dt)


def _name_signals(K: Any, G: Any, dt: float) -> control.StateSpace:
    """Return K, from the plant's outputs to its inputs by name."""
    import control

    parts: list[Matrix] = [np.asarray(part) for part in (K.A, K.B, K.C, K.D)]
    return control.StateSpace(*parts, dt, inputs=list(G.output_labels), outputs=list(G.input_labels))


# Gamma is found to 0.01 %: what is built is 5 % above it.
_GAMMA_TOLERANCE = 1e-4
_MAX_GAMMA = 1e8
# An eigenvalue of the Hamiltonian this close to the axis (relative to the largest) counts as on it.
_ON_AXIS = 1e-13
# X and Y may come out negative by rounding: relative to their size.
_DEFINITENESS_TOLERANCE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """A generalised plant with D12 = [0; I], D21 = [0 I] and D22 = 0, after scaling of its signals.

    `A`, `B1`, `B2`, `C1`, `C2`: as usual. `D11`: (p1, m1). `left`, `right`: K of the original plant is `left @ K @
    right`. `D22`: what was taken away.
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

    Raises SettingsError: D12 without full column rank, or D21 without full row rank; both make solvers hang or lie.
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
    """Return the optimal gamma, at most 0.01 % too large. Raises SettingsError: none up to 1e8."""
    solve, low, high = _riccati_pair(plant), 0.0, 1.0
    while solve(high) is None:
        low, high = high, 4.0 * high
        if high > _MAX_GAMMA:
            raise SettingsError(
                "no controller exists for any gamma: the plant cannot be stabilised, or a weight is not stable."
            )
    while high - low > _GAMMA_TOLERANCE * high and high >= 1e-8:
        middle = 0.5 * (low + high) if low > 0.0 else 0.25 * high
        low, high = (middle, high) if solve(middle) is None else (low, middle)
    return high


def _riccati_pair(plant: Partition) -> Callable[[float], tuple[Matrix, Matrix, Matrix, Matrix] | None]:
    """Return a function: gamma -> X, Y and their R, or None where no controller keeps the loop below gamma.

    What does not depend on gamma is computed here, once. Zhou, Doyle and Glover (1996), Theorem 17.1.
    """
    A, B1, C1, D11 = plant.A, plant.B1, plant.C1, plant.D11
    m1, m2, p1, p2 = B1.shape[1], plant.B2.shape[1], C1.shape[0], plant.C2.shape[0]
    least = max(_size(D11[: p1 - m2]), _size(D11[:, : m1 - p2]))
    B, C = np.hstack([B1, plant.B2]), np.vstack([C1, plant.C2])
    D_row, D_column = _direct(plant)
    row, column, Q, P = D_row.T @ D_row, D_column @ D_column.T, C1.T @ C1, B1 @ B1.T
    cross, other, still = C1.T @ D_row, B1 @ D_column.T, np.zeros_like(A)
    # Where the measurement tells the whole disturbance, nothing is to be estimated.
    quiet = m1 == p2 and float(np.linalg.eigvals(A - B1 @ plant.C2).real.max(initial=-1.0)) < 0.0

    def solve(gamma: float) -> tuple[Matrix, Matrix, Matrix, Matrix] | None:
        if gamma <= least:
            return None
        g2, R, S = gamma * gamma, row.copy(), column.copy()
        R[:m1, :m1] -= g2 * np.eye(m1)
        S[:p1, :p1] -= g2 * np.eye(p1)
        X = _riccati(A, B, Q, R, cross)
        Y = None if X is None else still if quiet else _riccati(A.T, C.T, P, S, other)
        if X is None or Y is None or np.abs(np.linalg.eigvals(X @ Y)).max(initial=0.0) >= g2:
            return None
        return X, Y, R, S

    return solve


def _direct(plant: Partition) -> tuple[Matrix, Matrix]:
    """Return [D11 D12] and [D11; D21]."""
    m2, p2 = plant.B2.shape[1], plant.C2.shape[0]
    a, b = plant.C1.shape[0] - m2, plant.B1.shape[1] - p2
    D12, D21 = np.vstack([np.zeros((a, m2)), np.eye(m2)]), np.hstack([np.zeros((p2, b)), np.eye(p2)])
    return np.hstack([plant.D11, D12]), np.vstack([plant.D11, D21])


def solve_at(plant: Partition, gamma: float) -> tuple[Matrix, Matrix, Matrix, Matrix] | None:
    """Return A, B, C, D of the central controller whose closed loop is below `gamma`, or None where none exists.

    Zhou, Doyle and Glover (1996), Theorem 17.1.
    """
    from scipy.linalg import cholesky

    solved = _riccati_pair(plant)(gamma)
    if solved is None:
        return None
    X, Y, R, S = solved
    A, B1, B2, C1, C2, D11 = plant.A, plant.B1, plant.B2, plant.C1, plant.C2, plant.D11
    n, m1, m2, p1, p2 = A.shape[0], B1.shape[1], B2.shape[1], C1.shape[0], C2.shape[0]
    a, b = p1 - m2, m1 - p2
    D1111, D1112, D1121, D1122 = D11[:a, :b], D11[:a, b:], D11[a:, :b], D11[a:, b:]
    g2 = gamma * gamma
    B, C = np.hstack([B1, B2]), np.vstack([C1, C2])
    D_row, D_column = _direct(plant)
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
    return _undo_scaling(plant, Ah, B1h, C1h, D11h)


def _undo_scaling(
    plant: Partition, A: Matrix, B: Matrix, C: Matrix, D: Matrix
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Undo the scaling, and put D22 back: K (I + D22 K)^-1."""
    B, C, D = B @ plant.right, plant.left @ C, plant.left @ D @ plant.right
    E = np.linalg.inv(np.eye(D.shape[0]) + D @ plant.D22)
    C, D_new = E @ C, E @ D
    return A - B @ plant.D22 @ C, B - B @ plant.D22 @ D_new, C, D_new


def _riccati(A: Matrix, B: Matrix, Q: Matrix, R: Matrix, S: Matrix) -> Matrix | None:
    """Return the stabilising X >= 0 of A'X + XA + Q - (XB + S) R^-1 (B'X + S') = 0, R of any sign; None if none is."""
    # LAPACK without the checks of scipy's `solve` and `schur`, which took longer: the same numbers.
    from scipy.linalg.lapack import dgees, dsytrf, dsytrs  # pyright: ignore[reportAttributeAccessIssue]

    n = A.shape[0]
    factor, pivots, singular = dsytrf(R)
    if singular:
        return None
    solved = dsytrs(factor, pivots, np.hstack([B.T, S.T]))[0]
    RB, RS = solved[:, :n], solved[:, n:]
    loop = A - B @ RS
    H = np.vstack([np.hstack([loop, -B @ RB]), np.hstack([-Q + S @ RS, -loop.T])])
    T, stable, _, _, U, _, failed = dgees(lambda x, _: x < 0.0, H, sort_t=1)
    # Real parts are on the diagonal, imaginary parts of a pair the root of -T[k, k+1] T[k+1, k].
    real = np.abs(np.diag(T))
    largest = float(real.max(initial=0.0)) + math.sqrt(float(-(np.diag(T, 1) * np.diag(T, -1)).min(initial=0.0)))
    if failed or stable != n or real.min(initial=np.inf) <= _ON_AXIS * max(1.0, largest):
        return None
    try:
        X = np.linalg.solve(U[:n, :n].T, U[n:, :n].T).T
    except np.linalg.LinAlgError:
        return None
    X = 0.5 * (X + X.T)
    lowest = float(np.linalg.eigvalsh(X).min(initial=0.0))
    return X if lowest >= -_DEFINITENESS_TOLERANCE * max(1.0, float(np.abs(X).max(initial=0.0))) else None


def _size(D: Matrix) -> float:
    return float(np.linalg.norm(D, 2)) if D.size else 0.0


# Gain of W1 at rest: its pole lies this far below the bandwidth and becomes an integrator afterwards.
_W1_STATIC_GAIN = 1e4
# What W1 allows |S| far up: below it the bound on Ms, from 1.2 on, is what binds.
_HIGH_FREQUENCY_BOUND = 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class HinfSettings(AxisSettings):
    """H-infinity mixed sensitivity `|W1 S; W2 K S; W3 T|` on the exact-delay plant, at 1.05 gamma.

    W1 asks for `|S|` below frequency/bandwidth and 1.3; W2 is a gain on the effort in units of the plant's static gain;
    T is verified on every sample instead of being weighed. The slow pole of the controller becomes a true integrator.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        bandwidth: where W1 falls to 1 [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        control_weight: W2, dimensionless.
    """

    KIND: ClassVar[str] = "hinf"

    bandwidth: float | None = None
    control_weight: float = 0.3

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.bandwidth is not None:
            require_positive("bandwidth", self.bandwidth, "rad/s")
        require_between("control_weight", self.control_weight, 1e-3, 100.0)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        G = to_state_space(axis.nominal.tf(extra_delay=self.extra_delay) / axis.nominal.static_gain)
        if self.bandwidth is not None:
            return self._design_at(axis, G, self.bandwidth)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._design_at(axis, G, speed), axis, low=0.05 / lag, high=5.0 / lag, what="bandwidth"
        )

    def _design_at(self, axis: UncertainAxis, G: control.StateSpace, bandwidth: float) -> AxisDesign:
        """Return the design on G, the nominal plant over its static gain."""
        import control

        gain, dt = axis.nominal.static_gain, axis.sample_time
        W1 = makeweight(_W1_STATIC_GAIN, bandwidth, 1.0 / _HIGH_FREQUENCY_BOUND, dt=dt)
        found = mixsyn(G, W1, self.control_weight)
        K: Any = with_integrator(found.controller)
        return AxisDesign(
            error_feedback(control.StateSpace(K.A, K.B, K.C / gain, K.D / gain, dt)),
            {"bandwidth_rad_s": bandwidth},
            {"gamma": found.gamma, "achieved": found.achieved},
        )


def with_integrator(K: Any) -> control.StateSpace:
    """Return K with its slowest real pole moved to z = 1, its other modes untouched.

    W1's pole lies at a ten-thousandth of the bandwidth, and K inherits it; A + (1 - p) v w' moves only that mode.
    Raises SettingsError: K has no pole near 1.
    """
    import control

    A = np.asarray(K.A, dtype=np.float64)
    values, vectors = np.linalg.eig(A)
    i = int(np.argmin(np.abs(values - 1.0)))
    p = values[i]
    if abs(p.imag) > 1e-12 or abs(p.real - 1.0) > 1e-2:
        raise SettingsError("the controller has no slow pole to become its integrator; give W1 a larger gain at rest.")
    v = np.real(vectors[:, i])
    w = np.real(np.linalg.inv(vectors)[i])
    w = w / float(w @ v)
    moved = A + (1.0 - p.real) * np.outer(v, w)
    return control.StateSpace(moved, K.B, K.C, K.D, K.dt, inputs=K.input_labels, outputs=K.output_labels)
