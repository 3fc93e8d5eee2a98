"""Motors that turn winches against springs, and outputs that follow them by weights and one lag.

The columns of `springs` describe the load of each motor; its drive is one row of `motion`, see the servo runtime.
"""

import math

import numpy as np

from softneck.drives.simulated._servo_runtime import SERVO_POWER, servo_read, servo_tick

SPRING_PER_AMPERE = 0  # torque at the winch [N m/A]
SPRING_REST = 1  # pull of the tendon at P = 0 [N m]
SPRING_STIFFNESS = 2  # [N m/rad]
SPRING_DRIVE = 3  # ten constants of its drive, in the order of `neck_drive`
SPRING_SIZE = 13
SPRING_CATCH = 0.2  # over which a loose tendon comes under tension [rad]


def springs_ticks(
    springs: np.ndarray,
    weights: np.ndarray,
    share: float,
    winches: np.ndarray,
    outputs: np.ndarray,
    motion: np.ndarray,
    ring: np.ndarray,
    ticks: int,
    h: float,
) -> None:
    """Advance drives, winches and outputs by `ticks` of `h` [s].

    `winches` (4, motors) are position [rad], speed [rad/s], pull [N m] and 1.0 if the tendon is taut; `outputs`
    (2, outputs) values and rates; `weights` (outputs, motors) the static gains, `share` the part of the remaining
    distance that the outputs move in a tick.
    """
    for _ in range(ticks):
        for i in range(winches.shape[1]):
            spring_advance(springs[i], winches, i, motion[i], ring[i], h)
        for k in range(outputs.shape[1]):
            end = 0.0
            for i in range(winches.shape[1]):
                end += weights[k, i] * winches[0, i]
            change = share * (end - outputs[0, k])
            outputs[0, k] += change
            outputs[1, k] = change / h
    for i in range(winches.shape[1]):
        servo_read(motion[i], winches[0, i], winches[1, i])


def spring_advance(s: np.ndarray, winches: np.ndarray, i: int, m: np.ndarray, ring: np.ndarray, h: float) -> None:
    """Advance winch `i` by one tick."""
    position = winches[0, i]
    speed = winches[1, i]
    d = s[SPRING_DRIVE:]
    drive = (d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7], d[8], d[9])
    torque = servo_tick(m, ring, position, speed, drive, s[SPRING_PER_AMPERE], h)
    pull = s[SPRING_REST] + s[SPRING_STIFFNESS] * position
    if winches[3, i] < 0.5:
        # A tendon that was never tightened is slack, and comes under tension on the last part of the way to zero.
        pull = s[SPRING_REST] * (1.0 + position / SPRING_CATCH)
        winches[3, i] = 1.0 if position >= -0.1 * SPRING_CATCH else 0.0
    pull = max(0.0, pull)  # a tendon only pulls
    winches[2, i] = pull
    if m[SERVO_POWER] < 0.5:
        winches[1, i] = 0.0  # the gear holds a winch without current
        return
    inertia = d[7]
    speed += h * (torque - pull) / inertia
    # Friction of the gear, implicitly: it brings to rest and never turns back.
    speed /= 1.0 + h * d[8] / (inertia * max(math.fabs(speed), d[9]))
    winches[1, i] = speed
    winches[0, i] = position + h * speed
