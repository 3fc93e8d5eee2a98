"""Linear model predictive control of both axes: observer, prediction over the dead time, one QP, its checks.

Each scenario s has, for each axis, a model `x+ = A x + B v(k - d)`, `y = x[0] + o` that runs on the inputs alone. Its
output disturbance o follows what was measured: `o+ = o + r`, `r+ = a r` with a the plant's slowest pole, which is what
a load makes of the angle that comes on at the plant's input. The QP's parameter is

    theta = [x(k + d) of all scenarios and axes, (o, r) of them, wanted pitch and roll minus what measured disturbances
             will add (rows k+1 .. k+L each), held set-points (3), wanted co-contraction, 1]

and its solution z the moves of the motors at the blocks' starts, then the slacks; see `_prediction`.

State: counters (MPC_COUNTERS), held (3), filtered references (3), references last seen (3), measured disturbances,
x (2 S, n), (o, r) (2 S, 2), past inputs v (D, 2) newest first, references to come (2, H), plan z, active rows (m).
"""

import math

import numpy as np

from softneck.design.mpc._dual_runtime import qp_solve

MPC_REFERENCE_LIMIT = 0.8
MPC_MOTOR_LIMIT = 6.0
# No neck leans this far; whoever says so measures nothing.
MPC_PLAUSIBLE = 1.3
MPC_NO_BOUND = 1e30

# Counters at the head of the state.
MPC_STARTED = 0
MPC_ITERATIONS = 1
MPC_STATUS = 2  # of the last sample: one of the MPC_* below
MPC_SHIFTED = 3  # samples on which the shifted previous plan was used
MPC_SOFTENED = 4  # samples on which a soft limit could not be kept
MPC_MISSED = 5  # samples in a row without a measurement
MPC_AGE = 6  # of the plan
MPC_RESIDUAL = 7  # of the KKT conditions, last answer
MPC_SLACK = 8  # largest, last answer
MPC_COUNTERS = 9
MPC_OPTIMAL = 1.0
MPC_SOFT = 2.0
MPC_PLAN = 3.0
MPC_HOLDING = 4.0

# arrays[0], by place.
MPC_TS = 0
MPC_ROWS = 1  # L
MPC_SCENARIOS = 2
MPC_ORDER = 3
MPC_PAST = 4  # D
MPC_MOVES = 5
MPC_SLACKS = 6
MPC_AHEAD = 7  # H
MPC_LEAD = 8
MPC_DISTURBANCES = 9
MPC_BUDGET = 10
MPC_TOLERANCE = 11
MPC_COAST = 12
MPC_ANGLE_AT = 13  # places of two parameters; those whose limit is not set are not there
MPC_TAUT_AT = 14

# Kinds of rows.
MPC_ROW_MOVE = 0.0
MPC_ROW_POSITION = 1.0
MPC_ROW_SLACK = 2.0
MPC_ROW_ANGLE_HIGH = 3.0
MPC_ROW_ANGLE_LOW = 4.0
MPC_ROW_TAUT = 5.0


def mpc_places(arrays: tuple[np.ndarray, ...]) -> tuple[int, int, int, int, int, int, int, int]:
    """Return where disturbances, x, o, past inputs, references to come, plan and active rows begin, and the end."""
    q = arrays[0]
    S, n = int(q[MPC_SCENARIOS]), int(q[MPC_ORDER])
    disturbances = MPC_COUNTERS + 9
    x = disturbances + 2 * int(q[MPC_DISTURBANCES])
    o = x + 2 * S * n
    past = o + 4 * S
    ahead = past + 2 * int(q[MPC_PAST])
    plan = ahead + 2 * int(q[MPC_AHEAD])
    active = plan + 3 * int(q[MPC_MOVES]) + int(q[MPC_SLACKS])
    return disturbances, x, o, past, ahead, plan, active, active + arrays[14].shape[0]


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return mpc_places(arrays)[7]


