"""What both Kalman runtimes share: which measurements count, lines of past inputs, the step from filter time to now.

`arrays`: F (n, n), B (n, 2), H (2, n), unit covariances of the two process noises (n, n), P0 (n, n) of the start,
PF (n, n) added before a measurement is taken in by force, T (2, 3 or 2) from the sources to the two inputs, and the
constants whose places stand below.

The tail of the state, from its end: samples seen; rejections in a row; samples since an accepted measurement; samples
since a new measurement; the last measured pitch and roll; repetitions of them (-1: none came yet); running mean
square of what changes from one measurement to the next [rad^2]; log det of the last innovation covariance; the last
gyro rates.
"""

import math

import numpy as np

from softneck.runtime._compiled_runtime import COMPILED

KALMAN_LAG = 0  # and 1: samples that the inputs of the two axes need to act; parts of a sample are interpolated
KALMAN_GATE = 2  # largest normalised innovation squared
KALMAN_REJECTIONS = 3  # in a row, then the next measurement is taken in by force
KALMAN_TIMEOUT = 4  # samples without an accepted measurement until unhealthy
KALMAN_PERIOD = 5  # sample time [s]
KALMAN_LEAD = 6  # samples from the filter's time to now: how late measurements are
KALMAN_DIVIDER = 7  # samples of the filter per sample of the sensor
KALMAN_FROZEN = 8  # identical measurements that mean a frozen sensor; 0: never
KALMAN_GYRO = 9  # 1: the sources are the gyro's rates, 0: the set-points
KALMAN_GAP = 10  # what the angle may do unseen in a sample without gyro [rad]
KALMAN_CONSTANTS = 11
KALMAN_TAIL = 11
# Memory of the mean square: some 20 samples, as many as a frozen sensor needs to be told.
KALMAN_KEEP = 0.95
# A sensor that scatters by less than a tenth of its stated noise is a simulated one, and may well stand still.
KALMAN_STILL = 0.1


def kalman_line_length(c: np.ndarray) -> int:
    """Return how many past inputs each axis keeps."""
    return math.ceil(max(c[KALMAN_LAG], c[KALMAN_LAG + 1])) + 1


def kalman_clear(c: np.ndarray, state: np.ndarray) -> None:
    """Set the tail of a state that is zero: nothing came yet."""
    state[-3] = c[KALMAN_TIMEOUT]
    state[-7] = -1.0


def kalman_usable(c: np.ndarray, state: np.ndarray, inputs: np.ndarray, noise: float) -> bool:
    """Return whether `inputs` holds a new measurement of a sensor that lives.

    A slower sensor's sample is often held: within its period an unchanged value is the old one.
    """
    state[-4] += 1.0
    pitch, roll = inputs[3], inputs[4]
    if not (inputs[5] > 0.5 and math.isfinite(pitch) and math.isfinite(roll)):
        return False
    came = state[-7] >= 0.0
    same = came and pitch == state[-5] and roll == state[-6]
    if same and state[-4] < c[KALMAN_DIVIDER]:
        return False
    state[-4] = 0.0
    if same:
        state[-7] += 1.0
    else:
        if came:
            change = 0.5 * ((pitch - state[-5]) ** 2 + (roll - state[-6]) ** 2)
            state[-8] = KALMAN_KEEP * state[-8] + (1.0 - KALMAN_KEEP) * change
        state[-7] = 0.0
        state[-5] = pitch
        state[-6] = roll
    return not kalman_frozen(c, state, noise)


def kalman_frozen(c: np.ndarray, state: np.ndarray, noise: float) -> bool:
    """Return whether a sensor that used to scatter repeats itself to the last bit."""
    still = KALMAN_STILL * noise
    return bool(c[KALMAN_FROZEN] > 0.0 and state[-7] >= c[KALMAN_FROZEN] - 1.0 and state[-8] > still * still)


