"""What a predictive controller remembers, and how it moves on: models, disturbances, references, past inputs.

See `_mpc_runtime` for the state and theta.
"""

import math

import numpy as np

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
MPC_ANGLE_BACK = 15  # how much soft limits are tightened
MPC_TAUT_BACK = 16

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


def mpc_plausible(angle: float) -> bool:
    """Return whether an angle is one that a neck can have."""
    return math.isfinite(angle) and abs(angle) < MPC_PLAUSIBLE


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
