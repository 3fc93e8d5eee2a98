"""Shared by both Kalman runtimes: checks of measurements, delay lines of inputs, the prediction to the present."""

import math

import numpy as np

from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._products_runtime import add_product, product

# Places in `constants`.
KALMAN_LAG = 0  # and 1: samples that inputs of the first two axes need to act; parts of a sample are interpolated
KALMAN_GATE = 2  # largest normalised innovation squared
KALMAN_REJECTIONS = 3  # in a row, then the next measurement passes without the gate
KALMAN_TIMEOUT = 4  # samples without an accepted measurement, then unhealthy
KALMAN_PERIOD = 5  # sample time [s]
KALMAN_LEAD = 6  # samples from the filter's time to now: the delay of measurements
KALMAN_DIVIDER = 7  # samples of the filter per sample of the sensor
KALMAN_FROZEN = 8  # identical measurements that mean a frozen sensor; 0: never
KALMAN_GYRO = 9  # 1: the sources are the gyro's rates, 0: the set-points
KALMAN_GAP = 10  # standard deviation of an output's motion in a sample without gyro [rad]
KALMAN_MORE_LAGS = 11  # those of further axes
# Memory of the mean square: some 20 samples, as many as show a frozen sensor.
KALMAN_KEEP = 0.95
# A sensor with less than a tenth of its stated noise is simulated: equal values do not show that it is frozen.
KALMAN_STILL = 0.1


def kalman_line_length(c: np.ndarray) -> int:
    """Return how many past inputs each axis keeps."""
    # One sample more for a fractional lag: linear interpolation needs both ends.
    longest = max(c[KALMAN_LAG], c[KALMAN_LAG + 1])
    for i in range(KALMAN_MORE_LAGS, c.shape[0]):
        longest = max(longest, c[i])
    whole = int(longest)
    return whole + 2 if longest > whole else whole + 1


def kalman_lag(c: np.ndarray, axis: int) -> float:
    """Return the samples that the input of an axis needs to act."""
    return float(c[KALMAN_LAG + axis] if axis < 2 else c[KALMAN_MORE_LAGS - 2 + axis])


def kalman_outputs(H: np.ndarray) -> int:
    """Return the number of outputs."""
    return H.shape[0]


class KalmanArrays(Arrays):
    """x+ = F x + B u + w, y = H x + e, where w has the covariance q1^2 first_noise + q2^2 second_noise."""

    F = array("n, n", "state over one sample")
    B = array("n, outputs", "of the inputs of all axes")
    H = array("outputs, n", "from state to pitch and roll")
    first_noise = array("n, n", "unit covariance of the first process noise")
    second_noise = array("n, n", "unit covariance of the second")
    P0 = array("n, n", "covariance at the start")
    PF = array("n, n", "added before a measurement is taken in by force")
    sources = array("outputs, sources_in", "T: from the set-points, or the rates of the gyro, to the inputs")
    constants = array("numbers", "see KALMAN_*: 11, and one for each output beyond two")
    outputs = value("H", function=kalman_outputs, written=True)
    length = value("constants", function=kalman_line_length)


class KalmanCounters(StateVector):
    """The part of the state on the sensor, common to all filters."""

    samples = cells("", "seen so far")
    rejected = cells("", "measurements refused in a row")
    unheard = cells("", "samples since an accepted measurement, up to the timeout")
    age = cells("", "samples since a new measurement")
    repeats = cells("", "of the last measurement in a row; -1: none came yet")
    scatter = cells("", "mean square of what changes from one measurement to the next [rad^2]")
    log_det = cells("", "of the last innovation's covariance")
    measured = cells("outputs", "last [rad]")


class KalmanState(KalmanCounters):
    """Counters, the estimate, and past inputs."""

    rates = cells("outputs", "last of the gyro [rad/s]")
    x = cells("n", "estimate at the filter's time")
    lines = cells("outputs, length", "past inputs of each axis, in a ring: `samples` tells which is newest")


def kalman_clear(c: np.ndarray, x: KalmanCounters) -> None:
    """Set the counters of a zero state: there was no measurement yet."""
    x.unheard = c[KALMAN_TIMEOUT]
    x.repeats = -1.0


def kalman_usable(c: np.ndarray, x: KalmanCounters, y: np.ndarray, valid: float, noise: float) -> bool:
    """Return whether the outputs `y` are a new measurement of a working sensor.

    A slower sensor's sample is often held: an unchanged value within its period is the old one.
    """
    x.age += 1.0
    m = y.shape[0]
    # A measurement has all outputs; NaN counts as invalid.
    if not valid > 0.5:
        return False
    came = bool(x.repeats >= 0.0)
    same = came
    for i in range(m):
        if not math.isfinite(y[i]):
            return False
        same = same and bool(y[i] == x.measured[i])
    if same and x.age < c[KALMAN_DIVIDER]:
        return False
    x.age = 0.0
    if same:
        x.repeats += 1.0
    else:
        if came:
            # Mean over the outputs; at rest it is twice the noise's variance.
            change = 0.0
            for i in range(m):
                change += (y[i] - x.measured[i]) ** 2
            x.scatter = KALMAN_KEEP * x.scatter + (1.0 - KALMAN_KEEP) * (change / m)
        x.repeats = 0.0
        for i in range(m):
            x.measured[i] = y[i]
    return not kalman_frozen(c, x, noise)


