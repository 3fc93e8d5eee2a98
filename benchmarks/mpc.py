"""Print what a sample of predictive control costs and whether its answers are optimal.

`python benchmarks/mpc.py [--states 10000] [--model NN.npz]`: linear, 30 unknowns (10 moves of 3 motors, N = 30) along
one closed loop with active limits, all solvers on the same QPs; then nonlinear over a network, N = 20. Single thread.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import casadi as ca
import daqp
import numpy as np
from scipy import sparse

from softneck.core import load
from softneck.design import MpcController, MpcSettings, NmpcSettings
from softneck.design.predictive._mpc_state_runtime import MpcArrays
from softneck.identification import Network
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import load_functions, load_runtime
from softneck.signals import signal
from tests.oracles.bake_off import bake_off_neck

_POLE = math.exp(-5.293 * 0.02)
_GAIN = math.radians(27.691) / 5.293
QPS = list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=10_000, help="random states whose answers are checked")
    parser.add_argument("--samples", type=int, default=2_000, help="samples of the loop that are timed")
    parser.add_argument("--model", help="a network to predict with; one is trained if not given")
    options = parser.parse_args()
    controller = MpcSettings(bandwidth=8.0, lead_limit=12.0).design(bake_off_neck())
    problems, whole = closed_loop(controller, options.samples)
    active = [int((row != 0.0).sum()) for *_, row in problems]
    rows, unknowns = MpcArrays(controller.arrays).A.shape
    print(f"linear: {unknowns} unknowns, {rows} rows, "
          f"{len(problems)} samples, {np.mean(active):.1f} active limits on average")  # fmt: skip
    print(f"| {'solver':34} | median [us] | p99 [us] | largest error of z [rad] |")
    show("the controller's step, all of it", whole, math.nan)
    reference = [cold(controller, *item[:3]) for item in problems]
    for name, make in SOLVERS.items():
        times, answers = timed(make(controller), problems)
        error = max((float(np.abs(a - b).max()) for a, b in zip(answers, reference, strict=True)), default=math.nan)
        show(name, times, error)
    show("LQR (u = -K x, no limits)", lqr(controller, problems), math.nan)
    show("do-mpc (ipopt, no move blocking)", do_mpc_times(200), math.nan)
    optimality(controller, options.states)
    nonlinear(options.model)


def show(name: str, times: list[float], error: float) -> None:
    """Print a row."""
    t = 1e6 * np.array(times)
    print(f"| {name:34} | {np.median(t):11.1f} | {np.percentile(t, 99):8.1f} | {error:24.1e} |")


def closed_loop(controller: MpcController, samples: int) -> tuple[QPS, list[float]]:
    """Return theta, bounds and active rows of each sample of a loop with large random steps, and what steps took."""
    block = controller.block()
    step = load_runtime(block.runtime).step
    f = load_functions(block.runtime)
    start = block.initial_state()
    x, parameters, out = start.values.copy(), start.parameters, np.zeros(3)
    u, rng, a = np.array([port.start for port in block.inputs]), np.random.default_rng(0), MpcArrays(controller.arrays)
    m = len(a.kinds)
    y, line = np.zeros(2), [np.zeros(2)] * 5
    problems, times = [], []
    for k in range(samples + 100):
        if k % 25 == 0:
            u[:2], u[2] = rng.uniform(-0.55, 0.55, 2), rng.uniform(-2.0, 2.0)
        u[3:5], u[5:8] = y, out
        shadow = x.copy()
        begin = time.perf_counter()
        step(controller.arrays, parameters, x, u, out)
        took = time.perf_counter() - begin
        theta, low, high = np.zeros(a.K.shape[1]), np.zeros(m), np.zeros(m)
        if f.mpc_begin(controller.arrays, shadow, u):
            f.mpc_parameter(controller.arrays, shadow, theta)
            f.mpc_bounds(controller.arrays, parameters, u[5:8], theta, low, high)
        if k >= 100:
            times.append(took)
            problems.append((theta, low, high, x[-m:].copy()))
        line = [*line[1:], (a.T @ out)[:2]]
        y = _POLE * y + (1.0 - _POLE) * _GAIN * line[0]
    return problems, times


def timed(solve: Callable[..., np.ndarray], problems: QPS) -> tuple[list[float], list[np.ndarray]]:
    """Return what each QP took, and its answer."""
    times, answers = [], []
    for theta, low, high, _ in problems:
        begin = time.perf_counter()
        answer = solve(theta, low, high)
        times.append(time.perf_counter() - begin)
        answers.append(answer)
    return times, answers


def cold(c: MpcController, theta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return daqp's answer from scratch, as the reference."""
    a, sense = MpcArrays(c.arrays), np.zeros(low.size, dtype=np.int32)
    return daqp.solve(a.H, a.F @ theta, a.A, high, low, sense, primal_tol=1e-12)[0]


