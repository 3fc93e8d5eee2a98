"""The virtual neck as a runtime: equilibrium at rest, one sample by classical Runge-Kutta."""

import math

import numpy as np

from softneck.plant._inclinometer_runtime import (
    inclinometer_delayed,
    inclinometer_dropout,
    inclinometer_measure,
    inclinometer_round,
    inclinometer_shown,
    inclinometer_start,
    inclinometer_store,
)
from softneck.plant._index_runtime import (
    NECK_DRIFT_STD,
    NECK_DRIFT_TIME,
    NECK_DRIVE_LATENCY,
    NECK_DROPOUT_RATE,
    NECK_DROPOUT_TIME,
    NECK_ENCODER_COUNTS,
    NECK_NOISE_QUANTUM,
    NECK_NOISE_SEED,
    NECK_NOISE_STD,
    NECK_POSITION_LIMIT,
    NECK_PRETENSION,
    NECK_RATE_BIAS_STD,
    NECK_RATE_NOISE_STD,
    NECK_SENSOR_DELAY,
    NECK_SENSOR_LAG,
    NECK_WINCH_RADIUS,
)
from softneck.plant._mechanics_runtime import (
    NeckBody,
    neck_constants,
    neck_lean,
    neck_load,
    neck_rates,
    neck_rest,
    neck_substeps,
    neck_tensions,
)
from softneck.runtime._layout import Arrays, array, cells, value
from softneck.runtime._random_runtime import random_seed

# Numbers of `setup`, in this order.
NECK_TS = 0
NECK_SUBSTEPS = 1
NECK_SENT = 2
NECK_SAMPLES = 3


class VirtualNeckArrays(Arrays):
    """How the neck is sampled; what it is made of are its parameters."""

    setup = array("1, 4", "sample time [s], substeps per sample, set-points kept, sensor samples kept")
    substeps = value("setup", 0, NECK_SUBSTEPS)
    sent = value("setup", 0, NECK_SENT)
    samples = value("setup", 0, NECK_SAMPLES)


class VirtualNeckState(NeckBody):
    """The body, and what drives and inclinometer keep of the past."""

    random = cells("6", "generator of the sensor's noise")
    noise = cells("9", "see `InclinometerNoise`")
    queue = cells("sent, 3", "set-points, newest first [rad]")
    history = cells("samples, 6", "see `InclinometerHistory`")


def initialise(p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, outputs: np.ndarray) -> None:
    """Fill `x` and `outputs` with the neck at rest: set-points zero, tendons at their pretension."""
    x[:] = 0.0
    c = neck_constants(parameters)
    x.b[0], x.b[1], x.s, x.free[0], x.free[1], x.free[2] = neck_rest(parameters, c)
    for i in range(3):
        # What a drive needs to hold its tendon's pretension.
        x.integral[i] = parameters[NECK_WINCH_RADIUS] * parameters[NECK_PRETENSION]
    # Payload, pushes and a tilted base are inputs: at t_0 there are none.
    load = neck_load(parameters, 0.0, 0.0, 0.0, 0.0, 0.0)
    lean = neck_lean(x, load)
    x.filtered[0] = lean[0]
    x.filtered[1] = lean[1]
    # As if the neck had always stood there: no delay shows an angle that never was.
    for _ in range(p.samples):
        inclinometer_store(x.history, (lean[0], lean[1], 0.0, 0.0, 0.0, 0.0))
    random_seed(x.random, parameters[NECK_NOISE_SEED])
    inclinometer_start(x.noise, x.random, parameters[NECK_DRIFT_STD], parameters[NECK_RATE_BIAS_STD])
    neck_measure(p, parameters, x)
    neck_outputs(parameters, x, c, load, outputs)


