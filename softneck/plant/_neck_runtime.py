"""The virtual neck as a runtime: state vector, equilibrium at rest, one sample by classical Runge-Kutta.

State: 19 continuous numbers (bending and compression, their rates, hysteresis, positions, speeds and
integrals of the drives, attitude filter), the tendons' free lengths at rest, the random generator, the
sensor's noise, past set-points and past sensor samples.
`arrays[0]` is (sample time [s], substeps per sample, set-points kept, sensor samples kept).
"""

import math

import numpy as np

from softneck.plant._geometry_runtime import bend_functions, lean_angles
from softneck.plant._inclinometer_runtime import (
    INCLINOMETER_NOISE_SIZE,
    INCLINOMETER_SAMPLE_SIZE,
    inclinometer_delayed,
    inclinometer_dropout,
    inclinometer_measure,
    inclinometer_round,
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
    NECK_ODE_SIZE,
    neck_constants,
    neck_load,
    neck_rates,
    neck_rest,
    neck_substeps,
    neck_tensions,
)
from softneck.runtime._random_runtime import RANDOM_SIZE, random_seed

NECK_FREE = 19
NECK_RANDOM = 22
NECK_NOISE = 28
NECK_QUEUE = 37


def state_size(arrays: tuple[np.ndarray, ...]) -> int:
    """Return the length of the state vector."""
    return NECK_QUEUE + 3 * int(arrays[0][0, 2]) + INCLINOMETER_SAMPLE_SIZE * int(arrays[0][0, 3])


def initialise(arrays: tuple[np.ndarray, ...], parameters: np.ndarray, state: np.ndarray, outputs: np.ndarray) -> None:
    """Fill `state` and `outputs` with the neck at rest: set-points zero, tendons at their pretension."""
    setup = arrays[0][0]
    state[:] = 0.0
    c = neck_constants(parameters)
    b1, b2, s, free1, free2, free3 = neck_rest(parameters, c)
    state[0] = b1
    state[1] = b2
    state[2] = s
    for i in range(3):
        state[14 + i] = parameters[NECK_WINCH_RADIUS] * parameters[NECK_PRETENSION]
    state[NECK_FREE] = free1
    state[NECK_FREE + 1] = free2
    state[NECK_FREE + 2] = free3
    load = neck_load(parameters, 0.0, 0.0, 0.0, 0.0, 0.0)
    lean = lean_angles((b1, b2, 0.0, 0.0), bend_functions(b1 * b1 + b2 * b2), load[2])
    state[17] = lean[0]
    state[18] = lean[1]
    history = state[NECK_QUEUE + 3 * int(setup[2]) :]
    for _ in range(int(setup[3])):
        inclinometer_store(history, (lean[0], lean[1], 0.0, 0.0, 0.0, 0.0))
    generator = state[NECK_RANDOM : NECK_RANDOM + RANDOM_SIZE]
    random_seed(generator, parameters[NECK_NOISE_SEED])
    noise = state[NECK_NOISE : NECK_NOISE + INCLINOMETER_NOISE_SIZE]
    inclinometer_start(noise, generator, parameters[NECK_DRIFT_STD], parameters[NECK_RATE_BIAS_STD])
    neck_measure(setup, parameters, state)
    neck_outputs(parameters, state, c, load, outputs)


def step(
    arrays: tuple[np.ndarray, ...],
    parameters: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    outputs: np.ndarray,
) -> None:
    """Hold `inputs` for one sample time, integrate, measure."""
    setup = arrays[0][0]
    sample_time = float(setup[0])
    queue = state[NECK_QUEUE : NECK_QUEUE + 3 * int(setup[2])]
    neck_enqueue(queue, inputs, float(parameters[NECK_POSITION_LIMIT]))
    c = neck_constants(parameters)
    load = neck_load(
        parameters, float(inputs[3]), float(inputs[4]), float(inputs[5]), float(inputs[6]), float(inputs[7])
    )
    free = (float(state[NECK_FREE]), float(state[NECK_FREE + 1]), float(state[NECK_FREE + 2]))
    count = neck_substeps(c, load, sample_time, int(setup[1]))
    h = sample_time / count
    latency = float(parameters[NECK_DRIVE_LATENCY])
    x = neck_read(state)
    for i in range(count):
        age = 3 * max(0, math.ceil((latency - i * h) / sample_time - 1e-9))
        command = (float(queue[age]), float(queue[age + 1]), float(queue[age + 2]))
        x = neck_runge_kutta(x, h, command, free, c, load)
    neck_write(state, x)
    lean = lean_angles((x[0], x[1], x[3], x[4]), bend_functions(x[0] * x[0] + x[1] * x[1]), load[2])
    lag = float(parameters[NECK_SENSOR_LAG])
    history = state[NECK_QUEUE + 3 * int(setup[2]) :]
    slope1 = (lean[0] - x[17]) / lag
    slope2 = (lean[1] - x[18]) / lag
    inclinometer_store(history, (x[17], x[18], slope1, slope2, lean[2], lean[3]))
    neck_measure(setup, parameters, state)
    neck_outputs(parameters, state, c, load, outputs)