def own(c: MpcController) -> Callable[..., np.ndarray]:
    """Return the block's solver, warm."""
    a, f = MpcArrays(c.arrays), load_functions("softneck.design.predictive._dual_runtime")
    sign, lam = np.zeros(len(a.kinds)), np.zeros(len(a.kinds))

    def solve(theta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        z0 = a.K @ theta
        f.qp_solve(a.G, a.A @ z0, low, high, sign, lam, 1000, 1e-10, z0.size)
        return z0 - lam @ a.AH

    return solve


def bare(c: MpcController) -> Callable[..., np.ndarray]:
    """Return daqp's persistent model alone."""
    a, made = MpcArrays(c.arrays), daqp.Model()
    nz = a.H.shape[0]
    made.setup(a.H, np.zeros(nz), a.A[nz:], np.full(len(a.kinds), 1e30), np.full(len(a.kinds), -1e30))

    def solve(theta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        made.update(f=a.F @ theta, bupper=high, blower=low)
        return made.solve()[0]

    return solve


def osqp_solver(c: MpcController) -> Callable[..., np.ndarray]:
    """Return OSQP, warm, at its usual accuracy."""
    import osqp

    a, made = MpcArrays(c.arrays), osqp.OSQP()
    wide = np.full(len(a.kinds), 1e3)
    made.setup(sparse.csc_matrix(np.triu(a.H)), np.zeros(a.H.shape[0]), sparse.csc_matrix(a.A), -wide, wide,
               verbose=False, eps_abs=1e-5, eps_rel=1e-5)  # fmt: skip

    def solve(theta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        made.update(q=a.F @ theta, l=low, u=high)
        return made.solve().x

    return solve


def casadi_daqp(c: MpcController) -> Callable[..., np.ndarray]:
    """Return CasADi's interface to daqp."""
    a = MpcArrays(c.arrays)
    H, A = ca.DM(a.H), ca.DM(a.A)
    made = ca.conic("qp", "daqp", {"h": H.sparsity(), "a": A.sparsity()})
    return lambda theta, low, high: np.array(made(h=H, g=a.F @ theta, a=A, lba=low, uba=high)["x"])[:, 0]


SOLVERS: dict[str, Callable[[MpcController], Callable[..., np.ndarray]]] = {
    "own dual active set (numba), warm": own,
    "bare daqp Model, warm": bare,
    "OSQP, warm, 1e-5": osqp_solver,
    "casadi.conic daqp": casadi_daqp,
}


def lqr(c: MpcController, problems: QPS) -> list[float]:
    """Return what the unconstrained law alone takes."""
    K = np.ascontiguousarray(MpcArrays(c.arrays).K[:3])
    return timed(lambda theta, *_: K @ theta, problems)[0]


def do_mpc_times(samples: int) -> list[float]:
    """Return what do-mpc takes on the same plant, horizon, limits and weights; nan where it is not installed."""
    try:
        import do_mpc
    except ImportError:
        return [math.nan]
    model = do_mpc.model.Model("discrete", "SX")
    y, v, du = (
        model.set_variable(kind, name, (n, 1)) for kind, name, n in (("_x", "y", 2), ("_x", "p", 3), ("_u", "d", 3))
    )
    T = ca.DM([[1.0, -0.5, -0.5], [0.0, math.sqrt(0.75), -math.sqrt(0.75)]])
    r = model.set_variable("_tvp", "r", (2, 1))
    model.set_rhs("y", _POLE * y + (1.0 - _POLE) * _GAIN * ca.mtimes(T, v + du))
    model.set_rhs("p", v + du)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = 30, 0.02
    mpc.settings.supress_ipopt_output()
    error = ca.sumsqr(y - r) / _GAIN**2
    mpc.set_objective(mterm=error, lterm=error + ca.sumsqr(ca.sum1(v)))
    mpc.set_rterm(d=10.0)
    mpc.bounds["lower", "_u", "d"], mpc.bounds["upper", "_u", "d"] = -0.25, 0.25
    mpc.bounds["lower", "_x", "p"], mpc.bounds["upper", "_x", "p"] = -6.0, 6.0
    template = mpc.get_tvp_template()
    mpc.set_tvp_fun(lambda _: template)
    mpc.setup()
    x, times, rng = np.zeros((5, 1)), [], np.random.default_rng(0)
    mpc.x0 = x
    mpc.set_initial_guess()
    for k in range(samples):
        if k % 25 == 0:
            template["_tvp", :, "r"] = rng.uniform(-0.55, 0.55, 2)
        begin = time.perf_counter()
        move = mpc.make_step(x)
        times.append(time.perf_counter() - begin)
        x[2:] += move
        x[:2] = _POLE * x[:2] + (1.0 - _POLE) * _GAIN * np.array(T) @ x[2:]
    return times


def optimality(c: MpcController, states: int) -> None:
    """Check answers at random states, limits anywhere, against daqp from scratch at 1e-12."""
    a, f = MpcArrays(c.arrays), load_functions("softneck.design.predictive._mpc_runtime")
    solve, parameters, rng = own(c), c.initial_state().parameters, np.random.default_rng(1)
    worst, worst_cost, active = 0.0, 0.0, []
    for _ in range(states):
        theta = 0.15 * rng.standard_normal(a.K.shape[1])
        theta[-5:-2], theta[-2], theta[-1] = rng.uniform(-6.0, 6.0, 3), rng.uniform(-2.0, 2.0), 1.0
        low, high = np.zeros(len(a.kinds)), np.zeros(len(a.kinds))
        f.mpc_bounds(c.arrays, parameters, theta[-5:-2].copy(), theta, low, high)
        mine, its = solve(theta, low, high), cold(c, theta, low, high)
        worst = max(worst, float(np.abs(mine - its).max()))
        g = a.F @ theta
        costs = [0.5 * z @ a.H @ z + g @ z for z in (mine, its)]
        worst_cost = max(worst_cost, (costs[0] - costs[1]) / max(1.0, abs(costs[1])))
        values = a.A @ mine
        active.append(int(((values > high - 1e-9) | (values < low + 1e-9)).sum()))
    print(f"optimality: {states} random states, {np.mean(active):.1f} active limits on average: moves within "
          f"{worst:.1e} rad of daqp from scratch, cost at most {worst_cost:.1e} above (relative)")  # fmt: skip


def nonlinear(path: str | None) -> None:
    """Time one real-time iteration over a network, N = 20."""
    if path:
        model = load(path, role="model")
    else:
        neck = VirtualNeck(NeckParameters.paper().with_sensor("3dm-gx5"))
        model = Network().fit(record(signal("eq22"), neck, seed=100).rows(0, 4000))
    controller = NmpcSettings().design(model)
    part = controller.part()
    out, times, iterations = part.start(0.0, {}), [], []
    block = model.block()
    state = block.initial_state(use_measurement=0.0)
    y, rng, r = np.zeros(2), np.random.default_rng(0), np.zeros(2)
    for k in range(1_000):
        if k % 50 == 0:
            r = rng.uniform(-0.3, 0.3, 2)
        out = part.advance(0.0, np.array([*r, 0.0, *y, *out, 1.0, 1.0]))
        times.append(part.took)
        iterations.append(part.info.iterations)
        state, found = block.step(state, [*out, *[math.nan] * 5])
        y = found[:2]
    t = 1e6 * np.array(times[100:])
    print(f"nonlinear over {model.kind}, N = 20, 30 unknowns, one iteration: median {np.median(t):.0f} us, "
          f"p99 {np.percentile(t, 99):.0f} us, all of the sample")  # fmt: skip


if __name__ == "__main__":
    main()