def initialise(
    arrays: tuple[np.ndarray, ...],  # noqa: ARG001
    parameters: np.ndarray,  # noqa: ARG001
    state: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Start with motors at rest; the first step takes over where they really are."""
    state[:] = 0.0
    outputs[:] = 0.0


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; with preview
    pitch_reference_ahead, roll_reference_ahead; then measured disturbances.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position [rad]; where set,
    angle limit and least tautness [rad].
    """
    if mpc_begin(arrays, state, inputs):
        mpc_decide(arrays, parameters, state, inputs)
    else:
        state[MPC_STATUS] = MPC_HOLDING
    mpc_predict(arrays, state)
    outputs[:] = state[MPC_COUNTERS : MPC_COUNTERS + 3]


def mpc_begin(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray) -> bool:
    """Take in what is known now; return whether the motors may move."""
    held = state[MPC_COUNTERS : MPC_COUNTERS + 3]
    if state[MPC_STARTED] == 0.0:
        for j in range(3):
            held[j] = inputs[5 + j] if math.isfinite(inputs[5 + j]) else 0.0
    mpc_listen(arrays, state, inputs)
    measured = mpc_plausible(inputs[3]) and mpc_plausible(inputs[4])
    state[MPC_MISSED] = 0.0 if measured else state[MPC_MISSED] + 1.0
    active = inputs[8] > 0.5 and inputs[9] > 0.5 and state[MPC_MISSED] <= arrays[0][MPC_COAST]
    if state[MPC_STARTED] == 0.0 or not active:
        mpc_align(arrays, state, inputs, measured)
    elif measured:
        mpc_correct(arrays, state, inputs)
    state[MPC_STARTED] = 1.0
    if active:
        mpc_filter(arrays, state)
    return active


def mpc_plausible(angle: float) -> bool:
    """Return whether an angle is one that a neck can have."""
    return math.isfinite(angle) and abs(angle) < MPC_PLAUSIBLE


def mpc_listen(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray) -> None:
    """Take in references and measured disturbances; one that is not finite leaves what was."""
    seen = state[MPC_COUNTERS + 6 : MPC_COUNTERS + 9]
    for i in range(3):
        if math.isfinite(inputs[i]):
            limit = MPC_REFERENCE_LIMIT if i < 2 else MPC_MOTOR_LIMIT
            seen[i] = min(max(inputs[i], -limit), limit)
    places = mpc_places(arrays)
    H = int(arrays[0][MPC_AHEAD])
    first = 10
    if H > 0:
        first = 12
        ahead = state[places[4] : places[4] + 2 * H]
        for axis in range(2):
            row = ahead[axis * H : (axis + 1) * H]
            if state[MPC_STARTED] == 0.0:
                row[:] = seen[axis]
            for i in range(H - 1):
                row[i] = row[i + 1]
            value = inputs[10 + axis]
            if math.isfinite(value):
                row[H - 1] = min(max(value, -MPC_REFERENCE_LIMIT), MPC_REFERENCE_LIMIT)
    count = int(arrays[0][MPC_DISTURBANCES])
    for i in range(count):
        value = inputs[first + i]
        now = state[places[0] + 2 * i]
        state[places[0] + 2 * i] = value if math.isfinite(value) else now
        if state[MPC_STARTED] == 0.0:
            state[places[0] + 2 * i + 1] = state[places[0] + 2 * i]


def mpc_added(arrays: tuple[np.ndarray, ...], state: np.ndarray, axis: int) -> float:
    """Return what the measured disturbances add to an angle now."""
    first = mpc_places(arrays)[0]
    total = 0.0
    for i in range(int(arrays[0][MPC_DISTURBANCES])):
        total += arrays[6][i, axis] * state[first + 2 * i + 1]
    return total


def mpc_align(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray, measured: bool) -> None:
    """Start as if the neck had always stood where it is under the held set-points: no bump."""
    q = arrays[0]
    S, n, D = int(q[MPC_SCENARIOS]), int(q[MPC_ORDER]), int(q[MPC_PAST])
    _, first, o, past, _, plan, _, end = mpc_places(arrays)
    held = state[MPC_COUNTERS : MPC_COUNTERS + 3]
    v = np.dot(arrays[8], held)
    for s in range(S):
        for axis in range(2):
            i = 2 * s + axis
            for j in range(n):
                state[first + i * n + j] = arrays[4][i, j] * v[axis]
            state[o + 2 * i] = 0.0
            state[o + 2 * i + 1] = 0.0
            if measured:
                state[o + 2 * i] = inputs[3 + axis] - state[first + i * n] - mpc_added(arrays, state, axis)
            state[MPC_COUNTERS + 3 + axis] = state[first + i * n] + state[o + 2 * i]
    state[MPC_COUNTERS + 5] = v[2]
    for i in range(D):
        state[past + 2 * i] = v[0]
        state[past + 2 * i + 1] = v[1]
    state[plan:end] = 0.0
    state[MPC_AGE] = 0.0


def mpc_correct(arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray) -> None:
    """Take the measured angles in."""
    q = arrays[0]
    n = int(q[MPC_ORDER])
    _, first, o, _, _, _, _, _ = mpc_places(arrays)
    for i in range(2 * int(q[MPC_SCENARIOS])):
        error = inputs[3 + i % 2] - mpc_added(arrays, state, i % 2) - state[first + i * n] - state[o + 2 * i]
        state[o + 2 * i] += arrays[3][i, 0] * error
        state[o + 2 * i + 1] += arrays[3][i, 1] * error


def mpc_filter(arrays: tuple[np.ndarray, ...], state: np.ndarray) -> None:
    """Move the reference filters on: what is asked now acts now."""
    H, lead = int(arrays[0][MPC_AHEAD]), int(arrays[0][MPC_LEAD])
    ahead = mpc_places(arrays)[4]
    for i in range(3):
        a = arrays[7][i]
        asked = state[MPC_COUNTERS + 6 + i]
        if i < 2 and H > 0 and lead > 0:
            asked = state[ahead + i * H + min(lead, H) - 1]
        state[MPC_COUNTERS + 3 + i] = a * state[MPC_COUNTERS + 3 + i] + (1.0 - a) * asked


def mpc_parameter(arrays: tuple[np.ndarray, ...], state: np.ndarray, theta: np.ndarray) -> None:
    """Fill theta."""
    q = arrays[0]
    S, n, L = int(q[MPC_SCENARIOS]), int(q[MPC_ORDER]), int(q[MPC_ROWS])
    H, lead = int(q[MPC_AHEAD]), int(q[MPC_LEAD])
    d0, first, o, past, ahead, _, _, _ = mpc_places(arrays)
    x = np.empty(n)
    y = np.empty(n)
    for i in range(2 * S):
        x[:] = state[first + i * n : first + (i + 1) * n]
        for back in range(int(arrays[5][i]), 0, -1):
            v = state[past + 2 * (back - 1) + i % 2]
            for j in range(n):
                total = arrays[2][i, j] * v
                for m in range(n):
                    total += arrays[1][i * n + j, m] * x[m]
                y[j] = total
            x[:] = y
        theta[i * n : (i + 1) * n] = x
        theta[2 * S * n + 2 * i] = state[o + 2 * i]
        theta[2 * S * n + 2 * i + 1] = state[o + 2 * i + 1]
    at = 2 * S * (n + 2)
    for axis in range(2):
        a = arrays[7][axis]
        value = state[MPC_COUNTERS + 3 + axis]
        for i in range(1, L + 1):
            asked = state[MPC_COUNTERS + 6 + axis]
            if H > 0:
                asked = state[ahead + axis * H + min(i + lead, H) - 1]
            value = a * value + (1.0 - a) * asked
            theta[at + axis * L + i - 1] = value
        for j in range(int(q[MPC_DISTURBANCES])):
            w, z = state[d0 + 2 * j], state[d0 + 2 * j + 1]
            for i in range(L):
                z = arrays[6][j, 2] * z + (1.0 - arrays[6][j, 2]) * w
                theta[at + axis * L + i] -= arrays[6][j, axis] * z
    at += 2 * L
    theta[at : at + 3] = state[MPC_COUNTERS : MPC_COUNTERS + 3]
    theta[at + 3] = state[MPC_COUNTERS + 5]
    theta[at + 4] = 1.0


def mpc_bounds(
    arrays: tuple[np.ndarray, ...], parameters: np.ndarray, held: np.ndarray, motors: np.ndarray, theta: np.ndarray,
    lower: np.ndarray, upper: np.ndarray,
) -> None:  # fmt: skip
    """Fill the bounds of all rows."""
    kinds, motor = arrays[14][:, 0], arrays[14][:, 1]
    free = np.dot(arrays[13], theta)
    move = parameters[1] * arrays[0][MPC_TS]
    for i in range(kinds.shape[0]):
        low, high = -MPC_NO_BOUND, MPC_NO_BOUND
        if kinds[i] == MPC_ROW_MOVE:
            low, high = -move, move
            if i < 3 and math.isfinite(motors[i]):
                low = min(max(low, motors[i] - parameters[2] - held[i]), high)
                high = max(min(high, motors[i] + parameters[2] - held[i]), low)
        elif kinds[i] == MPC_ROW_POSITION:
            # A motor beyond a limit comes back as fast as its first move may: that can always be done.
            j = int(motor[i])
            low = min(max(-parameters[0], parameters[3]), held[j] + upper[j]) - free[i]
            high = max(parameters[0], held[j] + lower[j]) - free[i]
        elif kinds[i] == MPC_ROW_SLACK:
            low = 0.0
        elif kinds[i] == MPC_ROW_ANGLE_HIGH:
            high = parameters[int(arrays[0][MPC_ANGLE_AT])] - free[i]
        elif kinds[i] == MPC_ROW_ANGLE_LOW:
            low = -parameters[int(arrays[0][MPC_ANGLE_AT])] - free[i]
        else:
            low = parameters[int(arrays[0][MPC_TAUT_AT])] - free[i]
        lower[i] = low
        upper[i] = high


def mpc_decide(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, inputs: np.ndarray) -> None:
    """Solve the QP, check its answer and move `held` by its first moves, or by those of the plan before."""
    q = arrays[0]
    held = state[MPC_COUNTERS : MPC_COUNTERS + 3]
    _, _, _, _, _, _, active, end = mpc_places(arrays)
    theta = np.empty(arrays[10].shape[1])
    mpc_parameter(arrays, state, theta)
    m = arrays[14].shape[0]
    lower, upper, lam = np.empty(m), np.empty(m), np.zeros(m)
    mpc_bounds(arrays, parameters, held, inputs[5:8], theta, lower, upper)
    z0 = np.dot(arrays[10], theta)
    c = np.dot(arrays[11], z0)
    sign = state[active:end].copy()
    budget, tolerance = int(q[MPC_BUDGET]), q[MPC_TOLERANCE]
    iterations = qp_solve(arrays[12], c, lower, upper, sign, lam, budget, tolerance, z0.shape[0])
    state[MPC_ITERATIONS] = iterations if iterations >= 0 else budget
    z = z0 - np.dot(lam, arrays[15])
    mpc_take(arrays, state, theta, z, lam, lower, upper, iterations >= 0)
    mpc_move(arrays, state, lower, upper, parameters[0])


def mpc_take(
    arrays: tuple[np.ndarray, ...], state: np.ndarray, theta: np.ndarray, z: np.ndarray, lam: np.ndarray,
    lower: np.ndarray, upper: np.ndarray, answered: bool,
) -> None:  # fmt: skip
    """Make an answer the plan if it keeps the KKT conditions; else the previous plan goes on."""
    _, _, _, _, _, first, active, end = mpc_places(arrays)
    if answered:
        state[MPC_RESIDUAL] = mpc_residual(arrays, theta, z, lam, lower, upper)
        # 100 times the solver's own bound: beyond it the answer is none.
        answered = state[MPC_RESIDUAL] <= 100.0 * arrays[0][MPC_TOLERANCE]
    if answered:
        state[first:active] = z
        for i in range(end - active):
            state[active + i] = 1.0 if lam[i] > 0.0 else (-1.0 if lam[i] < 0.0 else 0.0)
        state[MPC_AGE] = 0.0
        mpc_judge(arrays, state, z)
    else:
        state[active:end] = 0.0
        state[MPC_AGE] += 1.0
        state[MPC_STATUS] = MPC_PLAN
        state[MPC_SHIFTED] += 1.0


def mpc_judge(arrays: tuple[np.ndarray, ...], state: np.ndarray, z: np.ndarray) -> None:
    """Note whether the answer needed slack."""
    count = int(arrays[0][MPC_SLACKS])
    largest = 0.0
    for i in range(count):
        largest = max(largest, z[z.shape[0] - count + i])
    state[MPC_SLACK] = largest
    # 1e-6 rad is no violation that anybody could measure.
    state[MPC_STATUS] = MPC_SOFT if largest > 1e-6 else MPC_OPTIMAL
    if largest > 1e-6:
        state[MPC_SOFTENED] += 1.0


def mpc_residual(
    arrays: tuple[np.ndarray, ...], theta: np.ndarray, z: np.ndarray, lam: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> float:  # fmt: skip
    """Return the largest residual of the KKT conditions: stationarity, by the size of H, bounds, multipliers' signs."""
    gradient = np.dot(arrays[16], z) + np.dot(arrays[17], theta) + np.dot(lam, arrays[11])
    worst = np.max(np.abs(gradient)) / arrays[18][0]
    r = np.dot(arrays[11], z)
    for i in range(r.shape[0]):
        worst = max(worst, r[i] - upper[i], lower[i] - r[i])
        if lam[i] > 0.0:
            worst = max(worst, min(abs(r[i] - upper[i]), lam[i]))
        elif lam[i] < 0.0:
            worst = max(worst, min(abs(r[i] - lower[i]), -lam[i]))
    return worst


def mpc_move(
    arrays: tuple[np.ndarray, ...], state: np.ndarray, lower: np.ndarray, upper: np.ndarray, position: float
) -> None:
    """Move `held` as the plan says for its age, within the bounds of now."""
    plan = mpc_places(arrays)[5]
    held = state[MPC_COUNTERS : MPC_COUNTERS + 3]
    starts = arrays[9]
    for j in range(3):
        move = 0.0
        for b in range(starts.shape[0]):
            if starts[b] == state[MPC_AGE]:
                move = state[plan + 3 * b + j]
        move = min(max(move, lower[j]), upper[j])
        low, high = min(-position, held[j]), max(position, held[j])
        held[j] = min(max(held[j] + move, low), high)


def mpc_predict(arrays: tuple[np.ndarray, ...], state: np.ndarray) -> None:
    """Move models, past inputs and disturbances on to the next sample."""
    q = arrays[0]
    n, D = int(q[MPC_ORDER]), int(q[MPC_PAST])
    d0, first, o, past, _, _, _, _ = mpc_places(arrays)
    v = np.dot(arrays[8], state[MPC_COUNTERS : MPC_COUNTERS + 3])
    x = np.empty(n)
    for i in range(2 * int(q[MPC_SCENARIOS])):
        back = int(arrays[5][i])
        u = state[past + 2 * (back - 1) + i % 2] if back > 0 else v[i % 2]
        x[:] = state[first + i * n : first + (i + 1) * n]
        for j in range(n):
            total = arrays[2][i, j] * u
            for m in range(n):
                total += arrays[1][i * n + j, m] * x[m]
            state[first + i * n + j] = total
        state[o + 2 * i] += state[o + 2 * i + 1]
        state[o + 2 * i + 1] *= arrays[3][i, 2]
    for i in range(D - 1, 0, -1):
        state[past + 2 * i] = state[past + 2 * i - 2]
        state[past + 2 * i + 1] = state[past + 2 * i - 1]
    if D > 0:
        state[past] = v[0]
        state[past + 1] = v[1]
    for i in range(int(q[MPC_DISTURBANCES])):
        keep = arrays[6][i, 2]
        state[d0 + 2 * i + 1] = keep * state[d0 + 2 * i + 1] + (1.0 - keep) * state[d0 + 2 * i]
