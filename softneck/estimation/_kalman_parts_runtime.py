"""What both Kalman runtimes share: which measurements count, lines of past inputs, the step from filter time to now."""

import math

import numpy as np

from softneck.runtime._compiled_runtime import COMPILED
from softneck.runtime._layout import Arrays, StateVector, array, cells, value

# Places in `constants`.
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
# Memory of the mean square: some 20 samples, as many as a frozen sensor needs to be told.
KALMAN_KEEP = 0.95
# A sensor that scatters by less than a tenth of its stated noise is a simulated one, and may well stand still.
KALMAN_STILL = 0.1


def kalman_line_length(c: np.ndarray) -> int:
    """Return how many past inputs each axis keeps."""
    # One sample more where a lag lies between two: a straight line needs both ends.
    longest = max(c[KALMAN_LAG], c[KALMAN_LAG + 1])
    whole = int(longest)
    return whole + 2 if longest > whole else whole + 1


class KalmanArrays(Arrays):
    """x+ = F x + B u + w, y = H x + e, where w has the covariance q1^2 first_noise + q2^2 second_noise."""

    F = array("n, n", "state over one sample")
    B = array("n, 2", "of the inputs of both axes")
    H = array("2, n", "from state to pitch and roll")
    first_noise = array("n, n", "unit covariance of the first process noise")
    second_noise = array("n, n", "unit covariance of the second")
    P0 = array("n, n", "covariance at the start")
    PF = array("n, n", "added before a measurement is taken in by force")
    sources = array("2, sources_in", "T: from three set-points, or two rates of the gyro, to the inputs")
    constants = array("11", "see KALMAN_*")
    length = value("constants", function=kalman_line_length)


class KalmanCounters(StateVector):
    """What a filter remembers of its sensor, whatever it knows of the neck."""

    samples = cells("", "seen so far")
    rejected = cells("", "measurements refused in a row")
    unheard = cells("", "samples since an accepted measurement, up to the timeout")
    age = cells("", "samples since a new measurement")
    pitch = cells("", "last measured [rad]")
    roll = cells("", "last measured [rad]")
    repeats = cells("", "of the last measurement in a row; -1: none came yet")
    scatter = cells("", "mean square of what changes from one measurement to the next [rad^2]")
    log_det = cells("", "of the last innovation's covariance")
    rates = cells("2", "last of the gyro [rad/s]")


class KalmanState(KalmanCounters):
    """Counters, the estimate, and what the sources said."""

    x = cells("n", "estimate at the filter's time")
    lines = cells("2, length", "past inputs of each axis, in a ring: `samples` tells which is newest")


def kalman_clear(c: np.ndarray, x: KalmanCounters) -> None:
    """Set the counters of a state that is zero: nothing came yet."""
    x.unheard = c[KALMAN_TIMEOUT]
    x.repeats = -1.0


def kalman_usable(c: np.ndarray, x: KalmanCounters, inputs: np.ndarray, noise: float) -> bool:
    """Return whether `inputs` holds a new measurement of a sensor that lives.

    A slower sensor's sample is often held: within its period an unchanged value is the old one.
    """
    x.age += 1.0
    pitch, roll = inputs[3], inputs[4]
    # A measurement is of both axes; a sensor that says NaN is as good as one that says invalid.
    if not (inputs[5] > 0.5 and math.isfinite(pitch) and math.isfinite(roll)):
        return False
    came = x.repeats >= 0.0
    same = came and pitch == x.pitch and roll == x.roll
    if same and x.age < c[KALMAN_DIVIDER]:
        return False
    x.age = 0.0
    if same:
        x.repeats += 1.0
    else:
        if came:
            # Mean of both axes; of a neck that stands still it is twice the noise's variance.
            change = 0.5 * ((pitch - x.pitch) ** 2 + (roll - x.roll) ** 2)
            x.scatter = KALMAN_KEEP * x.scatter + (1.0 - KALMAN_KEEP) * change
        x.repeats = 0.0
        x.pitch = pitch
        x.roll = roll
    return not kalman_frozen(c, x, noise)


def kalman_frozen(c: np.ndarray, x: KalmanCounters, noise: float) -> bool:
    """Return whether a sensor that used to scatter repeats itself to the last bit."""
    still = KALMAN_STILL * noise
    # `repeats` does not count the first of equal ones, hence the - 1.
    return bool(c[KALMAN_FROZEN] > 0.0 and x.repeats >= c[KALMAN_FROZEN] - 1.0 and x.scatter > still * still)


def kalman_forced(c: np.ndarray, x: KalmanCounters) -> bool:
    """Return whether so many measurements were refused that the next is taken in whatever it says."""
    return bool(x.rejected >= c[KALMAN_REJECTIONS])


def kalman_count(c: np.ndarray, x: KalmanCounters, judged: bool, accepted: bool) -> None:
    """Count rejections in a row and samples without an accepted measurement."""
    # No measurement is no refusal: a gap in the data forces nothing.
    if judged:
        x.rejected = 0.0 if accepted else x.rejected + 1.0
    x.unheard = 0.0 if accepted else min(x.unheard + 1.0, c[KALMAN_TIMEOUT])


