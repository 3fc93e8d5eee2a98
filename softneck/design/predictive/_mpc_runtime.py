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

from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.design.predictive._dual_runtime import qp_solve
from softneck.design.predictive._mpc_state_runtime import (
    MPC_AGE,
    MPC_ANGLE_AT,
    MPC_ANGLE_BACK,
    MPC_BUDGET,
    MPC_COUNTERS,
    MPC_HOLDING,
    MPC_ITERATIONS,
    MPC_NO_BOUND,
    MPC_OPTIMAL,
    MPC_PLAN,
    MPC_RESIDUAL,
    MPC_ROW_ANGLE_HIGH,
    MPC_ROW_ANGLE_LOW,
    MPC_ROW_MOVE,
    MPC_ROW_POSITION,
    MPC_ROW_SLACK,
    MPC_SHIFTED,
    MPC_SLACK,
    MPC_SLACKS,
    MPC_SOFT,
    MPC_SOFTENED,
    MPC_STATUS,
    MPC_TAUT_AT,
    MPC_TAUT_BACK,
    MPC_TOLERANCE,
    MPC_TS,
    mpc_begin,
    mpc_parameter,
    mpc_places,
    mpc_predict,
)


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return mpc_places(arrays)[7]


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
            high = parameters[int(arrays[0][MPC_ANGLE_AT])] - arrays[0][MPC_ANGLE_BACK] - free[i]
        elif kinds[i] == MPC_ROW_ANGLE_LOW:
            low = arrays[0][MPC_ANGLE_BACK] - parameters[int(arrays[0][MPC_ANGLE_AT])] - free[i]
        else:
            low = parameters[int(arrays[0][MPC_TAUT_AT])] + arrays[0][MPC_TAUT_BACK] - free[i]
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
