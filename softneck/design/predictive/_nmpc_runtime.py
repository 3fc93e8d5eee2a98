"""Nonlinear predictive control: estimate, linearise along the plan, condense, solve, check, shift.

Member 0 is the model, whose free run it predicts with and whose derivatives are those of its step's text (see
`softneck.runtime._tangent`); the solver is that of `_dual_runtime`.

State: head (NMPC_HEAD), held (3), filtered references (3), references last seen (3), references to come (2, H),
the model's state, its angles of now (2), what it missed (window, 2) newest first, plan (nz), active rows (m).
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
    NMPC_CONVERGED,
    NMPC_HELD,
    NMPC_HOLDING,
    NMPC_ITERATIONS,
    NMPC_MISSED,
    NMPC_MOVE,
    NMPC_N,
    NMPC_NO_BOUND,
    NMPC_OPTIMAL,
    NMPC_OUTPUTS,
    NMPC_PLAN,
    NMPC_RESIDUAL,
    NMPC_SETTLE,
    NMPC_SHIFTED,
    NMPC_SLACK,
    NMPC_SOFT,
    NMPC_SOFTENED,
    NMPC_STARTED,
    NMPC_STATUS,
    NMPC_TS,
    nmpc_ahead,
    nmpc_asked,
    nmpc_listen,
    nmpc_places,
    nmpc_plausible,
    nmpc_shift,
)
from softneck.runtime._layout import Arrays, array
from softneck.runtime._members_runtime import member_initialise, member_size, member_step, member_tangent

_MOST_ITERATIONS = 50
_CONVERGED = 1e-10
_TOLERANCE = 1e-10
_LARGEST_RESIDUAL = 1e-7


class NmpcArrays(Arrays):
    """Those of the model follow."""

    setup = array("15", "constants, see NMPC_TS and those below it")
    starts = array("b", "samples at which the motors may move")
    T = array("3, 3", "of Eq. 9-11: motors to redefined inputs")
    weights = array("N, 2", "on angle errors [1/rad^2]")
    gains = array("2, window", "what was missed to its level and rate")
    future = array("N, 2", "what level and rate of it make of each sample to come")
    slopes = array("b, path", "references to come to moves of the redefined inputs")
    inverse = array("3, 2", "of T, by the static gains")
    asked_at = array("path", "which of the references to come each sample asks for")
    free = array("parameters", "of the model in free run")


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return nmpc_places(arrays, member_size(arrays, 0))[6]


def step(
    arrays: NmpcArrays,
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; with preview
    pitch_reference_ahead, roll_reference_ahead.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position [rad].
    """
    _, x, y, missed, plan, _, end = nmpc_places(arrays, member_size(arrays, 0))
    held = state[NMPC_HELD : NMPC_HELD + 3]
    first = state[NMPC_STARTED] == 0.0
    if first:
        for j in range(3):
            held[j] = inputs[5 + j] if math.isfinite(inputs[5 + j]) else 0.0
    nmpc_listen(arrays, state, inputs, first)
    measured = nmpc_plausible(inputs[3]) and nmpc_plausible(inputs[4])
    state[NMPC_MISSED] = 0.0 if measured else state[NMPC_MISSED] + 1.0
    acts = inputs[8] > 0.5 and inputs[9] > 0.5 and state[NMPC_MISSED] <= arrays[0][NMPC_COAST]
    if first:
        nmpc_settle(arrays, state[x:y], held, state[y:missed])
    if measured:
        for i in range(plan - missed - 1, 1, -1):
            state[missed + i] = state[missed + i - 2]
        for axis in range(2):
            error = inputs[3 + axis] - state[y + axis]
            state[missed + axis] = error
            if first or not acts:
                for i in range(missed + axis, plan, 2):
                    state[i] = error
    if first or not acts:
        for axis in range(2):
            state[NMPC_HELD + 3 + axis] = state[y + axis] + state[missed + axis]
        state[NMPC_HELD + 5] = np.dot(arrays[2][2], held)
        state[plan:end] = 0.0
    state[NMPC_STARTED] = 1.0
    state[NMPC_STATUS] = NMPC_HOLDING
    if acts:
        nmpc_decide(arrays, parameters, state, inputs)
    nmpc_model(arrays, state[x:y], held, state[y:missed])
    outputs[:] = held


def nmpc_model(arrays: tuple[np.ndarray, ...], x: np.ndarray, motors: np.ndarray, angles: np.ndarray) -> None:
    """Move the model on in free run under `motors` and fill its `angles`."""
    u = np.empty(8)
    u[:3] = motors
    u[3:] = np.nan
    out = np.zeros(int(arrays[0][NMPC_OUTPUTS]))
    member_step(arrays, 0, arrays[9], x, u, out)
    angles[:] = out[:2]


