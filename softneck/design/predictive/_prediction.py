"""The linear controller's problem, written once in CasADi; its QP's matrices come out of that expression."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector

from ..plants._coupled import AnyAxis, CoupledAxis, input_matrix
from . import _mpc_state_runtime as rt

# Rounding of a Cholesky factor; beyond it H has no inverse worth the name.
_LARGEST_CONDITION = 1e12


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Problem:
    """The optimisation problem of the controller.

    Attributes:
        axes: a plant for each output.
        horizon: N, samples after each axis' dead time.
        starts: samples at which the motors may move.
        T: (outputs + 1, motors) of Eq. 9-11, of a neck with 3 motors and 2 outputs.
        T_inverse: (motors, outputs + 1).
        output_weight: (outputs,) on angle errors [1/rad^2].
        move_weight: on moves of the motors [1/rad^2].
        cocontraction_weight: on co-contraction's error [1/rad^2].
        slack_weight: on violations of the angles' soft limits [1/rad^2].
        tautness_weight: on a lack of tautness [1/rad^2].
        angles: whether angles are limited.
        tautness: (motors, outputs) how much an angle loosens each tendon [rad/rad]; None for no limit.
        guard: samples after the dead time from which on limits of angles are looked at.
    """

    axes: tuple[AnyAxis, ...]
    horizon: int
    starts: tuple[int, ...]
    T: Matrix
    T_inverse: Matrix
    output_weight: Vector
    move_weight: float
    cocontraction_weight: float
    slack_weight: float
    tautness_weight: float
    angles: bool = False
    tautness: Matrix | None = None
    guard: int = 1

    @property
    def motors(self) -> int:
        """Number of motors."""
        return self.T.shape[1]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return self.T.shape[0] - 1

    @property
    def idle(self) -> Matrix:
        """(k, motors) moves of the motors that neither tilt nor co-contract, orthonormal; none of a neck."""
        return idle_moves(self.T)

    @property
    def order(self) -> int:
        """n, states of an axis."""
        return max(plant.order for plant in self.axes)

    @property
    def dead_time(self) -> int:
        """D, the longest dead time in samples."""
        return max(plant.delay for plant in self.axes)

    @property
    def rows(self) -> int:
        """L, samples of which the reference is needed."""
        return self.horizon + self.dead_time

    @property
    def slack_weights(self) -> tuple[float, ...]:
        """Weight of each slack variable, those of angles first."""
        angles = (self.slack_weight,) if self.angles else ()
        return angles if self.tautness is None else (*angles, self.tautness_weight)

    @property
    def slacks(self) -> int:
        """Number of slack variables."""
        return len(self.slack_weights)

    @property
    def variables(self) -> int:
        """Moves and slacks."""
        return self.motors * len(self.starts) + self.slacks

    @property
    def parameters(self) -> int:
        """Length of theta, see `_mpc_state_runtime`."""
        m = self.outputs
        return m * (self.order + 2) + m * self.rows + self.motors + 2

    @property
    def ends(self) -> tuple[int, ...]:
        """Ends of the moves' holds."""
        return (*self.starts[1:], self.horizon)

    @property
    def checked(self) -> tuple[int, ...]:
        """Samples after the dead time at which limits of angles are looked at: `ends` from `guard` on.

        Looked at sooner, a limit would ask for a loop that is as fast as the samples, and the neck would swing on it.
        """
        return tuple(end for end in self.ends if end >= min(self.guard, self.horizon))


def idle_moves(T: Matrix) -> Matrix:
    """Return (k, motors) orthonormal moves of the motors that change no redefined input; none of a neck."""
    _, values, rows = np.linalg.svd(T)
    return rows[int(np.sum(values > 1e-9 * values[0])) :]


@dataclass(frozen=True, slots=True, eq=False)
class Matrices:
    """`min 1/2 z'Hz + (F theta)'z` subject to `lower <= A z + E theta <= upper`, bounds by kind of row.

    Attributes:
        H: (nz, nz).
        F: (nz, n_theta).
        A: (m, nz).
        E: (m, n_theta).
        kinds: (m, 2) kind of each row, and the motor or axis that it is of.
    """

    H: Matrix
    F: Matrix
    A: Matrix
    E: Matrix
    kinds: Matrix


def pad_states(plant: AnyAxis, n: int) -> tuple[Matrix, Matrix]:
    """Return A (n, n) and B (n, inputs) with the output as first state and unreachable states last.

    Of a plant that its own redefined input moves alone there is one input, of a coupled one those of all axes.
    """
    A, B, _ = plant.observable_form()
    B = plant.B if isinstance(plant, CoupledAxis) else B[:, None]
    whole, columns = np.zeros((n, n)), np.zeros((n, B.shape[1]))
    whole[: plant.order, : plant.order], columns[: plant.order] = A, B
    return whole, columns


