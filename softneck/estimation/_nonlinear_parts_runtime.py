"""Of the observer over nonlinear models: simulation of the model, its correction, and the prediction to the present.

An output is that of the model, plus a disturbance, plus its motion in a sample times a timing error, plus the slope
over the payload times the payload's error. These n states `told` have the covariance `P` (n * n,), row after row.
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import (
    KALMAN_GATE,
    KALMAN_LAG,
    KALMAN_LEAD,
    KALMAN_PERIOD,
    KalmanCounters,
    kalman_count,
    kalman_forced,
    kalman_healthy,
    kalman_usable,
)
from softneck.runtime._layout import Arrays, array, cells, rest, value
from softneck.runtime._members_runtime import member_initialise, member_size, member_step

# Places in `setup`; the model has more outputs than the measured ones.
NONLINEAR_MOTORS = 0
NONLINEAR_OUTPUTS = 1
NONLINEAR_TOLD = 2
NONLINEAR_SETTLE = 3
NONLINEAR_START = 4
NONLINEAR_KEEP = 5
NONLINEAR_TIMING = 6
NONLINEAR_TIMING_KEEP = 7
NONLINEAR_SLEW = 8  # one a motor
# Places in `load`.
PAYLOAD_LEAST = 0
PAYLOAD_MOST = 1
PAYLOAD_WALK = 2


class NonlinearArrays(Arrays):
    """The observer's own arrays; those of the model follow."""

    setup = array(
        "places",
        "motors, outputs, outputs of the model, samples until it stands, standard deviation of the disturbance at "
        "the start, part of the fastest motion that a sample keeps, standard deviation of the timing error [samples], "
        "part of that which a sample keeps, then of each motor the most that its set-point moves the model in a sample",
    )
    constants = array("numbers", "see KALMAN_*; a lag of 1: the set-points come a sample early")
    free = array("parameters", "of the model in free run")
    load = array("3", "least and most payload [kg], standard deviation of its walk in a sample [kg]; 0 without one")
    motors = value("setup", NONLINEAR_MOTORS)
    outputs = value("setup", NONLINEAR_OUTPUTS)


class NonlinearState(KalmanCounters):
    """Counters, the estimates and their covariance; the state of each copy of the model follows."""

    fastest = cells("", "motion of the model in a sample, of late")
    payload = cells("", "estimated [kg]")
    angles = cells("outputs", "of the model at the filter's time")
    motion = cells("outputs", "of these in the last sample")
    slopes = cells("outputs", "of these over the payload [1/kg]")
    told = cells("2 * outputs", "disturbance of each output, then its timing error [samples]")
    P = cells("2 * outputs + 1, 2 * outputs + 1", "covariance of `told` and the payload")
    held = cells("motors", "set-points that came last")
    reached = cells("motors", "set-points that moved the model last: no faster than the drives take them")
    models = rest("states of the copies")


def nonlinear_settle(
    p: NonlinearArrays, free: np.ndarray, model: np.ndarray, motors: np.ndarray, angles: np.ndarray
) -> None:
    """Bring the model to its steady state under `motors`; fill its `angles`."""
    member_initialise(p, 0, free, model, np.zeros(int(p.setup[NONLINEAR_TOLD])))
    for _ in range(int(p.setup[NONLINEAR_SETTLE])):
        nonlinear_move(p, free, model, motors, angles)


def nonlinear_move(
    p: NonlinearArrays, free: np.ndarray, model: np.ndarray, motors: np.ndarray, angles: np.ndarray
) -> None:
    """Simulate the model for one sample under `motors` and fill its `angles`; `free` are its parameters."""
    u = np.empty(2 * p.motors + p.outputs)
    u[: p.motors] = motors
    u[p.motors :] = np.nan  # NaN: nothing is measured
    out = np.zeros(int(p.setup[NONLINEAR_TOLD]))
    member_step(p, 0, free, model, u, out)
    angles[:] = out[: p.outputs]


def nonlinear_slew(p: NonlinearArrays, reached: np.ndarray, motors: np.ndarray) -> None:
    """Move `reached`, the model's set-points, towards `motors` at the rate limit of the drives."""
    for j in range(p.motors):
        most = p.setup[NONLINEAR_SLEW + j]
        reached[j] += min(max(motors[j] - reached[j], -most), most)


def nonlinear_faster(p: NonlinearArrays, fastest: float, angles: np.ndarray, before: np.ndarray) -> float:
    """Return the recent motion: a maximum that decays, updated with the change over the last sample."""
    motion = p.setup[NONLINEAR_KEEP] * fastest
    for i in range(p.outputs):
        motion = max(motion, abs(angles[i] - before[i]))
    return motion


def nonlinear_widen(p: NonlinearArrays, parameters: np.ndarray, x: NonlinearState, before: np.ndarray) -> None:
    """Note the motion of a sample, and increase the covariance by its noise; `before`: angles before it."""
    m = p.outputs
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    for i in range(m):
        x.motion[i] = x.angles[i] - before[i]
        x.told[m + i] *= p.setup[NONLINEAR_TIMING_KEEP]
    walked = parameters[1] * parameters[1] + (parameters[2] * x.fastest) ** 2
    nonlinear_grow(x.P, m, 2 * m + 1, walked, p.setup[NONLINEAR_TIMING] ** 2, p.setup[NONLINEAR_TIMING_KEEP])


def nonlinear_grow(P: np.ndarray, m: int, n: int, walked: float, timing: float, keep: float) -> None:
    """Add a sample's noise: `walked` is the disturbances' variance, `timing` that of a timing error that fades."""
    for i in range(m):
        P[i * n + i] += walked
        for j in range(n):
            P[(m + i) * n + j] *= keep
            P[j * n + m + i] *= keep
        P[(m + i) * n + m + i] += (1.0 - keep * keep) * timing