def nmpc_settle(arrays: tuple[np.ndarray, ...], x: np.ndarray, motors: np.ndarray, angles: np.ndarray) -> None:
    """Bring the model to where it had been, had it stood under `motors` for ever."""
    out = np.zeros(int(arrays[0][NMPC_OUTPUTS]))
    member_initialise(arrays, 0, arrays[9], x, out)
    for _ in range(int(arrays[0][NMPC_SETTLE])):
        nmpc_model(arrays, x, motors, angles)


def nmpc_linear(
    arrays: tuple[np.ndarray, ...], x: np.ndarray, motors: np.ndarray, z: np.ndarray, Y: np.ndarray, S: np.ndarray
) -> None:
    """Fill the angles Y (2 N,) that the plan `z` leads to from `x`, and their derivative S (2 N, nz)."""
    N, starts, nz = int(arrays[0][NMPC_N]), arrays[1], z.shape[0]
    now, held = x.copy(), motors.copy()
    u, out = np.empty(8), np.zeros(int(arrays[0][NMPC_OUTPUTS]))
    u[3:] = np.nan
    X, U, D = np.zeros((x.shape[0], nz)), np.zeros((8, nz)), np.zeros((out.shape[0], nz))
    block = 0
    for k in range(N):
        if block < starts.shape[0] and starts[block] == k:
            for j in range(3):
                held[j] += z[3 * block + j]
                U[j, 3 * block + j] = 1.0
            block += 1
        u[:3] = held
        # Moves that are still to come have moved nothing.
        moved = 3 * block
        member_tangent(arrays, 0, arrays[9], now, u, out, X, U, D, moved)
        Y[2 * k : 2 * k + 2] = out[:2]
        S[2 * k : 2 * k + 2, :moved] = D[:2, :moved]


def nmpc_quadratic(
    arrays: tuple[np.ndarray, ...], z: np.ndarray, held: np.ndarray, common: float, missing: np.ndarray, S: np.ndarray,
    asked: np.ndarray, H: np.ndarray, f: np.ndarray,
) -> None:  # fmt: skip
    """Fill the QP's H and f for absolute moves; `missing` (2 N,) is what angles are above their targets."""
    q, nz = arrays[0], z.shape[0]
    N, starts, T = int(q[NMPC_N]), arrays[1], arrays[2]
    weights = arrays[3].reshape(2 * N)
    weighted = np.empty((nz, 2 * N))
    for i in range(2 * N):
        weighted[:, i] = 2.0 * weights[i] * S[i]
    H[:, :] = 0.0
    f[:] = 0.0
    H[:nz, :nz] = np.dot(weighted, S)
    f[:nz] = np.dot(weighted, missing - np.dot(S, z)) - 2.0 * q[NMPC_MOVE] * asked
    level = np.dot(T[2], held) - common
    for b in range(starts.shape[0]):
        for j in range(3):
            i = 3 * b + j
            H[i, i] += 2.0 * q[NMPC_MOVE]
            f[i] += 2.0 * q[NMPC_COCONTRACTION] * T[2, j] * (N - starts[b]) * level
            for c in range(starts.shape[0]):
                # Samples on which both moves are in what is held.
                both = N - max(starts[b], starts[c])
                for m in range(3):
                    H[i, 3 * c + m] += 2.0 * q[NMPC_COCONTRACTION] * both * T[2, j] * T[2, m]
    if q[NMPC_SLACK] > 0.0:
        H[nz, nz] = 2.0 * q[NMPC_SLACK]
        f[nz] = 0.1 * q[NMPC_SLACK]


def nmpc_bounds(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, held: np.ndarray, motors: np.ndarray, lower: np.ndarray,
    upper: np.ndarray, slacks: int,
) -> None:  # fmt: skip
    """Fill the bounds of moves, slack and positions."""
    move = parameters[1] * arrays[0][NMPC_TS]
    nz = 3 * arrays[1].shape[0]
    for i in range(nz):
        lower[i] = -move
        upper[i] = move
    for j in range(3):
        known = motors[j] if math.isfinite(motors[j]) else held[j]
        lower[j] = min(max(-move, known - parameters[2] - held[j]), move)
        upper[j] = max(min(move, known + parameters[2] - held[j]), lower[j])
    if slacks > 0:
        lower[nz] = 0.0
        upper[nz] = NMPC_NO_BOUND
    for i in range(nz):
        # A motor beyond a limit comes back as fast as its first move may: that can always be done.
        j = i % 3
        lower[nz + slacks + i] = min(max(-parameters[0], parameters[3]), held[j] + upper[j]) - held[j]
        upper[nz + slacks + i] = max(parameters[0], held[j] + lower[j]) - held[j]