def rest_states(plant: AnyAxis, n: int) -> Matrix:
    """Return (n, inputs) the states at rest under inputs of one."""
    A, B = pad_states(plant, n)
    return np.linalg.solve(np.eye(n) - A, B)


def disturbance_pole(plant: AnyAxis) -> float:
    """Return a of the output disturbance: the plant's slowest pole, by its size."""
    # Below 0.1 a rate would be gone within a sample, and the observer has to divide by it.
    return float(np.clip(np.abs(np.roots(plant.denominator)).max(initial=0.0), 0.1, 0.995))


def expression(problem: Problem) -> dict[str, Any]:
    """Return the problem as CasADi expressions: z, theta, cost, rows, and the kinds of rows."""
    import casadi as ca

    p = problem
    n, L, N = p.order, p.rows, p.horizon
    M, m = p.motors, p.outputs
    z, theta = ca.SX.sym("z", p.variables), ca.SX.sym("theta", p.parameters)
    at = m * n
    offset = [(theta[at + 2 * i], theta[at + 2 * i + 1]) for i in range(m)]
    at += 2 * m
    wanted = [theta[at + axis * L : at + (axis + 1) * L] for axis in range(m)]
    at += m * L
    held, common = theta[at : at + M], theta[at + M]
    moves = [z[M * b : M * b + M] for b in range(len(p.starts))]
    slack = [z[M * len(p.starts) + i] for i in range(p.slacks)]

    motors, positions, now = [], [], held
    for i in range(N):
        if i in p.starts:
            now = now + moves[p.starts.index(i)]
            positions.append(now)
        motors.append(now)
    inputs = [ca.mtimes(ca.DM(p.T), motor) for motor in motors]

    asked = _asked_moves(p, wanted)
    cost = sum((p.move_weight * ca.sumsqr(move - own) for move, own in zip(moves, asked, strict=True)), ca.SX(0))
    ends, angles = [], []
    for axis, plant in enumerate(p.axes):
        A, _ = pad_states(plant, n)
        B = np.vstack([input_matrix(plant, axis, m), np.zeros((n - plant.order, m))])
        level, rate = offset[axis]
        a = disturbance_pole(plant)
        x = theta[axis * n : (axis + 1) * n]
        path = []
        for i, v in enumerate(inputs):
            x = ca.mtimes(ca.DM(A), x) + ca.mtimes(ca.sparsify(ca.DM(B)), v[:m])
            path.append(x[0] + level + rate * (1.0 - a ** (plant.delay + 1 + i)) / (1.0 - a))
        errors = [path[i] - wanted[axis][plant.delay + i] for i in range(N - 1)]
        cost += p.output_weight[axis] * sum(e**2 for e in errors)
        angles.append(path)
        # With the plant's own pole all but 1e-2 of it is there.
        drift = rate * (1.0 - a ** (plant.delay + N)) / (1.0 - a)
        goal = wanted[axis][plant.delay + N - 1] - level - drift
        ends.append((x, plant, goal / plant.static_gain))
    cost += _terminal(p, ends, motors[-1], common)
    cost += p.cocontraction_weight * sum((v[m] - common) ** 2 for v in inputs[:-1])
    if len(p.idle):
        # What neither tilts nor co-contracts is held at zero, or it would be anywhere.
        cost += p.cocontraction_weight * sum(ca.sumsqr(ca.mtimes(ca.DM(p.idle), motor)) for motor in motors[:-1])
    for weight, value in zip(p.slack_weights, slack, strict=True):
        cost += weight * (value**2 + 0.1 * value)

    rows, kinds = _hard_rows(moves, positions, slack, M)
    _soft_rows(p, angles, motors, slack, rows, kinds)
    return {"z": z, "theta": theta, "cost": cost, "rows": ca.vertcat(*rows), "kinds": np.array(kinds)}


def _asked_moves(p: Problem, wanted: list[Any]) -> list[Any]:
    """Return the moves (motors,) at each start that the reference itself asks for, at rest: only others cost.

    Without them a reference that keeps moving would be followed late and too low, in a trade against its moves.
    """
    import casadi as ca

    inverse = ca.DM(p.T_inverse)
    ends = (*p.starts[1:], p.horizon)
    middles = [-0.5, *(0.5 * (start + end) for start, end in zip(p.starts, ends, strict=True))]
    levels = []
    for axis, plant in enumerate(p.axes):
        places = np.clip(plant.delay + np.array(middles), 0.0, p.rows - 1.0)
        low = np.floor(places).astype(int)
        high = np.minimum(low + 1, p.rows - 1)
        part = places - low
        row = [(1.0 - f) * wanted[axis][i] + f * wanted[axis][j] for i, j, f in zip(low, high, part, strict=True)]
        levels.append([value / plant.static_gain for value in row])
    return [
        ca.mtimes(inverse, ca.vertcat(*(level[b + 1] - level[b] for level in levels), 0.0))
        for b in range(len(p.starts))
    ]


