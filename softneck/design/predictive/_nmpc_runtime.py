"""Nonlinear predictive control: estimate, linearise along the plan, condense, solve, check, shift.

Member 0 is the model, whose free run it predicts with and whose derivatives are those of its step's text (see
`softneck.runtime._tangent`); the solver is that of `_dual_runtime`.
"""

import math

import numpy as np

from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.design.predictive._dual_runtime import qp_backward, qp_solve
from softneck.design.predictive._nmpc_state_runtime import (
    NMPC_ANGLE_LIMIT,
    NMPC_BUDGET,
    NMPC_COAST,
    NMPC_COCONTRACTION,
    NMPC_HOLDING,
    NMPC_MOVE,
    NMPC_NO_BOUND,
    NMPC_OUTPUTS,
    NMPC_SETTLE,
    NMPC_SLACK,
    NMPC_TS,
    NmpcArrays,
    NmpcState,
    nmpc_ahead,
    nmpc_asked,
    nmpc_common,
    nmpc_shift,
    nmpc_take,
)
from softneck.design.predictive._scaled_runtime import (
    scaled_inputs,
    scaled_listen,
    scaled_measured,
    scaled_output,
    scaled_range,
    scaled_unit,
)
from softneck.runtime._members_runtime import member_initialise, member_size, member_step, member_tangent

_QP_TOLERANCE = 1e-10  # [rad] by which the QP's rows may be beyond their bounds
_LARGEST_RESIDUAL = 1e-7  # 1000 times `_QP_TOLERANCE`: beyond it the answer is none


def state_size(p: NmpcArrays) -> int:
    """Return the length of the state vector."""
    return NmpcState.size(p) + member_size(p, 0)