def nmpc_rows(
    arrays: tuple[np.ndarray, ...], z: np.ndarray, reached: np.ndarray, S: np.ndarray, A: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> None:  # fmt: skip
    """Fill the QP's rows (m, n): moves and slack as they are, positions, angles at the ends of the holds.

    reached: (2 N,) angles as they are expected under the plan `z`, disturbance among them.
    """
    nz, n, starts = z.shape[0], A.shape[1], arrays[1]
    b = starts.shape[0]
    A[:, :] = 0.0
    for i in range(n):
        A[i, i] = 1.0
    for i in range(nz):
        for c in range(i // 3 + 1):
            A[n + i, 3 * c + i % 3] = 1.0
    if n > nz:
        for axis in range(2):
            for c in range(b):
                end = int(starts[c + 1]) if c + 1 < b else int(arrays[0][NMPC_N])
                at = 2 * (end - 1) + axis
                row = n + nz + axis * b + c
                free = reached[at] - np.dot(S[at], z)
                for side in range(2):
                    A[row + 2 * b * side, :nz] = S[at]
                A[row, nz] = -1.0
                A[row + 2 * b, nz] = 1.0
                lower[row] = -NMPC_NO_BOUND
                upper[row] = arrays[0][NMPC_ANGLE_LIMIT] - free
                lower[row + 2 * b] = -arrays[0][NMPC_ANGLE_LIMIT] - free
                upper[row + 2 * b] = NMPC_NO_BOUND


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
            else:
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
    z[:] = -f
    qp_backward(L, n, z)
    across = np.empty((n, m))
    for row in range(m):
        across[:, row] = X[row]
    iterations = qp_solve(np.dot(X, across), np.dot(A, z), lower, upper, sign, lam, budget, _TOLERANCE, n)
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


def nmpc_decide(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray) -> None:
    """Plan, check the plan, and move `held` by its first moves, or by those of the plan before."""
    q = arrays[0]
    _, xat, yat, missed, plan, active, end = nmpc_places(arrays, member_size(arrays, 0))
    N, nz = int(q[NMPC_N]), active - plan
    slacks = 1 if q[NMPC_SLACK] > 0.0 else 0
    n, m = nz + slacks, end - active
    held = state[NMPC_HELD : NMPC_HELD + 3]
    target, asked, ahead = np.empty(2 * N), np.empty(nz), np.empty(2 * N)
    nmpc_asked(arrays, state, target, asked)
    nmpc_ahead(arrays, state[missed:plan], ahead)
    lower, upper, lam = np.empty(m), np.empty(m), np.zeros(m)
    nmpc_bounds(arrays, parameters, held, inputs[5:8], lower, upper, slacks)
    Y, S = np.empty(2 * N), np.zeros((2 * N, nz))
    H, f, A = np.empty((n, n)), np.empty(n), np.empty((m, n))
    z, at, sign = np.empty(n), state[plan:active].copy(), state[active:end].copy()
    total = 0
    answered = False
    slack = 0.0
    for _ in range(_MOST_ITERATIONS if q[NMPC_CONVERGED] > 0.5 else 1):
        nmpc_linear(arrays, state[xat:yat], held, at, Y, S)
        Y += ahead
        nmpc_quadratic(arrays, at, held, state[NMPC_HELD + 5], Y - target, S, asked, H, f)
        nmpc_rows(arrays, at, Y, S, A, lower, upper)
        iterations = nmpc_solve(H, f, A, lower, upper, sign, int(q[NMPC_BUDGET]), z, lam)
        total += iterations if iterations >= 0 else int(q[NMPC_BUDGET])
        answered = False
        if iterations >= 0:
            state[NMPC_RESIDUAL] = nmpc_residual(H, f, A, z, lam, lower, upper)
            answered = state[NMPC_RESIDUAL] <= _LARGEST_RESIDUAL
        if not answered:
            break
        for i in range(m):
            sign[i] = 1.0 if lam[i] > 0.0 else (-1.0 if lam[i] < 0.0 else 0.0)
        change = np.max(np.abs(z[:nz] - at))
        at[:] = z[:nz]
        slack = z[nz] if slacks > 0 else 0.0
        if change < _CONVERGED:
            break
    state[NMPC_ITERATIONS] = total
    nmpc_take(state, at, sign, plan, answered, slack)
    for j in range(3):
        move = min(max(state[plan + j], lower[j]), upper[j])
        low, high = min(-parameters[0], held[j]), max(parameters[0], held[j])
        held[j] = min(max(held[j] + move, low), high)
    nmpc_shift(arrays[1], state[plan:active])


def nmpc_take(state: np.ndarray, z: np.ndarray, sign: np.ndarray, plan: int, answered: bool, slack: float) -> None:
    """Make an answer the plan; without one the previous plan goes on."""
    active = plan + z.shape[0]
    end = active + sign.shape[0]
    if answered:
        state[plan:active] = z
        state[active:end] = sign
        # 1e-6 rad is no violation that anybody could measure.
        state[NMPC_STATUS] = NMPC_SOFT if slack > 1e-6 else NMPC_OPTIMAL
        if slack > 1e-6:
            state[NMPC_SOFTENED] += 1.0
    else:
        state[active:end] = 0.0
        state[NMPC_STATUS] = NMPC_PLAN
        state[NMPC_SHIFTED] += 1.0
