"""The QP of a predictive controller outside of its block: as CasADi functions, solved by daqp, explained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation._axis import AXES
from softneck.runtime import load_functions

from . import _mpc_state_runtime as rt
from ._scale import runtime_of, units_of

# daqp's own default is 1e-6; the block's solver ends at 1e-10.
_TOLERANCE = 1e-10
ROW_NAMES = ("slew", "position", "slack", "angle", "angle", "tautness")
STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")
_OF_MOTORS = (rt.MPC_ROW_MOVE, rt.MPC_ROW_POSITION, rt.MPC_ROW_TAUT)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MpcInfo:
    """What a sample's QP said.

    Attributes:
        status: "optimal", "softened" (a soft limit cannot be kept), "previous plan" (no answer in the budget),
            "holding" (disabled or without measurement) or "not started".
        iterations: rows added and dropped by the solver.
        residual: of the KKT conditions.
        slack: largest violation of a soft limit that is planned, scaled to the limit's unit [rad]; of another
            robot than the neck as if it had a neck's size.
        active: names of the active limits.
        set_points: (N, motors) planned motor set-points from the next sample on [rad].
        angles: (N, outputs) pitch and roll that the nominal plant makes of them, each a dead time and a sample later
            [rad].
        reference: (N, outputs) what they are to be then [rad].
        time: of the solution [s]; NaN where it was not taken.
    """

    status: str
    iterations: int
    residual: float
    slack: float
    active: tuple[str, ...]
    set_points: Matrix
    angles: Matrix
    reference: Matrix
    time: float = float("nan")


class MpcProgram:
    """`min 1/2 z'Hz + (F theta)'z, lower <= A z <= upper` of a controller's arrays, kept warm in a daqp model."""

    def __init__(self, arrays: tuple[Matrix, ...], *, budget: int | None = None) -> None:
        """Set daqp up.

        Args:
            arrays: of an `MpcController`.
            budget: iterations of daqp; None for the controller's own.
        """
        import daqp

        self.iterations = 0
        self.arrays, a = arrays, rt.MpcArrays(arrays)
        self.constants, self.kinds, self.H, self.F, self.A, self.E = a.constants, a.kinds, a.H, a.F, a.A, a.E
        m = self.A.shape[0]
        self._functions = load_functions(runtime_of(arrays))
        self._rest, self._order = self._rows()
        self._model: Any = daqp.Model()
        wide = np.full(m, 1e30)
        flag, _ = self._model.setup(
            self.H, np.zeros(self.H.shape[0]), self.A[self._rest], wide[self._order], -wide, np.zeros(m, dtype=np.int32)
        )
        if flag < 0:
            raise SettingsError(f"daqp refuses the controller's QP (flag {flag}); review its weights.")
        limit = int(self.constants[rt.MPC_BUDGET]) if budget is None else budget
        self._model.settings = {"primal_tol": _TOLERANCE, "dual_tol": _TOLERANCE, "iter_limit": max(limit, 1)}

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows without the bounds, and the order in which daqp sees all: those on one variable first."""
        nz, m = self.A.shape[1], self.A.shape[0]
        eye = np.eye(nz)
        place = {tuple(row): i for i, row in reversed(list(enumerate(self.A.tolist())))}
        found = [place.get(tuple(row)) for row in eye.tolist()]
        simple = all(i is not None for i in found)
        first = [i for i in found if i is not None] if simple else []
        taken = set(first)
        rest = np.array([i for i in range(m) if i not in taken], dtype=np.int64)
        return rest, np.concatenate([np.array(first, dtype=np.int64), rest])

    def bounds(self, theta: Vector, parameters: Vector, motors: Vector) -> tuple[Vector, Vector]:
        """Return the bounds (m,) of all rows under those limits, motors (motors,) being where they are [rad]."""
        m = self.A.shape[0]
        lower, upper = np.empty(m), np.empty(m)
        self._functions.mpc_bounds(self.arrays, parameters, np.asarray(motors, float), theta, lower, upper)
        return lower, upper

    def solve(self, theta: Vector, lower: Vector, upper: Vector) -> tuple[Vector, int, Vector]:
        """Return z (nz,), daqp's exit flag (1 or 2 when solved) and the multipliers (m,), positive at upper bounds."""
        self._model.update(f=self.F @ theta, bupper=upper[self._order], blower=lower[self._order])
        z, _, flag, found = self._model.solve()
        self.iterations = int(found["iterations"])
        multipliers = np.zeros(upper.size)
        multipliers[self._order] = found["lam"]
        return z, int(flag), multipliers

    def function(self) -> Any:
        """Return `casadi.Function` theta, limits -> H, f, A, lower, upper: the QP as any solver takes it.

        Limits are position [rad], move per sample [rad], angle [rad] and tautness [rad], of another robot in SI; the
        lead limit, which is the block's own matter, is left out.
        """
        import casadi as ca

        theta, limits = ca.SX.sym("theta", self.F.shape[1]), ca.SX.sym("limits", 4)
        q, inf = self.constants, rt.MPC_NO_BOUND
        unit, outputs, _ = units_of(self.arrays)
        position, move, taut = limits[0] / unit, limits[1] / unit, limits[3] / unit + float(q[rt.MPC_TAUT_BACK])

        def ends(kind: float, which: int) -> tuple[Any, Any]:
            angle = limits[2] / outputs[which % outputs.size] - float(q[rt.MPC_ANGLE_BACK])
            low, high = -position, position
            if q.size > rt.MPC_NUMBERS:  # the motors' own ranges
                motors = rt.MpcArrays(self.arrays).T.shape[1]
                low = ca.fmax(low, q[rt.MPC_NUMBERS + which % motors])
                high = ca.fmin(high, q[rt.MPC_NUMBERS + motors + which % motors])
            return {
                rt.MPC_ROW_MOVE: (-move, move), rt.MPC_ROW_POSITION: (low, high), rt.MPC_ROW_SLACK: (0.0, inf),
                rt.MPC_ROW_ANGLE_HIGH: (-inf, angle), rt.MPC_ROW_ANGLE_LOW: (-angle, inf), rt.MPC_ROW_TAUT: (taut, inf),
            }[kind]  # fmt: skip

        free = ca.mtimes(ca.DM(self.E), theta)
        rows = [ends(kind, int(which)) for kind, which in self.kinds]
        lower = ca.vertcat(*(row[0] for row in rows)) - free
        upper = ca.vertcat(*(row[1] for row in rows)) - free
        return ca.Function(
            "mpc_qp", [theta, limits],
            [ca.DM(self.H), ca.mtimes(ca.DM(self.F), theta), ca.DM(self.A), lower, upper],
            ["theta", "limits"], ["H", "f", "A", "lower", "upper"],
        )  # fmt: skip