def kalman_frozen(c: np.ndarray, x: KalmanCounters, noise: float) -> bool:
    """Return whether a noisy sensor repeats exactly the same values."""
    still = KALMAN_STILL * noise
    # `repeats` does not count the first of equal ones, hence the - 1.
    return bool(c[KALMAN_FROZEN] > 0.0 and x.repeats >= c[KALMAN_FROZEN] - 1.0 and x.scatter > still * still)


def kalman_forced(c: np.ndarray, x: KalmanCounters) -> bool:
    """Return whether the next measurement passes without the gate, after too many rejections."""
    return bool(x.rejected >= c[KALMAN_REJECTIONS])


def kalman_count(c: np.ndarray, x: KalmanCounters, judged: bool, accepted: bool) -> None:
    """Count rejections in a row and samples without an accepted measurement."""
    # A missing measurement is not a rejection.
    if judged:
        x.rejected = 0.0 if accepted else x.rejected + 1.0
    x.unheard = 0.0 if accepted else min(x.unheard + 1.0, c[KALMAN_TIMEOUT])


def kalman_healthy(c: np.ndarray, x: KalmanCounters, noise: float) -> bool:
    """Return whether a measurement of a working sensor was accepted in time."""
    return bool(x.unheard < c[KALMAN_TIMEOUT] and not kalman_frozen(c, x, noise))


def kalman_first(p: KalmanArrays, inputs: np.ndarray) -> int:
    """Return the index of the first measured output among the inputs, after the set-points."""
    behind = 2 * p.outputs + 1 if p.constants[KALMAN_GYRO] > 0.5 else p.outputs + 1
    return inputs.shape[0] - behind


def kalman_push(p: KalmanArrays, x: KalmanState, inputs: np.ndarray, u: np.ndarray) -> bool:
    """Push the inputs into the delay lines, fill `u` with the delayed ones; return whether a gyro rate is missing."""
    T, c = p.sources, p.constants
    lost = False
    if c[KALMAN_GYRO] > 0.5:
        valid = kalman_first(p, inputs) + p.outputs
        held = True
        for i in range(p.outputs):
            rate = inputs[valid + 1 + i]
            lost = lost or not math.isfinite(rate)
            held = held and bool(rate == x.rates[i])
        # With an invalid measurement, an unchanged rate is an old one that is held.
        lost = lost or bool(not inputs[valid] > 0.5 and x.samples > 0.0 and held)
        if not lost:
            x.rates[:] = inputs[valid + 1 :]
        # Missing rates leave the last ones; `step` increases P for the angle's motion in between.
        for i in range(p.outputs):
            u[i] = kalman_row(T, i, x.rates)
    else:
        for i in range(p.outputs):
            # Eq. 9 and 10.
            u[i] = kalman_row(T, i, inputs)
    newest = int(x.samples) % p.length
    for axis in range(p.outputs):
        line = x.lines[axis]
        if x.samples == 0.0:
            # The past is unknown: the inputs were constant.
            line[:] = u[axis]
        line[newest] = u[axis]
        u[axis] = kalman_lagged(line, newest, kalman_lag(c, axis))
    return lost


def kalman_row(T: np.ndarray, i: int, u: np.ndarray) -> float:
    """Return row `i` of T u, of as many entries of `u` as T takes."""
    total = 0.0
    for j in range(T.shape[1]):
        total += T[i, j] * u[j]
    return total


def kalman_lagged(line: np.ndarray, newest: int, lag: float) -> float:
    """Return the input `lag` samples ago, interpolated linearly; the newest one for a negative lag."""
    if lag <= 0.0:
        return float(line[newest])
    whole = int(lag)
    part = lag - whole
    # A ring buffer: older samples are before the newest, with wrap-around.
    value = line[(newest - whole) % line.shape[0]]
    if part > 0.0:
        value = (1.0 - part) * value + part * line[(newest - whole - 1) % line.shape[0]]
    return float(value)


def kalman_tell(p: KalmanArrays, x: KalmanState, noise: float, outputs: np.ndarray) -> None:
    """Predict from the filter's time to now; fill all outputs but the innovation."""
    F, B, H, c = p.F, p.B, p.H, p.constants
    m = p.outputs
    newest = int(x.samples) % p.length
    whole = int(c[KALMAN_LEAD])
    part = c[KALMAN_LEAD] - whole
    now = x.x
    u, before = np.empty(m), np.empty(m)
    for i in range(whole + 1):
        # The input from i to i + 1 samples after the filter's time: newer by i + 1 than the last one.
        for axis in range(m):
            u[axis] = kalman_lagged(x.lines[axis], newest, kalman_lag(c, axis) - 1.0 - i)
        if i == whole:
            before[:] = product(H, now)
        now = product(F, now)
        add_product(B, u, now)
    y = product(H, now)
    for axis in range(m):
        # Linear interpolation between samples; the rate is its slope.
        outputs[axis] = before[axis] + part * (y[axis] - before[axis])
        # The model's rate over that sample, not a difference of noisy estimates.
        outputs[m + axis] = (y[axis] - before[axis]) / c[KALMAN_PERIOD]
    outputs[2 * m + 1] = 1.0 if kalman_healthy(c, x, noise) else 0.0