def _hard_rows(
    moves: list[Any], positions: list[Any], slack: list[Any], motors: int
) -> tuple[list[Any], list[tuple[float, float]]]:
    """Return slew rows, position rows and the slacks' own."""
    rows: list[Any] = []
    kinds: list[tuple[float, float]] = []
    for kind, group in ((rt.MPC_ROW_MOVE, moves), (rt.MPC_ROW_POSITION, positions)):
        for value in group:
            rows += [value[j] for j in range(motors)]
            kinds += [(kind, float(j)) for j in range(motors)]
    rows += slack
    kinds += [(rt.MPC_ROW_SLACK, float(i)) for i in range(len(slack))]
    return rows, kinds


def _soft_rows(
    p: Problem, angles: list[list[Any]], motors: list[Any], slack: list[Any], rows: list[Any],
    kinds: list[tuple[float, float]],
) -> None:  # fmt: skip
    """Append limits of angles and of tautness."""
    if p.angles:
        for axis in range(p.outputs):
            for i in p.checked:
                rows += [angles[axis][i - 1] - slack[0], angles[axis][i - 1] + slack[0]]
                kinds += [(rt.MPC_ROW_ANGLE_HIGH, float(axis)), (rt.MPC_ROW_ANGLE_LOW, float(axis))]
    if p.tautness is not None:
        for i in p.ends:
            for j in range(p.motors):
                loosened = sum(p.tautness[j, axis] * angles[axis][i - 1] for axis in range(p.outputs))
                rows.append(motors[i - 1][j] - loosened + slack[-1])
                kinds.append((rt.MPC_ROW_TAUT, float(j)))


def _terminal(p: Problem, ends: list[Any], motors: Any, common: Any) -> Any:
    """Return the cost to go after the horizon, of an LQR without limits (Riccati), around where it comes to rest."""
    import casadi as ca

    P = terminal_matrix(p)
    n = p.order
    goal = ca.mtimes(ca.DM(p.T_inverse), ca.vertcat(*(end[2] for end in ends), common))
    goals = ca.vertcat(*(end[2] for end in ends))
    parts = [
        x - ca.mtimes(ca.DM(rest_states(plant, n)), goals if isinstance(plant, CoupledAxis) else v)
        for x, plant, v in ends
    ]
    error = ca.vertcat(*parts, motors - goal)
    return ca.bilin(ca.DM(P), error, error)


def terminal_matrix(p: Problem) -> Matrix:
    """Return P, square over m n states and the motors, of the Riccati equation with moves as inputs."""
    from scipy.linalg import solve_discrete_are

    n, M, m = p.order, p.motors, p.outputs
    at = m * n  # of the motors
    A, B = np.eye(at + M), np.zeros((at + M, M))
    Q = np.zeros_like(A)
    for axis, plant in enumerate(p.axes):
        a, b = pad_states(plant, n)
        place, moved = slice(axis * n, (axis + 1) * n), p.T[:m] if isinstance(plant, CoupledAxis) else p.T[[axis]]
        A[place, place], A[place, at:] = a, b @ moved
        B[place] = b @ moved
        Q[axis * n, axis * n] = p.output_weight[axis]
    B[at:] = np.eye(M)
    Q[at:, at:] = p.cocontraction_weight * np.outer(p.T[m], p.T[m])
    if len(p.idle):
        Q[at:, at:] += p.cocontraction_weight * p.idle.T @ p.idle
    try:
        return solve_discrete_are(A, B, Q, p.move_weight * np.eye(M))
    except np.linalg.LinAlgError as error:
        raise SettingsError(f"the terminal cost has no solution ({error}); check weights and model.") from error


def matrices(problem: Problem) -> Matrices:
    """Return the QP's matrices out of the expression. Raises SettingsError: the cost is not strictly convex."""
    import casadi as ca

    e = expression(problem)
    H, gradient = ca.hessian(e["cost"], e["z"])
    zero = ca.SX.zeros(problem.variables)
    f = ca.substitute(gradient, e["z"], zero)
    out = ca.Function(
        "matrices", [],
        [H, ca.jacobian(f, e["theta"]), ca.jacobian(e["rows"], e["z"]), ca.jacobian(e["rows"], e["theta"]),
         ca.substitute(f, e["theta"], ca.SX.zeros(problem.parameters))],
    )()  # fmt: skip
    H, F, A, E, constant = (np.array(out[f"o{i}"].full()) for i in range(5))
    # The last entry of theta is one.
    F[:, -1] += constant[:, 0]
    H = 0.5 * (H + H.T)
    values = np.linalg.eigvalsh(H)
    if values[0] <= 0.0 or values[-1] > _LARGEST_CONDITION * values[0]:
        raise SettingsError(
            f"the cost is not strictly convex (eigenvalues {values[0]:.3g} to {values[-1]:.3g}); all weights must be "
            "positive and not further apart."
        )
    return Matrices(H, F, A, E, e["kinds"])