def kalman_healthy(c: np.ndarray, x: KalmanCounters, noise: float) -> bool:
    """Return whether a measurement was accepted in time, of a sensor that lives."""
    return bool(x.unheard < c[KALMAN_TIMEOUT] and not kalman_frozen(c, x, noise))


def kalman_push(p: KalmanArrays, x: KalmanState, inputs: np.ndarray, u: np.ndarray) -> bool:
    """Put what the sources say now into the lines, fill `u` (2,) with what acts; return whether a gyro said nothing."""
    T, c = p.sources, p.constants
    lost = False
    if c[KALMAN_GYRO] > 0.5:
        pitch, roll = inputs[6], inputs[7]
        # Behind an invalid measurement an unchanged rate is one that the plant holds.
        lost = not (math.isfinite(pitch) and math.isfinite(roll))
        lost = lost or (inputs[5] < 0.5 and x.samples > 0.0 and pitch == x.rates[0] and roll == x.rates[1])
        if not lost:
            x.rates[0] = pitch
            x.rates[1] = roll
        # Lost rates leave the last ones; `step` widens P by what the angle may do meanwhile.
        u[0] = T[0, 0] * x.rates[0] + T[0, 1] * x.rates[1]
        u[1] = T[1, 0] * x.rates[0] + T[1, 1] * x.rates[1]
    else:
        # Eq. 9 and 10; the kinematic form has zeros here.
        u[0] = T[0, 0] * inputs[0] + T[0, 1] * inputs[1] + T[0, 2] * inputs[2]
        u[1] = T[1, 0] * inputs[0] + T[1, 1] * inputs[1] + T[1, 2] * inputs[2]
    newest = int(x.samples) % p.length
    for axis in range(2):
        line = x.lines[axis]
        if x.samples == 0.0:
            # Nothing is known of the past: the sources stood still.
            line[:] = u[axis]
        line[newest] = u[axis]
        u[axis] = kalman_lagged(line, newest, c[KALMAN_LAG + axis])
    return lost


def kalman_lagged(line: np.ndarray, newest: int, lag: float) -> float:
    """Return the input `lag` samples ago, between samples by a straight line; of the future the newest known."""
    if lag <= 0.0:
        return float(line[newest])
    whole = int(lag)
    part = lag - whole
    # A ring: what is older than the newest stands before it, round the end.
    value = line[(newest - whole) % line.shape[0]]
    if part > 0.0:
        value = (1.0 - part) * value + part * line[(newest - whole - 1) % line.shape[0]]
    return float(value)


def kalman_tell(p: KalmanArrays, x: KalmanState, noise: float, outputs: np.ndarray) -> None:
    """Carry the estimate from the filter's time to now; fill all outputs but the innovation."""
    F, B, H, c = p.F, p.B, p.H, p.constants
    newest = int(x.samples) % p.length
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    now, first, second = x.x, x.lines[0], x.lines[1]
    u = np.empty(2)
    y0, y1 = 0.0, 0.0
    for i in range(whole + 1):
        # What carries the estimate from i samples after its time to i + 1: newer by i + 1 than the last that acted.
        u[0] = kalman_lagged(first, newest, c[KALMAN_LAG] - 1.0 - i)
        u[1] = kalman_lagged(second, newest, c[KALMAN_LAG + 1] - 1.0 - i)
        if i == whole:
            y = kalman_dot(H, now)
            y0, y1 = y[0], y[1]
        now = kalman_ahead(F, now, B, u)
    y = kalman_dot(H, now)
    # Between samples by a straight line, whose slope is the rate.
    outputs[0] = y0 + part * (y[0] - y0)
    outputs[1] = y1 + part * (y[1] - y1)
    # The model's own rate over that sample, not a difference of noisy estimates.
    outputs[2] = (y[0] - y0) / c[KALMAN_PERIOD]
    outputs[3] = (y[1] - y1) / c[KALMAN_PERIOD]
    outputs[5] = 1.0 if kalman_healthy(c, x, noise) else 0.0


def kalman_dot(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return A x; compiled loops beat BLAS on matrices this small."""
    if not COMPILED:
        return np.dot(A, x)
    y = np.empty(A.shape[0])
    for i in range(A.shape[0]):
        total = 0.0
        for j in range(A.shape[1]):
            total += A[i, j] * x[j]
        y[i] = total
    return y


def kalman_ahead(F: np.ndarray, x: np.ndarray, B: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return F x + B u."""
    if not COMPILED:
        return np.dot(F, x) + np.dot(B, u)
    y = np.empty(F.shape[0])
    for i in range(F.shape[0]):
        total = B[i, 0] * u[0] + B[i, 1] * u[1]
        for j in range(F.shape[1]):
            total += F[i, j] * x[j]
        y[i] = total
    return y
