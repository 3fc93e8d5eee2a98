"""Linear model predictive control of both axes: observer, prediction over the dead time, one QP, its checks.

The QP's parameter is `MpcTheta`, and its solution z the moves of the motors at the blocks' starts, then the slacks; see
`_prediction` for its cost and rows, `_mpc_state_runtime` for the models.
"""

import math

import numpy as np

from softneck.design.linear._rest_runtime import initialise as initialise
from softneck.design.predictive._dual_runtime import qp_solve
from softneck.design.predictive._mpc_state_runtime import (
    MPC_ANGLE_AT,
    MPC_BUDGET,
    MPC_NO_BOUND,
    MPC_OPTIMAL,
    MPC_PLAN,
    MPC_ROW_ANGLE_HIGH,
    MPC_ROW_ANGLE_LOW,
    MPC_ROW_MOVE,
    MPC_ROW_POSITION,
    MPC_ROW_SLACK,
    MPC_SOFT,
    MPC_TAUT_AT,
    MPC_TOLERANCE,
    MPC_TS,
    MpcArrays,
    MpcState,
    MpcTheta,
    mpc_begin,
    mpc_limits,
    mpc_parameter,
    mpc_predict,
)
from softneck.design.predictive._scaled_runtime import scaled_inputs, scaled_output, scaled_range, scaled_unit