def residual(
    program: MpcProgram, theta: Vector, z: Vector, multipliers: Vector, bounds: tuple[Vector, Vector]
) -> float:
    """Return the largest residual of the KKT conditions of any answer, by the block's own function."""
    functions = load_functions(runtime_of(program.arrays))
    return float(functions.mpc_residual(program.arrays, theta, z, multipliers, *bounds))


def explain(arrays: tuple[Matrix, ...], state: Vector, names: tuple[str, ...] = AXES) -> MpcInfo:
    """Return what the sample that led to `state` decided; `names` are the outputs'."""
    a = rt.MpcArrays(arrays)
    now = {name: state[place] for name, place in rt.MpcState.parts(a).items()}
    functions = load_functions(runtime_of(arrays))
    age = int(now["age"].item())
    motors = a.T.shape[1]
    moves = np.zeros((int(a.constants[rt.MPC_ROWS] - a.constants[rt.MPC_PAST]), motors))
    for i, start in enumerate(a.starts.astype(int)):
        if start > age:
            moves[start - age - 1] = now["plan"][motors * i : motors * i + motors]
    theta = np.zeros(a.K.shape[1])
    functions.mpc_parameter(arrays, state, theta)
    # The state stands one sample on: what is held now was the plan's first move.
    set_points = now["held"] + np.cumsum(moves, axis=0)
    angles, reference = _predicted(a, theta, set_points)
    active = tuple(
        f"{ROW_NAMES[int(kind)]} {('upper', 'lower')[int(sign < 0)]} "
        + (("motor " + str(int(which) + 1)) if kind in _OF_MOTORS else names[int(which)])
        for (kind, which), sign in zip(a.kinds, now["active"], strict=True)
        if sign != 0.0 and kind != rt.MPC_ROW_SLACK
    )
    unit, outputs, _ = units_of(arrays)
    return MpcInfo(
        status=STATUS_NAMES[int(now["status"].item())],
        iterations=int(now["iterations"].item()),
        residual=now["residual"].item(),
        slack=now["slack"].item(),
        active=active,
        set_points=unit * set_points,
        angles=outputs * angles,
        reference=outputs * reference,
    )


def _predicted(a: rt.MpcArrays, theta: Vector, set_points: Matrix) -> tuple[Matrix, Matrix]:
    """Return predicted angles and references (N, outputs) of the nominal plant from theta on."""
    n, N, m = a.model_A.shape[1], set_points.shape[0], a.T.shape[0] - 1
    coupled = a.model_B.shape[1] > n
    now = {name: theta[place] for name, place in rt.MpcTheta.parts(a).items()}
    inputs = set_points @ a.T.T
    angles, reference = np.zeros((N, m)), np.zeros((N, m))
    for axis in range(m):
        A, B = a.model_A[axis * n : (axis + 1) * n], a.model_B[axis].reshape(-1, n).T
        v = inputs[:, :m] if coupled else inputs[:, axis : axis + 1]
        pole, delay = a.observer[axis, 2], int(a.delays[axis])
        level, rate = now["offsets"].reshape(-1, 2)[axis]
        x = now["models"].reshape(-1, n)[axis]
        reference[:, axis] = now["wanted"].reshape(m, -1)[axis, delay : delay + N]
        for i in range(N):
            x = A @ x + B @ v[i]
            angles[i, axis] = x[0] + level + rate * (1.0 - pole ** (delay + 1 + i)) / (1.0 - pole)
    return angles, reference
