"""The inclinometer with its attitude filter: transport delay, noise, drift, quantisation, dropouts.

The filter itself (first order) is part of the neck's differential equation. Here its output is looked up
`delay` ago and spoilt.
"""

import math

import numpy as np

from softneck.runtime._layout import StateVector, cells
from softneck.runtime._random_runtime import random_normal, random_uniform

INCLINOMETER_SAMPLE_SIZE = 6


class InclinometerSample(StateVector):
    """Angles and rates at one instant."""

    angles = cells("2", "filtered pitch and roll [rad]")
    slopes = cells("2", "of these [rad/s]")
    rates = cells("2", "pitch rate and roll rate [rad/s]")


class InclinometerHistory(StateVector):
    """Past samples."""

    samples = cells("n, 6", "each an `InclinometerSample`, newest first")


class InclinometerNoise(StateVector):
    """Errors of the sensor and its last output."""

    bias = cells("2", "of pitch and roll [rad]")
    rate_bias = cells("2", "of pitch rate and roll rate [rad/s]")
    arrives = cells("", "1 while samples arrive")
    angles = cells("2", "held measurement of pitch and roll [rad]")
    rates = cells("2", "held measurement of their rates [rad/s]")


def inclinometer_store(history: np.ndarray, sample: tuple[float, float, float, float, float, float]) -> None:
    """Put the newest `sample` in front of `history` (6 n,)."""
    for i in range(history.shape[0] - 1, INCLINOMETER_SAMPLE_SIZE - 1, -1):
        history[i] = history[i - INCLINOMETER_SAMPLE_SIZE]
    for i in range(INCLINOMETER_SAMPLE_SIZE):
        history[i] = sample[i]


def inclinometer_delayed(
    history: InclinometerHistory, delay: float, sample_time: float
) -> tuple[float, float, float, float]:
    """Return (pitch, roll, pitch rate, roll rate) `delay` before the newest sample."""
    steps = delay / sample_time
    # A delay of so many samples may be off by rounding.
    whole = math.floor(steps + 1e-9)
    part = max(steps - whole, 0.0)
    return inclinometer_between(history.samples[whole], history.samples[whole + 1], part, sample_time)


def inclinometer_between(
    new: InclinometerSample, old: InclinometerSample, part: float, sample_time: float
) -> tuple[float, float, float, float]:
    """Return (pitch, roll, pitch rate, roll rate) `part` of the way from sample `new` back to `old`.

    Angles by cubic Hermite interpolation between samples, whose slopes are known; rates linearly.
    """
    if part < 1e-9:
        return float(new.angles[0]), float(new.angles[1]), float(new.rates[0]), float(new.rates[1])
    # Slopes change sign with the direction of time.
    h00 = (1.0 + 2.0 * part) * (1.0 - part) * (1.0 - part)
    h10 = part * (1.0 - part) * (1.0 - part) * -sample_time
    h01 = part * part * (3.0 - 2.0 * part)
    h11 = part * part * (part - 1.0) * -sample_time
    pitch = h00 * new.angles[0] + h10 * new.slopes[0] + h01 * old.angles[0] + h11 * old.slopes[0]
    roll = h00 * new.angles[1] + h10 * new.slopes[1] + h01 * old.angles[1] + h11 * old.slopes[1]
    pitch_rate = (1.0 - part) * new.rates[0] + part * old.rates[0]
    roll_rate = (1.0 - part) * new.rates[1] + part * old.rates[1]
    return float(pitch), float(roll), float(pitch_rate), float(roll_rate)


def inclinometer_start(noise: InclinometerNoise, generator: np.ndarray, drift: float, rate_bias: float) -> None:
    """Draw the biases at t_0 from their stationary distribution."""
    for axis in range(2):
        # Stationary from t_0 on: no start is better known than the rest.
        noise.bias[axis] = drift * random_normal(generator)
    for axis in range(2):
        noise.rate_bias[axis] = rate_bias * random_normal(generator)
    noise.arrives = 1.0


def inclinometer_measure(
    truth: tuple[float, float, float, float],
    noise: InclinometerNoise,
    generator: np.ndarray,
    c: tuple[float, float, float, float, float, float, float],
) -> None:
    """Update the held measurements with the sample that arrives now, if any.

    `c` is (drift std, drift's memory per sample, rate bias std, its memory, noise std, rate noise std,
    quantum). Biases are Ornstein-Uhlenbeck processes, sampled exactly. A lost sample draws as many random
    numbers as one that arrives, so dropouts do not change the noise of the others.
    """
    drift, keep, rate_bias, rate_keep, std, rate_std, quantum = c
    # keep^2 + fresh^2 = 1: the variance stays what it is, whatever the sample time.
    fresh = math.sqrt(max(0.0, 1.0 - keep * keep))
    rate_fresh = math.sqrt(max(0.0, 1.0 - rate_keep * rate_keep))
    for axis in range(2):
        noise.bias[axis] = keep * noise.bias[axis] + drift * fresh * random_normal(generator)
    for axis in range(2):
        noise.rate_bias[axis] = rate_keep * noise.rate_bias[axis] + rate_bias * rate_fresh * random_normal(generator)
    white1 = std * random_normal(generator)
    white2 = std * random_normal(generator)
    white3 = rate_std * random_normal(generator)
    white4 = rate_std * random_normal(generator)
    if noise.arrives < 0.5:
        return
    # Noise before rounding, as in a converter.
    noise.angles[0] = inclinometer_round(truth[0] + noise.bias[0] + white1, quantum)
    noise.angles[1] = inclinometer_round(truth[1] + noise.bias[1] + white2, quantum)
    noise.rates[0] = truth[2] + noise.rate_bias[0] + white3
    noise.rates[1] = truth[3] + noise.rate_bias[1] + white4


def inclinometer_dropout(noise: InclinometerNoise, generator: np.ndarray, begins: float, ends: float) -> None:
    """Advance the dropout's two-state chain; `begins` and `ends` are chances per sample."""
    # One draw in either state, so that the stream does not depend on it.
    draw = random_uniform(generator)
    if noise.arrives > 0.5:
        noise.arrives = 0.0 if draw < begins else 1.0
    else:
        noise.arrives = 1.0 if draw < ends else 0.0


def inclinometer_shown(noise: InclinometerNoise) -> tuple[float, float, float, float, float]:
    """Return the sensor's (pitch, roll, pitch rate, roll rate, whether they have arrived now)."""
    return noise.angles[0], noise.angles[1], noise.rates[0], noise.rates[1], noise.arrives


def inclinometer_round(value: float, quantum: float) -> float:
    """Return `value` at the resolution `quantum`; 0 leaves it alone."""
    if quantum <= 0.0:
        return value
    # Halves go up in plain Python, numba and C alike; `round` differs between them.
    return quantum * math.floor(value / quantum + 0.5)
