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
    neck_disturbed,
    neck_lean,
    neck_load,
    neck_rates,
    neck_rest,
    neck_substeps,
    neck_tensions,
)
from softneck.runtime._layout import Arrays, array, cells, value
from softneck.runtime._random_runtime import random_seed
from softneck.runtime._sizes_runtime import MOTORS, OUTPUTS

# Numbers of `setup`, in this order.
NECK_TS = 0
NECK_SUBSTEPS = 1
NECK_SENT = 2
NECK_SAMPLES = 3


def neck_motors(setup: np.ndarray) -> int:
    """Return the number of motors: a neck's three where none is said."""
    return int(setup[0, 4]) if setup.shape[1] > 4 else 3


class VirtualNeckArrays(Arrays):
    """Sampling of the neck; its physics are parameters."""

    setup = array(
        "1, numbers",
        "sample time [s], substeps a sample, set-points kept, sensor samples kept; motors and outputs, if not 3 and 2",
    )
    substeps = value("setup", 0, NECK_SUBSTEPS)
    sent = value("setup", 0, NECK_SENT)
    samples = value("setup", 0, NECK_SAMPLES)
    motors = value("setup", function=neck_motors, written=True)


class VirtualNeckState(NeckBody):
    """State of the body, and past values of drives and inclinometer."""

    random = cells("6", "generator of the sensor's noise")
    noise = cells("9", "see `InclinometerNoise`")
    queue = cells("sent, motors", "set-points, newest first [rad]")
    history = cells("samples, 6", "see `InclinometerHistory`")


def initialise(p: VirtualNeckArrays, parameters: np.ndarray, x: VirtualNeckState, outputs: np.ndarray) -> None:
    """Fill `x` and `outputs` with the neck at rest: set-points zero, tendons at their pretension."""
    x[:] = 0.0
    c = neck_constants(parameters)
    rest = neck_rest(parameters, c)
    x.b[0], x.b[1], x.s = rest[0], rest[1], rest[2]
    for i in range(MOTORS):
        x.free[i] = rest[3 + i]
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
    load = neck_disturbed(parameters, inputs[MOTORS:])
    free = neck_free(x)
    # In every step: the payload is an input, and moves the modes.
    count = neck_substeps(c, load, sample_time, p.substeps)
    h = sample_time / count
    latency = float(parameters[NECK_DRIVE_LATENCY])
    moving = neck_read(x)
    for i in range(count):
        # How many samples old the set-points are that have arrived by now; 1e-9 for delays of whole samples.
        age = max(0, math.ceil((latency - i * h) / sample_time - 1e-9))
        command = tuple(float(x.queue[age, j]) for j in range(MOTORS))
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
    for i in range(queue.shape[0] - 1, MOTORS - 1, -1):  # row by row: [i - MOTORS] is the same motor's
        queue[i] = queue[i - MOTORS]
    for i in range(MOTORS):
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
    shown = inclinometer_shown(x.noise)
    for axis in range(OUTPUTS):
        outputs[axis] = lean[axis]
        outputs[OUTPUTS + axis] = shown[axis]
        outputs[2 * OUTPUTS + axis] = shown[2 + axis]
    outputs[3 * OUTPUTS] = shown[4]
    counts = float(parameters[NECK_ENCODER_COUNTS])
    # Only what is logged is in counts: the drives' loops see the position itself.
    quantum = 2.0 * math.pi / counts if counts > 0.0 else 0.0
    tensions = neck_tensions(neck_read(x), neck_free(x), c)
    for i in range(MOTORS):
        outputs[3 * OUTPUTS + 1 + i] = inclinometer_round(float(x.position[i]), quantum)
        outputs[3 * OUTPUTS + 1 + MOTORS + i] = tensions[i]
    outputs[3 * OUTPUTS + 1 + 2 * MOTORS] = x.s


def neck_free(x: NeckBody) -> tuple:
    """Return the unstretched lengths of the tendons as a tuple of floats."""
    return tuple(float(x.free[j]) for j in range(MOTORS))


def neck_read(x: NeckBody) -> tuple:
    """Return the continuous states, the first of `x`, as a tuple of floats."""
    return tuple(float(x[i]) for i in range(10 + 3 * MOTORS))


def neck_write(x: NeckBody, moving: tuple) -> None:
    """Write the continuous states back."""
    for i in range(10 + 3 * MOTORS):
        x[i] = moving[i]


def neck_along(x: tuple, k: tuple, h: float) -> tuple:
    """Return x + h k, entry by entry."""
    return tuple(x[i] + h * k[i] for i in range(10 + 3 * MOTORS))


def neck_runge_kutta(x: tuple, h: float, command: tuple, free: tuple, c: tuple, load: tuple) -> tuple:
    """Return the continuous states `h` later by the classical method of order four."""
    k1 = neck_rates(x, command, free, c, load)
    k2 = neck_rates(neck_along(x, k1, 0.5 * h), command, free, c, load)
    k3 = neck_rates(neck_along(x, k2, 0.5 * h), command, free, c, load)
    k4 = neck_rates(neck_along(x, k3, h), command, free, c, load)
    # x + h/6 (k1 + k4) + h/3 (k2 + k3).
    middle = neck_along(k2, k3, 1.0)
    return neck_along(neck_along(x, neck_along(k1, k4, 1.0), h / 6.0), middle, h / 3.0)