def nonlinear_update(
    P: np.ndarray, told: np.ndarray, motion: np.ndarray, slopes: np.ndarray, missed: np.ndarray, noise: float
) -> tuple[float, float]:
    """Correct `told` (2 m or 2 m + 1,) and `P` by what the model `missed`; return the NIS and log det S.

    The outputs are taken one after the other, which is the same for a white sensor.
    """
    m, n = motion.shape[0], told.shape[0]
    innovation, log_det = 0.0, 0.0
    for i in range(m):
        h, Ph = np.zeros(n), np.zeros(n)
        h[i] = 1.0
        h[m + i] = motion[i]
        if n > 2 * m:
            h[2 * m] = slopes[i]
        for j in range(n):
            for k in range(n):
                Ph[j] += P[j * n + k] * h[k]
        S, e = noise * noise, missed[i]
        for j in range(n):
            S += h[j] * Ph[j]
            e -= h[j] * told[j]
        innovation += e * e / S
        log_det += math.log(S)
        for j in range(n):
            told[j] += Ph[j] / S * e
            for k in range(n):
                P[j * n + k] -= Ph[j] * Ph[k] / S
    return innovation, log_det


def nonlinear_correct(
    p: NonlinearArrays, noise: float, x: NonlinearState, measured: np.ndarray, forced: bool
) -> tuple[float, bool]:
    """Correct the estimates unless the gate rejects the measurement; return the NIS and whether it was accepted."""
    m = p.outputs
    # The payload's state is its error: that of the copies is subtracted.
    told, P = np.zeros(2 * m + 1), x.P.copy()
    told[: 2 * m] = x.told
    innovation, x.log_det = nonlinear_update(P, told, x.motion, x.slopes, measured - x.angles, noise)
    if not (forced or innovation <= p.constants[KALMAN_GATE]):
        return innovation, False
    x.told[:] = told[: 2 * m]
    x.P[:] = P
    x.payload = min(max(x.payload + told[2 * m], p.load[PAYLOAD_LEAST]), p.load[PAYLOAD_MOST])
    return innovation, True


def nonlinear_tell(
    p: NonlinearArrays,
    free: np.ndarray,
    model: np.ndarray,
    angles: np.ndarray,
    motion: np.ndarray,
    told: np.ndarray,
    reached: np.ndarray,
    motors: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Predict from the filter's time to now under the newest set-points; fill angles and rates.

    `model`, `angles`, `motion` (in the last sample) and `reached` are overwritten.
    """
    c, m = p.constants, p.outputs
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    before, earlier = np.empty(m), np.empty(m)
    for _ in range(whole + 1):
        before[:] = angles
        earlier[:] = motion
        nonlinear_slew(p, reached, motors)
        nonlinear_move(p, free, model, reached, angles)
        motion[:] = angles - before
    for i in range(m):
        # Linear interpolation between samples, of the motion in the last sample too; the rate is its slope.
        late = told[m + i] * (earlier[i] + part * (motion[i] - earlier[i]))
        outputs[i] = before[i] + part * motion[i] + told[i] + late
        outputs[m + i] = motion[i] / c[KALMAN_PERIOD]


def nonlinear_begin(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Start with motors at their set-points; nothing is known of what the model misses."""
    start, timing, m = p.setup[NONLINEAR_START], p.setup[NONLINEAR_TIMING], p.outputs
    for i in range(m):
        x.P[i, i] = start * start
        x.P[m + i, m + i] = timing * timing
    x.held[:] = asked
    x.reached[:] = asked


def nonlinear_reach(p: NonlinearArrays, x: NonlinearState, asked: np.ndarray) -> None:
    """Move the model's set-points for one sample."""
    if p.constants[KALMAN_LAG] > 0.5:
        nonlinear_slew(p, x.reached, x.held)
    else:
        nonlinear_slew(p, x.reached, asked)
    x.held[:] = asked


def nonlinear_judge(p: NonlinearArrays, noise: float, x: NonlinearState, inputs: np.ndarray) -> float:
    """Correct the estimates if there is a measurement that passes the gate; return the NIS."""
    measured = inputs[p.motors : p.motors + p.outputs]
    usable = kalman_usable(p.constants, x, measured, float(inputs[p.motors + p.outputs]), noise)
    forced = kalman_forced(p.constants, x)
    if forced:
        # Large enough for the estimate to jump to the measurement.
        start = p.setup[NONLINEAR_START]
        for i in range(p.outputs):
            x.P[i, i] += start * start
    innovation, accepted = 0.0, False
    if usable:
        innovation, accepted = nonlinear_correct(p, noise, x, measured, forced)
    kalman_count(p.constants, x, usable, accepted)
    return innovation


def nonlinear_answer(
    p: NonlinearArrays,
    noise: float,
    free: np.ndarray,
    x: NonlinearState,
    asked: np.ndarray,
    innovation: float,
    outputs: np.ndarray,
) -> None:
    """Fill the outputs that all forms have, and count the sample; `free`: the model's parameters in simulation."""
    models, m = x.models, p.outputs
    # Copies: the filter's model stays at the time of the measurement.
    nonlinear_tell(
        p,
        free,
        models[: member_size(p, 0)].copy(),
        x.angles.copy(),
        x.motion.copy(),
        x.told,
        x.reached.copy(),
        asked,
        outputs,
    )
    outputs[2 * m] = innovation
    outputs[2 * m + 1] = 1.0 if kalman_healthy(p.constants, x, noise) else 0.0
    x.samples += 1.0