def kalman_push(
    arrays: tuple[np.ndarray, ...], state: np.ndarray, inputs: np.ndarray, length: int, u: np.ndarray
) -> bool:
    """Put what the sources say now into the lines, fill `u` (2,) with what acts; return whether a gyro said nothing."""
    T, c = arrays[7], arrays[8]
    lost = False
    if c[KALMAN_GYRO] > 0.5:
        p, r = inputs[6], inputs[7]
        # Behind an invalid measurement an unchanged rate is one that the plant holds.
        lost = not (math.isfinite(p) and math.isfinite(r))
        lost = lost or (inputs[5] < 0.5 and state[-1] > 0.0 and p == state[-10] and r == state[-11])
        if not lost:
            state[-10] = p
            state[-11] = r
        u[0] = T[0, 0] * state[-10] + T[0, 1] * state[-11]
        u[1] = T[1, 0] * state[-10] + T[1, 1] * state[-11]
    else:
        u[0] = T[0, 0] * inputs[0] + T[0, 1] * inputs[1] + T[0, 2] * inputs[2]
        u[1] = T[1, 0] * inputs[0] + T[1, 1] * inputs[1] + T[1, 2] * inputs[2]
    first = state.shape[0] - KALMAN_TAIL - 2 * length
    head = int(state[-1]) % length
    for axis in range(2):
        if state[-1] == 0.0:
            # Nothing is known of the past: the sources stood still.
            state[first + axis * length : first + (axis + 1) * length] = u[axis]
        state[first + axis * length + head] = u[axis]
        u[axis] = kalman_lagged(state, first + axis * length, length, head, c[KALMAN_LAG + axis])
    return lost


def kalman_lagged(state: np.ndarray, first: int, length: int, head: int, lag: float) -> float:
    """Return the input `lag` samples ago, between samples by a straight line; of the future the newest known."""
    if lag <= 0.0:
        return float(state[first + head])
    whole = int(lag)
    part = lag - whole
    value = state[first + (head - whole) % length]
    if part > 0.0:
        value = (1.0 - part) * value + part * state[first + (head - whole - 1) % length]
    return float(value)


def kalman_tell(
    arrays: tuple[np.ndarray, ...], state: np.ndarray, frozen: bool, length: int, outputs: np.ndarray
) -> None:
    """Carry the estimate from the filter's time to now; fill all outputs but the innovation."""
    F, B, H, c = arrays[0], arrays[1], arrays[2], arrays[8]
    first = state.shape[0] - KALMAN_TAIL - 2 * length
    head = int(state[-1]) % length
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    n = F.shape[0]
    x = state[:n]
    u = np.empty(2)
    y0, y1 = 0.0, 0.0
    for i in range(whole + 1):
        u[0] = kalman_lagged(state, first, length, head, c[KALMAN_LAG] - 1.0 - i)
        u[1] = kalman_lagged(state, first + length, length, head, c[KALMAN_LAG + 1] - 1.0 - i)
        if i == whole:
            y = kalman_dot(H, x)
            y0, y1 = y[0], y[1]
        x = kalman_ahead(F, x, B, u)
    y = kalman_dot(H, x)
    outputs[0] = y0 + part * (y[0] - y0)
    outputs[1] = y1 + part * (y[1] - y1)
    outputs[2] = (y[0] - y0) / c[KALMAN_PERIOD]
    outputs[3] = (y[1] - y1) / c[KALMAN_PERIOD]
    outputs[5] = 1.0 if state[-3] < c[KALMAN_TIMEOUT] and not frozen else 0.0


def kalman_count(c: np.ndarray, state: np.ndarray, judged: bool, accepted: bool) -> None:
    """Count rejections in a row and samples without an accepted measurement."""
    if judged:
        state[-2] = 0.0 if accepted else state[-2] + 1.0
    state[-3] = 0.0 if accepted else min(state[-3] + 1.0, c[KALMAN_TIMEOUT])


def kalman_dot(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x; compiled loops beat BLAS on matrices this small."""
    if not COMPILED:
        return np.dot(A, x)
    y = np.empty(A.shape[0])
    for i in range(A.shape[0]):
        y[i] = 0.0
        for j in range(A.shape[1]):
            y[i] += A[i, j] * x[j]
    return y


def kalman_ahead(F: np.ndarray, x: np.ndarray, B: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return F x + B u."""
    if not COMPILED:
        return np.dot(F, x) + np.dot(B, u)
    y = np.empty(F.shape[0])
    for i in range(F.shape[0]):
        y[i] = B[i, 0] * u[0] + B[i, 1] * u[1]
        for j in range(F.shape[1]):
            y[i] += F[i, j] * x[j]
    return y