def step(
    p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    sample_time = float(p.setup[0, NECK_TS])
    neck_enqueue(x.queue, inputs, float(parameters[NECK_POSITION_LIMIT]))
    c = neck_constants(parameters)
    load = neck_load(
        parameters, float(inputs[3]), float(inputs[4]), float(inputs[5]), float(inputs[6]), float(inputs[7])
    )
    free = (float(x.free[0]), float(x.free[1]), float(x.free[2]))
    # In every step: the payload is an input, and moves the modes.
    count = neck_substeps(c, load, sample_time, p.substeps)
    h = sample_time / count
    latency = float(parameters[NECK_DRIVE_LATENCY])
    moving = neck_read(x)
    for i in range(count):
        # How many samples old the set-points are that have arrived by now; 1e-9 for delays of whole samples.
        age = max(0, math.ceil((latency - i * h) / sample_time - 1e-9))
        command = (float(x.queue[age, 0]), float(x.queue[age, 1]), float(x.queue[age, 2]))
        moving = neck_runge_kutta(moving, h, command, free, c, load)
    neck_write(x, moving)
    neck_sense(p, parameters, x, c, load, outputs)


def neck_sense(
    p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, c: tuple, load: tuple, outputs: np.ndarray
) -> None:
    """Let the inclinometer see where the neck is now, and fill `outputs`."""
    lean = neck_lean(x, load)
    lag = float(parameters[NECK_SENSOR_LAG])
    # The filter's own equation: with slopes, a delay between two samples is read off a cubic.
    slope1 = (lean[0] - x.filtered[0]) / lag
    slope2 = (lean[1] - x.filtered[1]) / lag
    inclinometer_store(x.history, (x.filtered[0], x.filtered[1], slope1, slope2, lean[2], lean[3]))
    neck_measure(p, parameters, x)
    neck_outputs(parameters, x, c, load, outputs)


def neck_enqueue(queue: np.ndarray, inputs: np.ndarray, limit: float) -> None:
    """Put the newest set-points, clamped to +-`limit`, in front of the queue."""
    for i in range(queue.shape[0] - 1, 2, -1):  # triples: [i - 3] is the same motor's
        queue[i] = queue[i - 3]
    for i in range(3):
        queue[i] = min(max(float(inputs[i]), -limit), limit)


def neck_measure(p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState) -> None:
    """Take one sensor sample: delay, noise, drift, quantisation, dropout."""
    sample_time = float(p.setup[0, NECK_TS])
    # A chain of two states: onsets at a rate, and mean length T of a dropout (geometric, so that ends = Ts / T).
    begins = 1.0 - math.exp(-sample_time * parameters[NECK_DROPOUT_RATE])
    ends = min(1.0, sample_time / parameters[NECK_DROPOUT_TIME])
    inclinometer_dropout(x.noise, x.random, begins, ends)
    # Exact for an Ornstein-Uhlenbeck process over one sample.
    keep = math.exp(-sample_time / parameters[NECK_DRIFT_TIME])
    settings = (
        float(parameters[NECK_DRIFT_STD]),
        keep,
        float(parameters[NECK_RATE_BIAS_STD]),
        keep,
        float(parameters[NECK_NOISE_STD]),
        float(parameters[NECK_RATE_NOISE_STD]),
        float(parameters[NECK_NOISE_QUANTUM]),
    )
    arrived = inclinometer_delayed(x.history, float(parameters[NECK_SENSOR_DELAY]), sample_time)
    inclinometer_measure(arrived, x.noise, x.random, settings)


def neck_outputs(parameters: np.ndarray, x: VirtualNeckState, c: tuple, load: tuple, outputs: np.ndarray) -> None:
    """Fill `outputs` from the state: truth, measurement, encoders, tensions, compression."""
    lean = neck_lean(x, load)
    outputs[0] = lean[0]
    outputs[1] = lean[1]
    outputs[2], outputs[3], outputs[4], outputs[5], outputs[6] = inclinometer_shown(x.noise)
    counts = float(parameters[NECK_ENCODER_COUNTS])
    # Only what is logged is in counts: the drives' loops see the position itself.
    quantum = 2.0 * math.pi / counts if counts > 0.0 else 0.0
    for i in range(3):
        outputs[7 + i] = inclinometer_round(float(x.position[i]), quantum)
    outputs[10], outputs[11], outputs[12] = neck_tensions(x, c)
    outputs[13] = x.s


def neck_read(x: NeckBody) -> tuple:
    """Return the 19 continuous states as a tuple of floats."""
    return (
        float(x.b[0]), float(x.b[1]), float(x.s), float(x.w[0]), float(x.w[1]), float(x.v), float(x.z[0]),
        float(x.z[1]), float(x.position[0]), float(x.position[1]), float(x.position[2]), float(x.speed[0]),
        float(x.speed[1]), float(x.speed[2]), float(x.integral[0]), float(x.integral[1]), float(x.integral[2]),
        float(x.filtered[0]), float(x.filtered[1]),
    )  # fmt: skip


def neck_write(x: NeckBody, moving: tuple) -> None:
    """Write the 19 continuous states back."""
    (
        x.b[0], x.b[1], x.s, x.w[0], x.w[1], x.v, x.z[0], x.z[1], x.position[0], x.position[1], x.position[2],
        x.speed[0], x.speed[1], x.speed[2], x.integral[0], x.integral[1], x.integral[2], x.filtered[0], x.filtered[1],
    ) = moving  # fmt: skip


def neck_along(x: tuple, k: tuple, h: float) -> tuple:
    """Return x + h k, entry by entry."""
    return (
        x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4],
        x[5] + h * k[5], x[6] + h * k[6], x[7] + h * k[7], x[8] + h * k[8], x[9] + h * k[9],
        x[10] + h * k[10], x[11] + h * k[11], x[12] + h * k[12], x[13] + h * k[13], x[14] + h * k[14],
        x[15] + h * k[15], x[16] + h * k[16], x[17] + h * k[17], x[18] + h * k[18],
    )  # fmt: skip


def neck_runge_kutta(
    x: tuple,
    h: float,
    command: tuple[float, float, float],
    free: tuple[float, float, float],
    c: tuple,
    load: tuple,
) -> tuple:
    """Return the continuous states `h` later by the classical method of order four."""
    k1 = neck_rates(x, command, free, c, load)
    k2 = neck_rates(neck_along(x, k1, 0.5 * h), command, free, c, load)
    k3 = neck_rates(neck_along(x, k2, 0.5 * h), command, free, c, load)
    k4 = neck_rates(neck_along(x, k3, h), command, free, c, load)
    # x + h/6 (k1 + k4) + h/3 (k2 + k3).
    middle = neck_along(k2, k3, 1.0)
    return neck_along(neck_along(x, neck_along(k1, k4, 1.0), h / 6.0), middle, h / 3.0)
