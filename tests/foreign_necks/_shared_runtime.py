"""What the foreign necks share: late set-points, load, where the platform leans, and what a sensor makes of it.

Bodies, tendons and drives are each plant's own. Everything is integrated by the semi-implicit Euler method: speeds
first, then positions with the new speeds (Hairer, Lubich and Wanner 2006, sec. I.1), at a fixed substep.
"""

import math

import numpy as np

from softneck.plant._geometry_runtime import tilt_rotation
from softneck.runtime._layout import Arrays, StateVector, array, cells, value
from softneck.runtime._random_runtime import random_normal, random_seed

FOREIGN_GRAVITY = 9.80665
# Kept of the past: enough for a latency of 0.1 s and a delay of 0.2 s at a sample time of 5 ms.
FOREIGN_SENT = 22
FOREIGN_SEEN = 42


class ForeignArrays(Arrays):
    """How a foreign neck is sampled."""

    setup = array("2", "sample time [s], substeps per sample")
    substeps = value("setup", 1)


class ForeignNumbers(StateVector):
    """A neck's parameters: those that all have; its own follow."""

    noise_seed = cells("1", "seed of the sensor's noise")
    position_limit = cells("1", "set-points are clamped to this [rad]")
    latency = cells("1", "from set-point to drive [s]")
    sensor_delay = cells("1", "transport delay of the sensor [s]")
    noise_std = cells("1", "white noise of the angles [rad]")
    rate_noise_std = cells("1", "white noise of the rates [rad/s]")
    noise_quantum = cells("1", "resolution of the angles, 0: exact [rad]")
    pretension = cells("1", "tension of each tendon after homing [N]")
    winch_radius = cells("1", "radius of the empty winch [m]")


class ForeignState(StateVector):
    """What drives and sensor keep of the past; the body follows."""

    random = cells("6", "generator of the sensor's noise")
    queue = cells("22, 3", "set-points, newest first [rad]")
    history = cells("42, 4", "angles and rates behind the filter, newest first [rad, rad/s]")
    seen = cells("4", "angles and rates as the sensor says them [rad, rad/s]")
    lean = cells("2", "true pitch and roll [rad]")
    filtered = cells("4", "filter of the angles and its rates [rad, rad/s]")
    position = cells("3", "of the motors [rad]")
    speed = cells("3", "of the motors [rad/s]")
    tension = cells("3", "at the winches [N]")
    free = cells("3", "unstretched lengths of the tendons at winch position zero [m]")
    travel = cells("", "way the motors have gone since they were cold [rad]")


def foreign_load(inputs: np.ndarray) -> tuple:
    """Return (payload [kg], vertical as the base sees it, push x and y [N], base rotation) of the eight inputs."""
    R = tilt_rotation(float(inputs[6]), float(inputs[7]))
    return max(float(inputs[3]), 0.0), (R[6], R[7], R[8]), float(inputs[4]), float(inputs[5]), R


def foreign_tilt(n1: float, n2: float, n3: float, R: tuple) -> tuple[float, float]:
    """Return true pitch and roll [rad] of a platform with normal n as the base sees it."""
    u = R[0] * n1 + R[1] * n2 + R[2] * n3
    v = R[3] * n1 + R[4] * n2 + R[5] * n3
    w = R[6] * n1 + R[7] * n2 + R[8] * n3
    return math.atan2(u, w), math.atan2(v, w)


def foreign_start(a: ForeignArrays, p: ForeignNumbers, x: ForeignState, pitch: float, roll: float) -> None:
    """Let the sensor have seen (`pitch`, `roll`) for ever."""
    random_seed(x.random, p.noise_seed[0])
    x.lean[0] = pitch
    x.lean[1] = roll
    x.filtered[0] = pitch
    x.filtered[1] = roll
    for i in range(FOREIGN_SEEN):
        x.history[i, 0] = pitch
        x.history[i, 1] = roll
    foreign_measure(a, p, x)


def foreign_enqueue(p: ForeignNumbers, x: ForeignState, inputs: np.ndarray) -> None:
    """Put the newest set-points in front of the queue."""
    for i in range(FOREIGN_SENT - 1, 0, -1):
        for j in range(3):
            x.queue[i, j] = x.queue[i - 1, j]
    for j in range(3):
        x.queue[0, j] = min(max(float(inputs[j]), -p.position_limit[0]), p.position_limit[0])


