"""The extended Kalman filter over a model that has derivatives: what is measured corrects the model's own state too.

Member 0 is the model, and its step's derivatives are those of its text (see `softneck.runtime._tangent`). The state of
the filter is the model's, the outputs that it makes of it, and a disturbance of each that walks; noise enters the
model as what its motors are wrong by (Anderson and Moore 1979, sec. 8.2).
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GATE,
    KALMAN_LAG,
    KalmanCounters,
    kalman_clear,
    kalman_count,
    kalman_forced,
    kalman_healthy,
    kalman_usable,
)
from softneck.estimation._nonlinear_parts_runtime import (
    NONLINEAR_START,
    NONLINEAR_TOLD,
    NonlinearArrays,
    nonlinear_faster,
    nonlinear_settle,
    nonlinear_slew,
    nonlinear_tell,
)
from softneck.runtime._layout import cells, rest
from softneck.runtime._members_runtime import member_size, member_tangent


class ExtendedState(KalmanCounters):
    """Counters, what the model says and misses; its own state follows, then the covariance."""

    fastest = cells("", "motion of the model in a sample, of late")
    angles = cells("outputs", "of the model at the filter's time")
    disturbance = cells("outputs", "what it misses")
    held = cells("motors", "set-points that came last")
    reached = cells("motors", "set-points that moved the model last: no faster than the drives take them")
    model = rest("state of the model, then P of that state, its outputs and the disturbances")


def extended_size(p: NonlinearArrays) -> int:
    """Return the length of what the filter estimates."""
    return member_size(p, 0) + 2 * p.outputs


def state_size(p: NonlinearArrays) -> int:
    """Return the length of the state vector."""
    return ExtendedState.size(p) + member_size(p, 0) + extended_size(p) ** 2


def initialise(p: NonlinearArrays, parameters: np.ndarray, x: ExtendedState, outputs: np.ndarray) -> None:  # noqa: ARG001
    """Start where nothing is known; the first sample tells where the motors stand."""
    x[:] = 0.0
    kalman_clear(p.constants, x)
    outputs[:] = 0.0


def step(p: NonlinearArrays, parameters: np.ndarray, x: ExtendedState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Move the model on, then take in the measurement where there is a credible one.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: pitch, roll, pitch_rate, roll_rate, innovation, healthy.
    parameters: measurement noise, the disturbance's at rest (standard deviations), what of a motion it may be, and
    what the motors are wrong by (standard deviation).
    """
    c, n, m, size = p.constants, p.motors, p.outputs, member_size(p, 0)
    asked, measured = inputs[:n], inputs[n : n + m]
    start = p.setup[NONLINEAR_START]
    members = x.model
    model, P = members[:size], members[size:].reshape((extended_size(p), extended_size(p)))
    if x.samples == 0.0:
        x.held[:] = asked
        x.reached[:] = asked
        nonlinear_settle(p, p.free, model, asked, x.angles)
        for i in range(size + m, size + 2 * m):
            P[i, i] = start * start
    usable = kalman_usable(c, x, measured, float(inputs[n + m]), parameters[0])
    forced = kalman_forced(c, x)
    extended_predict(p, parameters, x, model, P, asked)
    if forced:
        # Wide enough for the measurement to have its way.
        for i in range(size + m, size + 2 * m):
            P[i, i] += start * start
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = extended_correct(p, parameters[0], x, model, P, measured, forced)
    kalman_count(c, x, usable, accepted)
    # Copies: the filter's own model stays at the time of the measurement.
    nonlinear_tell(p, p.free, model.copy(), x.angles.copy(), x.disturbance, x.reached.copy(), asked, outputs)
    outputs[2 * m] = innovation
    outputs[2 * m + 1] = 1.0 if kalman_healthy(c, x, parameters[0]) else 0.0
    x.samples += 1.0


def extended_predict(
    p: NonlinearArrays, parameters: np.ndarray, x: ExtendedState, model: np.ndarray, P: np.ndarray, asked: np.ndarray
) -> None:
    """Move the model and the covariance on under what acted since the last sample."""
    n, m, size, before = p.motors, p.outputs, member_size(p, 0), x.angles.copy()
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    u, out = np.empty(2 * n + m), np.zeros(int(p.setup[NONLINEAR_TOLD]))
    u[:n] = x.reached
    u[n:] = np.nan  # NaN: nothing is measured
    # Rows of the derivatives by the model's state, then by its motors.
    G, U, D = np.zeros((size, size + n)), np.zeros((2 * n + m, size + n)), np.zeros((out.shape[0], size + n))
    for i in range(size):
        G[i, i] = 1.0
    for j in range(n):
        U[j, size + j] = 1.0
    member_tangent(p, 0, p.free, model, u, out, G, U, D, size + n)
    x.angles[:] = out[:m]
    x.held[:] = asked
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    extended_spread(p, G, D, P, parameters[3] * parameters[3])
    walked = parameters[1] * parameters[1] + (parameters[2] * x.fastest) ** 2
    for i in range(size + m, size + 2 * m):
        P[i, i] += walked


def extended_spread(p: NonlinearArrays, G: np.ndarray, D: np.ndarray, P: np.ndarray, motors: float) -> None:
    """Take the covariance a sample on: through the model's derivatives, and what the motors are wrong by."""
    n, m, size = p.motors, p.outputs, member_size(p, 0)
    both = size + m  # the model's state, then its outputs
    T = np.zeros((both, size + n))
    for i in range(size):
        T[i] = G[i]
    for i in range(m):
        T[size + i] = D[i]
    # T diag(Pxx, motors): of what the state of before and the motors are wrong by.
    W = np.zeros((both, size + n))
    for i in range(both):
        for k in range(size):
            if T[i, k] != 0.0:
                for j in range(size):
                    W[i, j] += T[i, k] * P[k, j]
        for j in range(n):
            W[i, size + j] = T[i, size + j] * motors
    cross = np.zeros((both, m))
    for i in range(both):
        for k in range(size):
            if T[i, k] != 0.0:
                for j in range(m):
                    cross[i, j] += T[i, k] * P[k, both + j]
    P[:both, :both] = 0.0
    for j in range(both):
        for k in range(size + n):
            if T[j, k] != 0.0:
                for i in range(both):
                    P[i, j] += W[i, k] * T[j, k]
    for i in range(both):
        for j in range(m):
            P[i, both + j] = cross[i, j]
            P[both + j, i] = cross[i, j]


def extended_correct(
    p: NonlinearArrays,
    noise: float,
    x: ExtendedState,
    model: np.ndarray,
    P: np.ndarray,
    measured: np.ndarray,
    forced: bool,
) -> tuple[float, bool]:
    """Take the outputs in, one after the other, unless the gate refuses all; return the NIS and whether they were."""
    m, size, whole = p.outputs, member_size(p, 0), extended_size(p)
    told, spread = np.zeros(whole), P.copy()
    innovation, log_det = 0.0, 0.0
    for i in range(m):
        y, d = size + i, size + m + i
        Ph = spread[:, y] + spread[:, d]
        S = Ph[y] + Ph[d] + noise * noise
        e = measured[i] - x.angles[i] - x.disturbance[i] - told[y] - told[d]
        innovation += e * e / S
        log_det += math.log(S)
        for j in range(whole):
            told[j] += Ph[j] / S * e
            for k in range(whole):
                spread[j, k] -= Ph[j] * Ph[k] / S
    x.log_det = log_det
    if not (forced or innovation <= p.constants[KALMAN_GATE]):
        return innovation, False
    P[:] = spread
    model += told[:size]
    x.angles += told[size : size + m]
    x.disturbance += told[size + m :]
    return innovation, True