def neck_enqueue(queue: np.ndarray, inputs: np.ndarray, limit: float) -> None:
    """Put the newest set-points, clamped to +-`limit`, in front of the queue."""
    for i in range(queue.shape[0] - 1, 2, -1):
        queue[i] = queue[i - 3]
    for i in range(3):
        queue[i] = min(max(float(inputs[i]), -limit), limit)


def neck_measure(setup: np.ndarray, parameters: np.ndarray, state: np.ndarray) -> None:
    """Take one sensor sample: delay, noise, drift, quantisation, dropout."""
    sample_time = float(setup[0])
    generator = state[NECK_RANDOM : NECK_RANDOM + RANDOM_SIZE]
    noise = state[NECK_NOISE : NECK_NOISE + INCLINOMETER_NOISE_SIZE]
    history = state[NECK_QUEUE + 3 * int(setup[2]) :]
    begins = 1.0 - math.exp(-sample_time * parameters[NECK_DROPOUT_RATE])
    ends = min(1.0, sample_time / parameters[NECK_DROPOUT_TIME])
    inclinometer_dropout(noise, generator, begins, ends)
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
    arrived = inclinometer_delayed(history, float(parameters[NECK_SENSOR_DELAY]), sample_time)
    inclinometer_measure(arrived, noise, generator, settings)


def neck_outputs(
    parameters: np.ndarray,
    state: np.ndarray,
    c: tuple,
    load: tuple,
    outputs: np.ndarray,
) -> None:
    """Fill `outputs` from the state: truth, measurement, encoders, tensions, compression."""
    x = neck_read(state)
    lean = lean_angles((x[0], x[1], x[3], x[4]), bend_functions(x[0] * x[0] + x[1] * x[1]), load[2])
    outputs[0] = lean[0]
    outputs[1] = lean[1]
    for i in range(4):
        outputs[2 + i] = state[NECK_NOISE + 5 + i]
    outputs[6] = state[NECK_NOISE + 4]
    counts = float(parameters[NECK_ENCODER_COUNTS])
    quantum = 2.0 * math.pi / counts if counts > 0.0 else 0.0
    for i in range(3):
        outputs[7 + i] = inclinometer_round(float(state[8 + i]), quantum)
    free = (float(state[NECK_FREE]), float(state[NECK_FREE + 1]), float(state[NECK_FREE + 2]))
    tension1, tension2, tension3 = neck_tensions(x, free, c)
    outputs[10] = tension1
    outputs[11] = tension2
    outputs[12] = tension3
    outputs[13] = x[2]


def neck_read(state: np.ndarray) -> tuple:
    """Return the 19 continuous states as a tuple of floats."""
    return (
        float(state[0]), float(state[1]), float(state[2]), float(state[3]), float(state[4]), float(state[5]),
        float(state[6]), float(state[7]), float(state[8]), float(state[9]), float(state[10]),
        float(state[11]), float(state[12]), float(state[13]), float(state[14]), float(state[15]),
        float(state[16]), float(state[17]), float(state[18]),
    )  # fmt: skip


def neck_write(state: np.ndarray, x: tuple) -> None:
    """Write the 19 continuous states back."""
    for i in range(NECK_ODE_SIZE):
        state[i] = x[i]


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
    middle = neck_along(k2, k3, 1.0)
    return neck_along(neck_along(x, neck_along(k1, k4, 1.0), h / 6.0), middle, h / 3.0)