def foreign_age(a: ForeignArrays, p: ForeignNumbers, substep: int) -> int:
    """Return how many samples old the set-points are that have reached the drives by this substep."""
    late = p.latency[0] - substep * a.setup[0] / a.substeps
    # 1e-9: delays of whole samples are off by rounding only.
    return max(0, math.ceil(late / a.setup[0] - 1e-9))


def foreign_lag(x: ForeignState, pitch: float, roll: float, lag: float, h: float) -> None:
    """Advance an attitude filter of first order."""
    part = h / (lag + h)
    x.filtered[0] += part * (pitch - x.filtered[0])
    x.filtered[1] += part * (roll - x.filtered[1])


def foreign_resonant(x: ForeignState, pitch: float, roll: float, band: float, damping: float, h: float) -> None:
    """Advance an attitude filter of second order: bandwidth `band` [rad/s], `damping` [1]."""
    for j in range(2):
        wanted = pitch if j == 0 else roll
        force = band * band * (wanted - x.filtered[j])
        x.filtered[2 + j] = (x.filtered[2 + j] + h * force) / (1.0 + 2.0 * h * damping * band)
        x.filtered[j] += h * x.filtered[2 + j]


def foreign_sense(a: ForeignArrays, p: ForeignNumbers, x: ForeignState, pitch: float, roll: float) -> None:
    """Note where the platform leans at the end of a sample, and measure."""
    for i in range(FOREIGN_SEEN - 1, 0, -1):
        for j in range(4):
            x.history[i, j] = x.history[i - 1, j]
    x.history[0, 0] = x.filtered[0]
    x.history[0, 1] = x.filtered[1]
    # A gyro that integrates over its sample.
    x.history[0, 2] = (pitch - x.lean[0]) / a.setup[0]
    x.history[0, 3] = (roll - x.lean[1]) / a.setup[0]
    x.lean[0] = pitch
    x.lean[1] = roll
    foreign_measure(a, p, x)


def foreign_measure(a: ForeignArrays, p: ForeignNumbers, x: ForeignState) -> None:
    """Delay, spoil and round what the sensor sees."""
    steps = p.sensor_delay[0] / a.setup[0]
    whole = math.floor(steps + 1e-9)
    part = max(steps - whole, 0.0)
    for j in range(4):
        late = x.history[whole, j] + part * (x.history[whole + 1, j] - x.history[whole, j])
        spread = p.noise_std[0] if j < 2 else p.rate_noise_std[0]
        late += spread * random_normal(x.random)
        if j < 2 and p.noise_quantum[0] > 0.0:
            late = p.noise_quantum[0] * math.floor(late / p.noise_quantum[0] + 0.5)
        x.seen[j] = late


def foreign_outputs(x: ForeignState, compression: float, outputs: np.ndarray) -> None:
    """Fill the outputs in the virtual neck's order."""
    outputs[0] = x.lean[0]
    outputs[1] = x.lean[1]
    for j in range(4):
        outputs[2 + j] = x.seen[j]
    outputs[6] = 1.0
    for j in range(3):
        outputs[7 + j] = x.position[j]
        outputs[10 + j] = x.tension[j]
    outputs[13] = compression


def foreign_gimbal(theta: float, phi: float, q: tuple[float, float, float]) -> tuple:
    """Return where point `q` of a platform is that a gimbal turns by theta (pitch), then phi, and both derivatives.

    The position is Ry(theta) Rx(-phi) q: nine numbers, point, d/d theta, d/d phi.
    """
    ct = math.cos(theta)
    st = math.sin(theta)
    cp = math.cos(phi)
    sp = math.sin(phi)
    v = q[1] * cp + q[2] * sp
    w = q[2] * cp - q[1] * sp
    return (
        q[0] * ct + w * st, v, w * ct - q[0] * st,
        w * ct - q[0] * st, 0.0, -q[0] * ct - w * st,
        -v * st, w, -v * ct,
    )  # fmt: skip