def step(p: MpcArrays, parameters: np.ndarray, x: MpcState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Compute the set-points for now, and the state for the next sample.

    inputs: pitch, roll and co-contraction reference, pitch, roll, motor_position_1..3, healthy, enabled; with preview
    pitch_reference_ahead, roll_reference_ahead; where it is told the payload. The outputs of another robot stand for
    pitch and roll.
    outputs: motor_setpoint_1..3.
    parameters: position limit [rad], slew limit [rad/s], lead limit [rad], least position [rad]; where set,
    angle limit and least tautness [rad].
    """
    u = scaled_inputs(p.constants, p.motors, p.outputs, p.ahead, inputs)
    if mpc_begin(p, x, u):
        mpc_decide(p, mpc_limits(p, x, parameters), x, u)
    # Held or moved: models and past inputs go on with what the motors were told.
    mpc_predict(p, x)
    outputs[:] = x.held
    outputs *= scaled_unit(p.constants, p.motors, p.outputs)


def mpc_bounds(
    p: MpcArrays, parameters: np.ndarray, motors: np.ndarray, theta: MpcTheta, lower: np.ndarray, upper: np.ndarray
) -> None:
    """Fill the bounds of all rows."""
    q = p.constants
    held = theta.held
    free = np.dot(p.E, theta)  # pyright: ignore[reportArgumentType]  (a vector)
    move = parameters[1] * q[MPC_TS]
    for i in range(p.m):
        kind = p.kinds[i, 0]
        low, high = -MPC_NO_BOUND, MPC_NO_BOUND
        if kind == MPC_ROW_MOVE:
            low, high = -move, move
            # The first rows, one for each motor, are the moves of now, whose motors have been seen.
            if i < p.motors and math.isfinite(motors[i]):
                # Within the slew at any rate: a motor far off must not leave the problem without a solution.
                low = min(max(low, motors[i] - parameters[2] - held[i]), high)
                high = max(min(high, motors[i] + parameters[2] - held[i]), low)
        elif kind == MPC_ROW_POSITION:
            # A motor beyond a limit comes back as fast as its first move may: that can always be done.
            j = int(p.kinds[i, 1])
            least, most = scaled_range(p.constants, p.motors, parameters, j)
            low = min(least, held[j] + upper[j]) - free[i]
            high = max(most, held[j] + lower[j]) - free[i]
        elif kind == MPC_ROW_SLACK:
            low = 0.0
        elif kind == MPC_ROW_ANGLE_HIGH:
            # Soft limits: the slack is a variable of the row.
            high = mpc_angle(p, parameters, int(p.kinds[i, 1])) - free[i]
        elif kind == MPC_ROW_ANGLE_LOW:
            low = -mpc_angle(p, parameters, int(p.kinds[i, 1])) - free[i]
        else:
            low = parameters[int(q[MPC_TAUT_AT])] - free[i]
        lower[i] = low
        upper[i] = high


def mpc_angle(p: MpcArrays, parameters: np.ndarray, axis: int) -> float:
    """Return the scaled soft limit of an angle."""
    return parameters[int(p.constants[MPC_ANGLE_AT])] / scaled_output(p.constants, p.motors, p.outputs, axis)


def mpc_decide(p: MpcArrays, parameters: np.ndarray, x: MpcState, inputs: np.ndarray) -> None:
    """Solve the QP, check its answer and move `held` by its first moves, or by those of the plan before."""
    theta = np.empty(MpcTheta.size(p))
    mpc_parameter(p, x, theta)  # pyright: ignore[reportArgumentType]
    lower, upper, lam = np.empty(p.m), np.empty(p.m), np.zeros(p.m)
    first = 2 * p.outputs + 1  # of the motors
    mpc_bounds(p, parameters, inputs[first : first + p.motors], theta, lower, upper)  # pyright: ignore[reportArgumentType]
    z0 = np.dot(p.K, theta)
    # A warm start, from the rows that the last sample ended with.
    sign = x.active.copy()
    budget = int(p.constants[MPC_BUDGET])
    # The rows' multipliers depend on G and the rows at z0 alone.
    c = np.dot(p.A, z0)
    iterations = qp_solve(p.G, c, lower, upper, sign, lam, budget, p.constants[MPC_TOLERANCE], z0.shape[0])
    x.iterations = iterations if iterations >= 0 else budget
    # z = z0 - H^-1 A' lambda; H is symmetric.
    z = z0 - np.dot(lam, p.AH)
    mpc_take(p, x, theta, z, lam, lower, upper, iterations >= 0)
    mpc_move(p, parameters, x, lower, upper)


def mpc_take(
    p: MpcArrays, x: MpcState, theta: np.ndarray, z: np.ndarray, lam: np.ndarray, lower: np.ndarray, upper: np.ndarray,
    answered: bool,
) -> None:  # fmt: skip
    """Make an answer the plan if it keeps the KKT conditions; else the previous plan goes on."""
    if answered:
        x.residual = mpc_residual(p, theta, z, lam, lower, upper)
        # 100 times the solver's own bound: beyond it the answer is none.
        answered = x.residual <= 100.0 * p.constants[MPC_TOLERANCE]
    if answered:
        x.plan[:] = z
        for i in range(p.m):
            x.active[i] = 1.0 if lam[i] > 0.0 else (-1.0 if lam[i] < 0.0 else 0.0)
        x.age = 0.0
        mpc_judge(p, x, z)
    else:
        # Rows of an answer that was none are no start.
        x.active[:] = 0.0
        x.age += 1.0
        x.status = MPC_PLAN
        x.shifted += 1.0


def mpc_judge(p: MpcArrays, x: MpcState, z: np.ndarray) -> None:
    """Note whether the answer needed slack."""
    largest = 0.0
    for i in range(p.slacks):
        largest = max(largest, z[p.motors * p.moves + i])
    x.slack = largest
    # 1e-6 rad is no violation that anybody could measure.
    x.status = MPC_SOFT if largest > 1e-6 else MPC_OPTIMAL
    if largest > 1e-6:
        x.softened += 1.0


def mpc_residual(
    p: MpcArrays, theta: np.ndarray, z: np.ndarray, lam: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> float:
    """Return the largest residual of the KKT conditions: stationarity, by the size of H, bounds, multipliers' signs."""
    # H z + F theta + A' lambda = 0.
    gradient = np.dot(p.H, z) + np.dot(p.F, theta) + np.dot(lam, p.A)
    worst = np.max(np.abs(gradient)) / p.scale[0]
    r = np.dot(p.A, z)
    for i in range(p.m):
        worst = max(worst, r[i] - upper[i], lower[i] - r[i])
        if lam[i] > 0.0:
            # Complementarity: a multiplier or a distance to its bound, not both.
            worst = max(worst, min(abs(r[i] - upper[i]), lam[i]))
        elif lam[i] < 0.0:
            worst = max(worst, min(abs(r[i] - lower[i]), -lam[i]))
    return worst


def mpc_move(p: MpcArrays, parameters: np.ndarray, x: MpcState, lower: np.ndarray, upper: np.ndarray) -> None:
    """Move `held` to the planned value for its age, within the present bounds."""
    for j in range(p.motors):
        move = 0.0
        for b in range(p.moves):
            if p.starts[b] == x.age:  # whole numbers: equality is safe
                move = x.plan[p.motors * b + j]
        # Bounds of now: a plan of an earlier sample knew others.
        move = min(max(move, lower[j]), upper[j])
        least, most = scaled_range(p.constants, p.motors, parameters, j)
        low, high = min(least, x.held[j]), max(most, x.held[j])
        x.held[j] = min(max(x.held[j] + move, low), high)
