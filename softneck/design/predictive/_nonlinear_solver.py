"""The nonlinear controller's sample: estimate, linearise, solve, check, shift."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_runtime

from . import _mpc_state_runtime as rt
from ._gauss_newton import BufferedFunction, compiled, qp_function
from ._nmpc_prepared import COAST, SETTLE, NonlinearController, Preparation

# Places in the head of the state.
_STARTED, _ITERATIONS, _STATUS, _SHIFTED, _SOFTENED, _MISSED, _RESIDUAL, _HEAD = range(8)
_MOST_ITERATIONS = 50
_CONVERGED = 1e-10
# Of the KKT conditions; daqp is asked for 1e-10.
_LARGEST_RESIDUAL = 1e-7
_STATUS_NAMES = ("not started", "optimal", "softened", "previous plan", "holding")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SampleSolution:
    """What a sample decided.

    Attributes:
        status: "optimal", "softened", "previous plan", "holding" or "not started".
        iterations: of the QP solver, all Gauss-Newton steps together.
        residual: of the QP's KKT conditions.
        previous_plan, softened: samples so far on which those happened.
        moves: (moves, 3) that are planned next [rad].
    """

    status: str
    iterations: int
    residual: float
    previous_plan: int
    softened: int
    moves: Matrix


class NonlinearSolver:
    """All that is computed once, and the step; it remembers nothing between samples."""

    def __init__(self, controller: NonlinearController) -> None:
        """Compile the problem of `controller`."""
        c, s = controller, controller.settings
        self.prepared = Preparation(c)
        p = self.problem = self.prepared.problem
        self.settings, self.Ts = s, c.sample_time
        self._block = c.model.block()
        self._model_step = load_runtime(self._block.runtime).step
        start = self._block.initial_state(use_measurement=0.0, noise_std=0.0)
        self._rest, self._free = start.values, start.parameters
        self.nx, self.nz = start.values.size, p.variables
        self._evaluated = BufferedFunction(compiled(qp_function(p)))
        self._rows()
        self._places()
        self._model: Any = None

    def _places(self) -> None:
        """Where the parts of the state begin."""
        sizes = [_HEAD, 3, 3, 3, 2 * self.prepared.ahead, self.nx, 2, 2 * self.settings.window, self.nz]
        ends = np.cumsum(sizes)
        names = ("head", "held", "filtered", "seen", "ahead", "x", "y", "missed", "plan")
        self._at = {name: slice(int(end - n), int(end)) for name, end, n in zip(names, ends, sizes, strict=True)}
        self.size = int(ends[-1])

    def _rows(self) -> None:
        """Prepare the QP's rows: moves and slack as bounds, positions, and limits of the angles."""
        s, p = self.settings, self.problem
        b = len(p.starts)
        self.slacks = int(s.angle_limit is not None)
        self._n = self.nz + self.slacks
        sums = np.kron(np.tril(np.ones((b, b))), np.eye(3))
        ends = np.array([*p.starts[1:], p.horizon]) - 1
        self._checked = np.concatenate([2 * ends, 2 * ends + 1]) if self.slacks else np.zeros(0, dtype=int)
        k = self._checked.size
        self._A = np.zeros((self.nz + 2 * k, self._n))
        self._A[: self.nz, : self.nz] = sums
        if k:
            self._A[self.nz : self.nz + k, -1], self._A[self.nz + k :, -1] = -1.0, 1.0
        self._H = np.zeros((self._n, self._n))
        self._f = np.zeros(self._n)
        if self.slacks:
            weight = s.slack_weight * float(self.problem.weights[0].max())
            self._H[-1, -1], self._f[-1] = 2.0 * weight, 0.1 * weight
        self._lower = np.full(self._n + self._A.shape[0], -rt.MPC_NO_BOUND)
        self._upper = -self._lower
        self._sense = np.zeros(self._lower.size, dtype=np.int32)

    def row(self, values: Vector) -> SampleSolution:
        """Return what the sample that led to `values` decided."""
        head = values[self._at["head"]]
        return SampleSolution(
            status=_STATUS_NAMES[int(head[_STATUS])], iterations=int(head[_ITERATIONS]),
            residual=float(head[_RESIDUAL]), previous_plan=int(head[_SHIFTED]), softened=int(head[_SOFTENED]),
            moves=values[self._at["plan"]].reshape(-1, 3).copy(),
        )  # fmt: skip

    def step(self, before: Vector, parameters: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Return the next state and the set-points of now."""
        values = before.copy()
        v = {name: values[place] for name, place in self._at.items()}
        head, held = v["head"], v["held"]
        first = head[_STARTED] == 0.0
        if first:
            held[:] = np.where(np.isfinite(u[5:8]), u[5:8], 0.0)
        self._listen(v, u, first)
        measured = rt.mpc_plausible(u[3]) and rt.mpc_plausible(u[4])
        head[_MISSED] = 0.0 if measured else head[_MISSED] + 1.0
        active = u[8] > 0.5 and u[9] > 0.5 and head[_MISSED] <= COAST
        if first:
            self._settle(v)
        missed = v["missed"].reshape(-1, 2)
        if measured:
            error = u[3:5] - v["y"]
            missed[:] = np.vstack([error, missed[:-1]]) if active and not first else error
        if first or not active:
            v["filtered"][:2] = v["y"] + missed[0]
            v["filtered"][2] = self.problem.T[2] @ held
            v["plan"][:] = 0.0
        head[_STARTED] = 1.0
        head[_STATUS] = rt.MPC_HOLDING
        if active:
            self._decide(v, parameters, u)
        inputs = np.full(8, np.nan)
        inputs[:3] = held
        out = np.zeros(len(self._block.outputs))
        self._model_step(self._block.arrays, self._free, v["x"], inputs, out)
        v["y"][:] = out[:2]
        return values, held.copy()

    def _listen(self, v: dict[str, Vector], u: Vector, first: bool) -> None:
        """Take in the references; one that is not finite leaves what was."""
        seen = v["seen"]
        limit = np.array([rt.MPC_REFERENCE_LIMIT, rt.MPC_REFERENCE_LIMIT, rt.MPC_MOTOR_LIMIT])
        seen[:] = np.where(np.isfinite(u[:3]), np.clip(u[:3], -limit, limit), seen)
        if self.prepared.ahead:
            line = v["ahead"].reshape(2, -1)
            if first:
                line[:] = seen[:2, None]
            line[:, :-1] = line[:, 1:]
            newest = np.clip(u[10:12], -rt.MPC_REFERENCE_LIMIT, rt.MPC_REFERENCE_LIMIT)
            line[:, -1] = np.where(np.isfinite(newest), newest, line[:, -1])

    def _settle(self, v: dict[str, Vector]) -> None:
        """Bring the model to where it had been, had it stood under the held set-points for ever."""
        rows = np.full((SETTLE, 8), np.nan)
        rows[:, :3] = v["held"]
        start = self._block.initial_state(use_measurement=0.0, noise_std=0.0)
        state, _ = self._block.run(start, rows)
        v["x"][:], v["y"][:] = state.values, state.outputs[:2]

    def _asked(self, v: dict[str, Vector]) -> tuple[Matrix, Vector]:
        """Return the filtered references of the samples to come (L, 2), and the moves that they ask for (nz,)."""
        filtered, seen = v["filtered"], v["seen"]
        now = seen.copy()
        if self.prepared.ahead and self.prepared.lead:
            now[:2] = v["ahead"].reshape(2, -1)[:, self.prepared.lead - 1]
        filtered[:] = self.prepared.keep * filtered + (1.0 - self.prepared.keep) * now
        if self.prepared.ahead:
            wanted = v["ahead"].reshape(2, -1).T[self.prepared.asked_at]
        else:
            wanted = np.broadcast_to(seen[:2], (self.prepared.decay.size, 2))
        path = self.prepared.decay[:, None] * filtered[:2] + self.prepared.filter @ wanted
        moves = (self.prepared.slopes @ (path / self.prepared.gain)) @ self.prepared.inverse.T
        return path, moves.ravel()

    def _decide(self, v: dict[str, Vector], parameters: Vector, u: Vector) -> None:
        path, asked = self._asked(v)
        held, plan, head = v["held"], v["plan"], v["head"]
        level_rate = self.prepared.gains @ v["missed"].reshape(-1, 2)
        ahead = self.prepared.future @ level_rate
        e = self._evaluated
        e.inputs[0][:], e.inputs[1][:], e.inputs[2][:] = plan, v["x"], held
        e.inputs[3][:] = (path[: self.problem.horizon] - ahead).ravel()
        e.inputs[4][:], e.inputs[5][0] = asked, v["filtered"][2]
        self._bounds(parameters, held, u[5:8])
        total, answered, slack = 0, False, 0.0
        for _ in range(_MOST_ITERATIONS if self.settings.converged else 1):
            z, iterations, residual = self._solve(ahead)
            total += iterations
            answered = residual <= _LARGEST_RESIDUAL
            if not answered:
                break
            change = float(np.abs(z[: self.nz] - e.inputs[0]).max())
            e.inputs[0][:] = z[: self.nz]
            slack = float(z[-1]) if self.slacks else 0.0
            head[_RESIDUAL] = residual
            if change < _CONVERGED:
                break
        head[_ITERATIONS] = total
        if answered:
            plan[:] = e.inputs[0]
            head[_STATUS] = rt.MPC_SOFT if slack > 1e-6 else rt.MPC_OPTIMAL
            head[_SOFTENED] += slack > 1e-6
        else:
            head[_STATUS] = rt.MPC_PLAN
            head[_SHIFTED] += 1.0
        move = np.clip(plan[:3], self._lower[:3], self._upper[:3])
        low, high = np.minimum(-parameters[0], held), np.maximum(parameters[0], held)
        held[:] = np.clip(held + move, low, high)
        self._shift(plan)

    def _bounds(self, parameters: Vector, held: Vector, motors: Vector) -> None:
        """Fill the bounds of moves and positions."""
        position, slew, lead, least = parameters[:4]
        move = slew * self.Ts
        lower, upper, n = self._lower, self._upper, self._n
        lower[: self.nz], upper[: self.nz] = -move, move
        known = np.where(np.isfinite(motors), motors, held)
        lower[:3] = np.minimum(np.maximum(-move, known - lead - held), move)
        upper[:3] = np.maximum(np.minimum(move, known + lead - held), lower[:3])
        if self.slacks:
            lower[self.nz] = 0.0
        # As in the linear controller: a motor beyond a limit comes back as fast as its first move may.
        b = self.nz // 3
        lower[n : n + self.nz] = np.tile(np.minimum(max(-position, least), held + upper[:3]) - held, b)
        upper[n : n + self.nz] = np.tile(np.maximum(position, held + lower[:3]) - held, b)

    def _solve(self, ahead: Matrix) -> tuple[Vector, int, float]:
        """Linearise around the evaluated plan and solve; return z, iterations and the KKT residual."""
        import daqp

        H, f, Y, S = self._evaluated()
        n, k = self.nz, self._checked.size
        self._H[:n, :n], self._f[:n] = H, f[:, 0]
        if k:
            rows = S[self._checked]
            free = (Y[:, 0] + ahead.ravel())[self._checked] - rows @ self._evaluated.inputs[0]
            limit = float(self.settings.angle_limit or 0.0)
            self._A[n : n + k, :n], self._A[n + k :, :n] = rows, rows
            start = self._n + n
            self._upper[start : start + k] = limit - free
            self._lower[start + k :] = -limit - free
        if self._model is None:
            self._model = daqp.Model()
            self._model.setup(self._H, self._f, self._A, self._upper, self._lower, self._sense.copy())
            self._model.settings = {"primal_tol": 1e-10, "dual_tol": 1e-10, "iter_limit": self.settings.budget}
        else:
            # With `sense` it starts cold: what it solved before must not tell, or no replay would be equal.
            matrix = {"A": self._A} if k else {}
            self._model.update(
                H=self._H, f=self._f, bupper=self._upper, blower=self._lower, sense=self._sense.copy(), **matrix
            )
        z, _, flag, found = self._model.solve()
        if flag <= 0 or not np.isfinite(z).all():
            return z, int(found["iterations"]), math.inf
        return z, int(found["iterations"]), self._residual(z, found["lam"])

    def _residual(self, z: Vector, lam: Vector) -> float:
        """Return the largest residual of the KKT conditions, stationarity by the size of H."""
        gradient = self._H @ z + self._f + lam[: self._n] + lam[self._n :] @ self._A
        r = np.concatenate([z, self._A @ z])
        stationary = float(np.abs(gradient).max()) / max(1.0, float(np.abs(self._H).max()))
        outside = float(max((r - self._upper).max(), (self._lower - r).max(), 0.0))
        gap = np.where(lam > 0.0, self._upper - r, r - self._lower)
        return max(stationary, outside, float(np.where(lam != 0.0, np.minimum(np.abs(gap), np.abs(lam)), 0.0).max()))

    def _shift(self, plan: Vector) -> None:
        """Make the plan that of the next sample: what is planned for one sample later becomes first."""
        starts, b = self.problem.starts, len(self.problem.starts)
        moves = plan.reshape(b, 3)
        path = np.cumsum(moves, axis=0)
        # Position one sample after each start, relative to what is held now.
        at = np.searchsorted(np.array(starts), np.array(starts) + 1, side="right") - 1
        shifted = path[at] - moves[0]
        moves[:] = np.diff(shifted, axis=0, prepend=np.zeros((1, 3)))
