"""The inclinometer behind its attitude filter: transport delay, noise, drift, quantisation, dropouts.

The filter itself (first order) is part of the neck's differential equation. Here its output is looked up
`delay` ago and spoilt. The memory is a list of past samples, newest first, of six numbers each: filtered
pitch and roll, their slopes, pitch rate and roll rate.
"""

import math

import numpy as np

from softneck.runtime._random_runtime import random_normal, random_uniform

# noise: bias of pitch, roll, pitch rate, roll rate; 1.0 while samples arrive; four held measurements.
INCLINOMETER_NOISE_SIZE = 9
INCLINOMETER_SAMPLE_SIZE = 6


def inclinometer_store(history: np.ndarray, sample: tuple[float, float, float, float, float, float]) -> None:
    """Put the newest `sample` in front of `history` (6 n,)."""
    for i in range(history.shape[0] - 1, INCLINOMETER_SAMPLE_SIZE - 1, -1):
        history[i] = history[i - INCLINOMETER_SAMPLE_SIZE]
    for i in range(INCLINOMETER_SAMPLE_SIZE):
        history[i] = sample[i]


def inclinometer_delayed(history: np.ndarray, delay: float, sample_time: float) -> tuple[float, float, float, float]:
    """Return (pitch, roll, pitch rate, roll rate) `delay` before the newest sample.

    Angles by cubic Hermite interpolation between samples, whose slopes are known; rates linearly.
    """
    steps = delay / sample_time
    whole = math.floor(steps + 1e-9)
    part = max(steps - whole, 0.0)
    new = INCLINOMETER_SAMPLE_SIZE * whole
    old = new + INCLINOMETER_SAMPLE_SIZE
    if part < 1e-9:
        return float(history[new]), float(history[new + 1]), float(history[new + 4]), float(history[new + 5])
    # t runs from the newer sample back to the older one; slopes change sign with it.
    h00 = (1.0 + 2.0 * part) * (1.0 - part) * (1.0 - part)
    h10 = part * (1.0 - part) * (1.0 - part) * -sample_time
    h01 = part * part * (3.0 - 2.0 * part)
    h11 = part * part * (part - 1.0) * -sample_time
    pitch = h00 * history[new] + h10 * history[new + 2] + h01 * history[old] + h11 * history[old + 2]
    roll = h00 * history[new + 1] + h10 * history[new + 3] + h01 * history[old + 1] + h11 * history[old + 3]
    pitch_rate = (1.0 - part) * history[new + 4] + part * history[old + 4]
    roll_rate = (1.0 - part) * history[new + 5] + part * history[old + 5]
    return float(pitch), float(roll), float(pitch_rate), float(roll_rate)


def inclinometer_start(noise: np.ndarray, generator: np.ndarray, drift: float, rate_bias: float) -> None:
    """Draw the biases at t_0 from their stationary distribution."""
    noise[0] = drift * random_normal(generator)
    noise[1] = drift * random_normal(generator)
    noise[2] = rate_bias * random_normal(generator)
    noise[3] = rate_bias * random_normal(generator)
    noise[4] = 1.0


def inclinometer_measure(
    truth: tuple[float, float, float, float],
    noise: np.ndarray,
    generator: np.ndarray,
    c: tuple[float, float, float, float, float, float, float],
) -> None:
    """Turn what arrives now into the held measurements `noise[5:9]`; `noise[4]` says whether it did.

    `c` is (drift std, drift's memory per sample, rate bias std, its memory, noise std, rate noise std,
    quantum). Biases are Ornstein-Uhlenbeck processes, sampled exactly. A lost sample draws as many random
    numbers as one that arrives, so dropouts do not change the noise of the others.
    """
    drift, keep, rate_bias, rate_keep, std, rate_std, quantum = c
    fresh = math.sqrt(max(0.0, 1.0 - keep * keep))
    rate_fresh = math.sqrt(max(0.0, 1.0 - rate_keep * rate_keep))
    noise[0] = keep * noise[0] + drift * fresh * random_normal(generator)
    noise[1] = keep * noise[1] + drift * fresh * random_normal(generator)
    noise[2] = rate_keep * noise[2] + rate_bias * rate_fresh * random_normal(generator)
    noise[3] = rate_keep * noise[3] + rate_bias * rate_fresh * random_normal(generator)
    white1 = std * random_normal(generator)
    white2 = std * random_normal(generator)
    white3 = rate_std * random_normal(generator)
    white4 = rate_std * random_normal(generator)
    if noise[4] < 0.5:
        return
    noise[5] = inclinometer_round(truth[0] + noise[0] + white1, quantum)
    noise[6] = inclinometer_round(truth[1] + noise[1] + white2, quantum)
    noise[7] = truth[2] + noise[2] + white3
    noise[8] = truth[3] + noise[3] + white4


def inclinometer_dropout(noise: np.ndarray, generator: np.ndarray, begins: float, ends: float) -> None:
    """Advance the dropout's two-state chain; `begins` and `ends` are chances per sample."""
    draw = random_uniform(generator)
    if noise[4] > 0.5:
        noise[4] = 0.0 if draw < begins else 1.0
    else:
        noise[4] = 1.0 if draw < ends else 0.0


def inclinometer_round(value: float, quantum: float) -> float:
    """Return `value` at the resolution `quantum`; 0 leaves it alone."""
    if quantum <= 0.0:
        return value
    return quantum * math.floor(value / quantum + 0.5)
