"""Optimal control over the step of any model, `model.casadi()`: least squares within limits, solved by ipopt.

    min  sum w (Y(z) - t)^2 + |R z - a|^2    subject to    low <= Q Y(z) + G z <= high,  least <= z <= most

with Y (2 N,) the angles of the model's free run under the set-points `spread z + offset` (3 N,), sample by sample; of
another robot its outputs under its motors, in the units of its size.
ipopt is given the exact gradient and the Hessian of Gauss and Newton: kinks of a model have no second derivative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.identification import Model
from softneck.loop import BlockPart
from softneck.runtime import load_functions

from ._nmpc_prepared import NonlinearController
from ._nmpc_state_runtime import NmpcArrays, NmpcState
from ._scale import Scale


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Task:
    """The numbers that one solution asks for.

    Attributes:
        start: state of the model before the first sample.
        offset: (3 N,) set-points of z = 0 [rad].
        target: (2 N,) t, pitch and roll after each sample [rad].
        asked: a.
        low, high: of the rows.
        least, most: of z.
        guess: of z.
    """

    start: Vector
    offset: Vector
    target: Vector
    asked: Vector
    low: Vector
    high: Vector
    least: Vector
    most: Vector
    guess: Vector


class OptimalControl:
    """A problem whose matrices stay: its expression is made once and solved for any number of tasks."""

    def __init__(
        self, model: Model, *, spread: Matrix, weights: Vector, R: Matrix, Q: Matrix, G: Matrix,
        options: dict[str, Any], scale: Scale | None = None, look: int = 0,
    ) -> None:  # fmt: skip
        """Make the expression; `options` are ipopt's, `scale` the units of another robot; Y from `look` samples on."""
        import casadi as ca

        n, m = len(model.robot.motors.names), len(model.robot.outputs.names)
        linear, self._keep = linear_step(model, scale)
        N, nz = weights.size // m, spread.shape[1]
        sizes = (len(self._keep), n * N, m * N, R.shape[0])
        z, p = ca.MX.sym("z", nz), ca.MX.sym("p", sum(sizes))
        x, offset, target, asked = ca.vertsplit(p, [0, *np.cumsum(sizes).tolist()])
        U = ca.reshape(ca.mtimes(_sparse(spread), z) + offset, n, N)
        S, angles, slopes = ca.MX(len(self._keep), nz), [], []
        for i in [*range(N), *[N - 1] * look]:
            move = _sparse(spread[n * i : n * i + n])
            x, y, A, B, C, D = linear(x, U[:, i])
            slopes.append(ca.mtimes(C, S) + ca.mtimes(D, move))
            S = ca.mtimes(A, S) + ca.mtimes(B, move)
            angles.append(y)
        Y, S, w = ca.vertcat(*angles[look:]), ca.densify(ca.vertcat(*slopes[look:])), 2.0 * ca.DM(weights)
        own = ca.mtimes(_sparse(R), z) - asked
        cost = 0.5 * ca.dot(w, (Y - target) ** 2) + ca.sumsqr(own)
        gradient = ca.mtimes(S.T, w * (Y - target)) + 2.0 * ca.mtimes(_sparse(R.T), own)
        hessian = ca.mtimes((S * ca.repmat(w, 1, nz)).T, S) + ca.DM(2.0 * R.T @ R)
        rows, slope = (ca.mtimes(_sparse(Q), of) + ca.mtimes(_sparse(G), by) for of, by in ((Y, z), (S, ca.DM.eye(nz))))
        by_cost, by_rows = ca.MX.sym("by_cost"), ca.MX.sym("by_rows", G.shape[0])
        given = {
            "grad_f": ca.Function("grad_f", [z, p], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ca.Function("jac_g", [z, p], [rows, slope], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": ca.Function(
                "hess_lag", [z, p, by_cost, by_rows], [ca.triu(by_cost * hessian)],
                ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"],
            ),
        }  # fmt: skip
        quiet = {"ipopt": {"print_level": 0, "sb": "yes", **options}, "print_time": False}
        self._solver = ca.nlpsol("optimal", "ipopt", {"x": z, "p": p, "f": cost, "g": rows}, {**given, **quiet})

    def solve(self, task: Task) -> tuple[Vector, str]:
        """Return z and what ipopt says of it ("Solve_Succeeded")."""
        t = task
        found = self._solver(
            x0=t.guess, p=np.concatenate([t.start[self._keep], t.offset, t.target, t.asked]),
            lbx=t.least, ubx=t.most, lbg=t.low, ubg=t.high,
        )  # fmt: skip
        return np.array(found["x"])[:, 0], str(self._solver.stats()["return_status"])


def linear_step(model: Model, scale: Scale | None = None) -> tuple[Any, list[int]]:
    """Return `casadi.Function` x, u -> x_next, y, A, B, C, D of the outputs, over the states that they depend on.

    Those states are returned too: the others (random numbers, what no lag reads) hold what they held at the start.
    """
    import casadi as ca

    step, n, m = model.casadi(), len(model.robot.motors.names), len(model.robot.outputs.names)
    reads = [np.array(ca.DM(step.jac_sparsity(i, 0), 1.0)) != 0.0 for i in range(2)]
    need, more = reads[1][:m].any(axis=0), True
    while more:
        before, need = need, need | reads[0][need].any(axis=0)
        more = bool((before != need).any())
    keep = np.flatnonzero(need).tolist()
    x, u = ca.SX.sym("x", len(keep)), ca.SX.sym("u", n)
    whole = ca.SX(ca.DM(model.block().initial_state().values))
    whole[keep] = x
    ahead, y = step(whole, u if scale is None else scale.motors * u)
    both = ahead[keep], y[:m] if scale is None else y[:m] / ca.DM(scale.outputs)
    return ca.Function("linear", [x, u], [*both, *(ca.jacobian(of, by) for of in both for by in (x, u))]), keep


def _sparse(matrix: Matrix) -> Any:
    import casadi as ca

    return ca.sparsify(ca.DM(matrix))


class OptimalPart(BlockPart):
    """A nonlinear predictive controller whose plan ipopt finds before each sample: what its own solver is held to.

    The block starts from that plan: its own Gauss-Newton step, of which an optimum is a fixed point, checks and applies
    it. Only the first sample, which has no state yet, is the block's alone.

    Attributes:
        moves: (moves, motors) that ipopt found for the last sample [rad], of another robot in the unit of its size.
        status: what ipopt said of them.
    """

    def __init__(self, controller: NonlinearController) -> None:
        """Make the problem of `controller`."""
        super().__init__(controller.block())
        p, s = controller.problem(), controller.settings
        n, m = p.motors, p.outputs
        self.status, self.moves = "", np.zeros((0, n))
        self._problem = p
        self._runtime: Any = load_functions(self.block.runtime, compiled=False)
        self._parts = NmpcState.parts(NmpcArrays(self.block.arrays))
        nz, slacks = p.variables, int(s.angle_limit is not None)
        spread = np.hstack([p.spread(), np.zeros((n * p.horizon, slacks))])
        sums = np.kron(np.tril(np.ones((nz // n, nz // n))), np.eye(n))
        # Rows: positions; then, with a soft limit, angles at the ends of the holds from above and from below.
        ends = np.array([*p.starts[1:], p.horizon]) - 1
        places = np.concatenate([m * ends + axis for axis in range(m)])[: None if slacks else 0]
        self._seen = np.eye(m * p.horizon)[places]
        units = np.ones(m) if p.scale is None else p.scale.outputs
        self._limits = (s.angle_limit or 0.0) / units[places % m]
        give = np.eye(1, nz + slacks, nz + slacks - 1).repeat(len(self._seen), axis=0)
        # The slack costs w (e^2 + e / 10) = w (e + 1/20)^2 + constant.
        self._slack = np.sqrt(s.slack_weight * p.weights[0].max()) * np.eye(slacks, nz + slacks, nz)
        level = np.kron(np.eye(p.horizon), p.levels) @ spread
        self._solver = OptimalControl(
            controller.model, spread=spread, weights=p.weights.ravel(),
            R=np.vstack([
                np.sqrt(p.move_weight) * np.eye(nz, nz + slacks), np.sqrt(p.cocontraction_weight) * level, self._slack,
            ]),
            Q=np.vstack([np.zeros((nz, m * p.horizon)), self._seen, self._seen]),
            G=np.vstack([np.hstack([sums, np.zeros((nz, slacks))]), -give, give]),
            options={"tol": 1e-10}, scale=p.scale, look=p.look,
        )  # fmt: skip

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the set-points."""
        if self._state[self._parts["started"]] != 0.0:
            z, self.status = self._solver.solve(self._task(inputs))
            self.moves = z[: self._problem.variables].reshape(-1, self._problem.motors)
            self._state[self._parts["plan"]] = self.moves.ravel()
        return super().advance(time, inputs)

    def _task(self, u: Vector) -> Task:
        """Return what the sample asks for, by the runtime's own functions up to its solver."""
        f, arrays, problem, state = self._runtime, self.block.arrays, self._problem, self._state.copy()
        x = {name: state[place] for name, place in self._parts.items()}
        nz, N, slacks = problem.variables, problem.horizon, len(self._slack)
        n, m = problem.motors, problem.outputs
        u = f.nmpc_inputs(arrays, u)
        f.nmpc_listen(arrays, state, u, False)
        if f.nmpc_measured(arrays, u):
            f.nmpc_compare(arrays, state, u, False)
        target, asked, ahead = np.empty(m * N), np.empty(nz), np.empty(m * N)
        f.nmpc_asked(arrays, state, target, asked)
        f.nmpc_ahead(arrays, state, ahead)
        lower, upper = np.empty(x["active"].size), np.empty(x["active"].size)
        limits, first = f.nmpc_limits(arrays, self._parameters), 2 * m + 1
        f.nmpc_bounds(arrays, limits, x["held"], u[first : first + n], lower, upper)
        least, most = lower[: nz + slacks], upper[: nz + slacks]
        wanted = np.append(x["filtered"][m], np.zeros(len(problem.levels) - 1))
        level = np.tile(np.sqrt(problem.cocontraction_weight) * (wanted - problem.levels @ x["held"]), N)
        free, none, limit = self._seen @ ahead, np.full(len(self._seen), np.inf), self._limits
        return Task(
            start=x["model"], offset=np.tile(x["held"], N), target=target - ahead,
            asked=np.concatenate([np.sqrt(problem.move_weight) * asked, level, -0.05 * self._slack.sum(axis=1)]),
            low=np.concatenate([lower[nz + slacks :][:nz], -none, -limit - free]),
            high=np.concatenate([upper[nz + slacks :][:nz], limit - free, none]),
            least=least, most=most, guess=np.clip(np.append(x["plan"], np.zeros(slacks)), least, most),
        )  # fmt: skip