def step(p: NmpcArrays, parameters: np.ndarray, x: NmpcState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; with preview
    pitch_reference_ahead, roll_reference_ahead. The outputs of another robot stand for pitch and roll.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position [rad].
    """
    q, unit = p.setup, scaled_unit(p.setup, p.motors, p.outputs)
    u = scaled_inputs(q, p.motors, p.outputs, p.H, inputs)
    flags = 2 * p.outputs + 1 + p.motors
    first = x.started == 0.0
    if first:
        for j in range(p.motors):
            position = u[2 * p.outputs + 1 + j]
            x.held[j] = position if math.isfinite(position) else 0.0
    scaled_listen(q, p.motors, p.outputs, p.H, bool(first), u, x.seen, x.ahead)
    measured = scaled_measured(q, p.outputs, u)
    x.lost = 0.0 if measured else x.lost + 1.0
    acts = u[flags] > 0.5 and u[flags + 1] > 0.5 and x.lost <= p.setup[NMPC_COAST]
    if first:
        nmpc_settle(p, x)
    if measured:
        nmpc_compare(p, x, u, first or not acts)
    if first or not acts:
        # Whoever takes over goes on from where the neck is: no bump.
        for axis in range(p.outputs):
            x.filtered[axis] = x.angles[axis] + x.missed[0, axis]
        x.filtered[p.outputs] = np.dot(p.T[p.outputs], x.held)
        x.plan[:] = 0.0
        x.active[:] = 0.0
    x.started = 1.0
    x.status = NMPC_HOLDING
    if acts:
        nmpc_decide(p, parameters / unit, x, u)
    # In free run, measured or not: what it misses is in `missed`, not in its state.
    nmpc_model(p, x.model, x.held, x.angles)
    nmpc_look(p, x)
    outputs[:] = x.held
    outputs *= unit


def nmpc_compare(p: NmpcArrays, x: NmpcState, inputs: np.ndarray, anew: bool) -> None:
    """Push measurement minus model into `missed`; `anew` fills all of it."""
    missed, m = x.missed, p.outputs
    for i in range(missed.shape[0] - 1, m - 1, -1):
        missed[i] = missed[i - m]
    for axis in range(m):
        error = inputs[m + 1 + axis] - x.angles[axis]
        missed[axis] = error
        if anew:
            for i in range(axis, missed.shape[0], m):
                missed[i] = error


def nmpc_model(p: NmpcArrays, model: np.ndarray, motors: np.ndarray, angles: np.ndarray) -> None:
    """Move the model on in free run under `motors` and fill its `angles`."""
    u = np.empty(2 * p.motors + p.outputs)
    u[: p.motors] = motors
    u[p.motors :] = np.nan  # NaN: nothing is measured
    u[: p.motors] *= scaled_unit(p.setup, p.motors, p.outputs)
    out = np.zeros(int(p.setup[NMPC_OUTPUTS]))
    member_step(p, 0, p.free, model, u, out)
    for axis in range(p.outputs):
        angles[axis] = out[axis] / scaled_output(p.setup, p.motors, p.outputs, axis)


def nmpc_look(p: NmpcArrays, x: NmpcState) -> None:
    """Fill the model's `angles` after its dead time, from past inputs and the held ones."""
    if p.look > 0:
        later = x.model.copy()
        for _ in range(p.look):
            nmpc_model(p, later, x.held, x.angles)


def nmpc_settle(p: NmpcArrays, x: NmpcState) -> None:
    """Bring the model to where it had been, had it stood under the held set-points for ever."""
    out = np.zeros(int(p.setup[NMPC_OUTPUTS]))
    member_initialise(p, 0, p.free, x.model, out)
    for _ in range(int(p.setup[NMPC_SETTLE])):
        nmpc_model(p, x.model, x.held, x.angles)
    nmpc_look(p, x)


def nmpc_linear(p: NmpcArrays, x: NmpcState, z: np.ndarray, Y: np.ndarray, S: np.ndarray) -> None:
    """Fill the angles Y (outputs N,) that the plan `z` leads to from now on, and their derivative S (outputs N, nz)."""
    nz, n, m = z.shape[0], p.motors, p.outputs
    # A copy: the controller's own model stays at t_k.
    now, held = x.model.copy(), x.held.copy()
    u, out = np.empty(2 * n + m), np.zeros(int(p.setup[NMPC_OUTPUTS]))
    u[n:] = np.nan
    unit = scaled_unit(p.setup, n, m)  # the model is in SI
    # dx/dz, du/dz, dy/dz: the state of now answers to no move.
    X, U, D = np.zeros((now.shape[0], nz)), np.zeros((2 * n + m, nz)), np.zeros((out.shape[0], nz))
    block = 0
    for k in range(p.N + p.look):
        if block < p.moves and p.starts[block] == k:
            for j in range(n):
                held[j] += z[n * block + j]
                U[j, n * block + j] = unit  # from here on, as `held` keeps the move
            block += 1
        u[:n] = unit * held
        # Moves that are still to come have moved nothing.
        moved = n * block
        member_tangent(p, 0, p.free, now, u, out, X, U, D, moved)
        row = m * (k - p.look)  # what comes before the first has happened: the observer told it
        if row >= 0:
            for axis in range(m):
                size = scaled_output(p.setup, n, m, axis)
                Y[row + axis] = out[axis] / size
                S[row + axis, :moved] = D[axis, :moved] / size


def nmpc_quadratic(
    p: NmpcArrays, x: NmpcState, z: np.ndarray, missing: np.ndarray, S: np.ndarray, asked: np.ndarray, H: np.ndarray,
    f: np.ndarray,
) -> None:  # fmt: skip
    """Fill the QP's H and f for absolute moves; `missing` (outputs N,) is the excess of angles over their targets."""
    q, nz, N, starts, n = p.setup, z.shape[0], p.N, p.starts, p.motors
    rows = p.outputs * N
    weights = p.weights.reshape(rows)
    # Gauss-Newton: H = 2 S' Q S, without the second derivative of the free run.
    weighted = np.empty((nz, rows))
    for i in range(rows):
        weighted[:, i] = 2.0 * weights[i] * S[i]
    H[:, :] = 0.0
    f[:] = 0.0
    H[:nz, :nz] = np.dot(weighted, S)
    # S z taken off, so that z are moves and not changes of the plan; `asked` are those that the reference needs.
    f[:nz] = np.dot(weighted, missing - np.dot(S, z)) - 2.0 * q[NMPC_MOVE] * asked
    for b in range(starts.shape[0]):
        for j in range(n):
            H[n * b + j, n * b + j] += 2.0 * q[NMPC_MOVE]
    for kept in range(p.kept):
        row = p.levels[kept]
        # Of now above what is wanted: delta, and nothing of what else moves no output.
        level = np.dot(row, x.held) - (nmpc_common(p, x) if kept == 0 else 0.0)
        for b in range(starts.shape[0]):
            for j in range(n):
                i = n * b + j
                # A move counts in all samples from its own on.
                f[i] += 2.0 * q[NMPC_COCONTRACTION] * row[j] * (N - starts[b]) * level
                for c in range(starts.shape[0]):
                    # Samples on which both moves are in what is held.
                    both = N - max(starts[b], starts[c])
                    for other in range(n):
                        H[i, n * c + other] += 2.0 * q[NMPC_COCONTRACTION] * both * row[j] * row[other]
    # sigma (eps^2 + 0.1 eps): the linear part makes slack zero wherever it can be.
    if q[NMPC_SLACK] > 0.0:
        H[nz, nz] = 2.0 * q[NMPC_SLACK]
        f[nz] = 0.1 * q[NMPC_SLACK]


def nmpc_bounds(
    p: NmpcArrays, parameters: np.ndarray, held: np.ndarray, motors: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> None:
    """Fill the bounds of moves, slack and positions."""
    move = parameters[1] * p.setup[NMPC_TS]
    n, slacks = p.motors, p.slacks
    nz = n * p.moves
    for i in range(nz):
        lower[i] = -move
        upper[i] = move
    for j in range(n):
        known = motors[j] if math.isfinite(motors[j]) else held[j]  # an encoder that says nothing: no lead to keep
        # Within the slew at any rate, as in `mpc_bounds`.
        lower[j] = min(max(-move, known - parameters[2] - held[j]), move)
        upper[j] = max(min(move, known + parameters[2] - held[j]), lower[j])
    if slacks > 0:
        lower[nz] = 0.0
        upper[nz] = NMPC_NO_BOUND
    for i in range(nz):
        # A motor beyond a limit comes back as fast as its first move may: that can always be done.
        j = i % n
        least, most = scaled_range(p.setup, n, parameters, j)
        lower[nz + slacks + i] = min(least, held[j] + upper[j]) - held[j]
        upper[nz + slacks + i] = max(most, held[j] + lower[j]) - held[j]


def nmpc_rows(
    p: NmpcArrays, z: np.ndarray, reached: np.ndarray, S: np.ndarray, A: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> None:  # fmt: skip
    """Fill the QP's rows (m, n): moves and slack as they are, positions, angles at the ends of the holds.

    reached: (outputs N,) angles as they are expected under the plan `z`, disturbance among them.
    """
    nz, n, b, starts = z.shape[0], A.shape[1], p.moves, p.starts
    A[:, :] = 0.0
    for i in range(n):
        A[i, i] = 1.0
    for i in range(nz):
        for c in range(i // p.motors + 1):  # a position is the sum of the moves so far
            A[n + i, p.motors * c + i % p.motors] = 1.0
    if n > nz:
        below = p.outputs * b  # from limits above to those below
        for axis in range(p.outputs):
            limit = p.setup[NMPC_ANGLE_LIMIT] / scaled_output(p.setup, p.motors, p.outputs, axis)
            for c in range(b):
                end = int(starts[c + 1]) if c + 1 < b else p.N
                at = p.outputs * (end - 1) + axis  # y of sample k + 1 stands in the rows of k
                row = n + nz + axis * b + c
                # The angle without any move: y(z) - S z, on its tangent.
                free = reached[at] - np.dot(S[at], z)
                for side in range(2):
                    A[row + below * side, :nz] = S[at]
                A[row, nz] = -1.0
                A[row + below, nz] = 1.0
                lower[row] = -NMPC_NO_BOUND
                upper[row] = limit - free
                lower[row + below] = -limit - free
                upper[row + below] = NMPC_NO_BOUND


def nmpc_factor(H: np.ndarray, L: np.ndarray) -> bool:
    """Fill L with the Cholesky factor of H; return false if H is not positive."""
    n = H.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = H[i, j]
            for m in range(j):
                value -= L[i, m] * L[j, m]
            if i > j:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = math.sqrt(value)
            else:  # not positive, or NaN
                return False
    return True


def nmpc_solve(
    H: np.ndarray, f: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray, sign: np.ndarray, budget: int,
    z: np.ndarray, lam: np.ndarray,
) -> int:  # fmt: skip
    """Solve min 1/2 z'Hz + f'z, lower <= A z <= upper; return the iterations, negative without an answer."""
    n, m = H.shape[0], A.shape[0]
    L = np.zeros((n, n))
    if not nmpc_factor(H, L):
        return -1
    # X = A L^-T row by row, so that G = A H^-1 A' = X X'.
    X = np.zeros((m, n))
    for row in range(m):
        for i in range(n):
            value = A[row, i]
            for j in range(i):
                value -= L[i, j] * X[row, j]
            X[row, i] = value / L[i, i]
    # z0 = -H^-1 f.
    z[:] = -f
    qp_backward(L, n, z)
    across = np.empty((n, m))
    for row in range(m):
        across[:, row] = X[row]
    iterations = qp_solve(np.dot(X, across), np.dot(A, z), lower, upper, sign, lam, budget, _QP_TOLERANCE, n)
    # H^-1 A' lambda = L'^-1 (X' lambda): half of a solve, as X has the other.
    change = np.dot(across, lam)
    for i in range(n - 1, -1, -1):
        value = change[i]
        for j in range(i + 1, n):
            value -= L[j, i] * change[j]
        change[i] = value / L[i, i]
    z -= change
    return iterations


def nmpc_residual(
    H: np.ndarray, f: np.ndarray, A: np.ndarray, z: np.ndarray, lam: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> float:
    """Return the largest residual of the KKT conditions, stationarity by the size of H."""
    gradient = np.dot(H, z) + f + np.dot(lam, A)
    size = 1.0
    for i in range(H.shape[0]):
        size = max(size, np.max(np.abs(H[i])))
    worst = np.max(np.abs(gradient)) / size
    r = np.dot(A, z)
    for i in range(r.shape[0]):
        worst = max(worst, r[i] - upper[i], lower[i] - r[i])
        if lam[i] > 0.0:
            worst = max(worst, min(abs(upper[i] - r[i]), lam[i]))
        elif lam[i] < 0.0:
            worst = max(worst, min(abs(r[i] - lower[i]), -lam[i]))
    return worst


def nmpc_decide(p: NmpcArrays, parameters: np.ndarray, x: NmpcState, inputs: np.ndarray) -> None:
    """Plan, check the plan, and move `held` by its first moves, or by those of the plan before."""
    q = p.setup
    nz, rows = p.motors * p.moves, p.outputs * p.N
    sign = x.active.copy()
    n, m = nz + p.slacks, sign.shape[0]
    target, asked, ahead = np.empty(rows), np.empty(nz), np.empty(rows)
    nmpc_asked(p, x, target, asked)
    nmpc_ahead(p, x, ahead)
    lower, upper, lam = np.empty(m), np.empty(m), np.zeros(m)
    first = 2 * p.outputs + 1  # of the motors
    nmpc_bounds(p, parameters, x.held, inputs[first : first + p.motors], lower, upper)
    Y, S = np.empty(rows), np.zeros((rows, nz))
    H, f, A, z = np.empty((n, n)), np.empty(n), np.empty((m, n)), np.empty(n)
    # Once: a real-time iteration (Diehl, Bock and Schloeder 2005), a full step without a line search.
    nmpc_linear(p, x, x.plan, Y, S)
    Y += ahead
    nmpc_quadratic(p, x, x.plan, Y - target, S, asked, H, f)
    nmpc_rows(p, x.plan, Y, S, A, lower, upper)
    iterations = nmpc_solve(H, f, A, lower, upper, sign, int(q[NMPC_BUDGET]), z, lam)
    x.iterations = iterations if iterations >= 0 else int(q[NMPC_BUDGET])
    answered = False
    if iterations >= 0:
        x.residual = nmpc_residual(H, f, A, z, lam, lower, upper)
        answered = bool(x.residual <= _LARGEST_RESIDUAL)
    # A start for the next sample's QP.
    for i in range(m):
        sign[i] = 1.0 if lam[i] > 0.0 else (-1.0 if lam[i] < 0.0 else 0.0)
    nmpc_take(p, x, z[:nz], sign, answered, float(z[nz]) if p.slacks > 0 else 0.0)
    plan, held = x.plan, x.held
    for j in range(p.motors):
        # Bounds of now: a plan of an earlier sample knew others.
        move = min(max(plan[j], lower[j]), upper[j])
        low, high = scaled_range(p.setup, p.motors, parameters, j)
        low, high = min(low, held[j]), max(high, held[j])
        held[j] = min(max(held[j] + move, low), high)
    nmpc_shift(p.starts, plan)
