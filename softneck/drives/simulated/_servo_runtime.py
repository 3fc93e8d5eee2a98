"""Motion of the simulated drives on the virtual neck: generators, limits, position and speed loops.

One row of `motion` per drive, in encoder counts of the drive (its own sign), seconds, amperes:
see SERVO_* for the columns. `ring` (motors, n) holds past demands, for the latency of the cyclic mode.
"""

import math

import numpy as np

from softneck.plant._index_runtime import NECK_GEAR_EFFICIENCY, NECK_GEAR_RATIO, NECK_TORQUE_CONSTANT
from softneck.plant._mechanics_runtime import NeckBody, neck_constants, neck_disturbed, neck_substeps
from softneck.plant._neck_runtime import neck_read, neck_write
from softneck.plant._winch_runtime import winch_advance, winch_constants, winch_motion
from softneck.plant._winch_runtime import winch_sense as winch_sense
from softneck.runtime._sizes_runtime import MOTORS

SERVO_POWER = 0  # 1.0: the loops are closed; 0.0: no current
SERVO_MODE = 1  # 0 stop with SERVO_DECELERATION, 1 profile position, 3 profile velocity, 8 cyclic position
SERVO_TARGET = 2  # position [counts]
SERVO_TARGET_SPEED = 3  # mode 3 [counts/s]
SERVO_SPEED = 4  # profile speed of mode 1 [counts/s]
SERVO_ACCELERATION = 5  # [counts/s^2]
SERVO_DECELERATION = 6  # [counts/s^2]
SERVO_DEMAND = 7  # generated position [counts]
SERVO_DEMAND_SPEED = 8  # [counts/s]
SERVO_SLOPE = 9  # cyclic mode: counts per tick
SERVO_LEFT = 10  # cyclic mode: ticks until the target is reached
SERVO_LOW = 11  # software limits [counts]; none where SERVO_LOW >= SERVO_HIGH
SERVO_HIGH = 12
SERVO_AT_LIMIT = 13  # out: -1, 0, 1
SERVO_CURRENT_LIMIT = 14  # [A]
SERVO_INTEGRAL = 15  # of the speed loop [N m]
SERVO_WINDOW = 16  # following error [counts]; 0: not watched
SERVO_TIMEOUT = 17  # [s]
SERVO_LATE = 18  # time beyond the window so far [s]
SERVO_TRIPPED = 19  # out: 1.0 once the window was left for longer than the time-out
SERVO_SCALE = 20  # counts per radian of the winch, with sign
SERVO_ZERO = 21  # counts at the winch's own zero
SERVO_LAG = 22  # latency of the cyclic mode [ticks]
SERVO_PLACE = 23  # of the newest demand in the ring
SERVO_POSITION = 24  # out: encoder [counts]
SERVO_ACTUAL_SPEED = 25  # out: [counts/s]
SERVO_CURRENT = 26  # out: of the motor [A]
SERVO_STUCK = 27  # 1.0: the winch is blocked
SERVO_GEARING = 28  # torque of the drive's own gear by that of the neck's
SERVO_SIZE = 29


def servo_ticks(
    parameters: np.ndarray,
    x: NeckBody,
    disturbance: np.ndarray,
    motion: np.ndarray,
    ring: np.ndarray,
    ticks: int,
    h: float,
) -> None:
    """Advance drives and neck by `ticks` of `h` [s]."""
    c = neck_constants(parameters)
    load = neck_disturbed(parameters, disturbance)
    free = tuple(float(x.free[j]) for j in range(MOTORS))
    passive = winch_constants(c)
    # As many Runge-Kutta steps as the neck needs within a tick.
    count = neck_substeps(c, load, h, 1)
    per_ampere = float(
        parameters[NECK_TORQUE_CONSTANT] * parameters[NECK_GEAR_RATIO] * parameters[NECK_GEAR_EFFICIENCY]
    )
    moving = neck_read(x)
    for _ in range(ticks):
        position, speed = winch_motion(moving)
        torques = tuple(
            servo_tick(motion[j], ring[j], position[j], speed[j], c[5], per_ampere, h) for j in range(MOTORS)
        )
        moving = winch_advance(moving, torques, free, passive, load, h, count)
    neck_write(x, moving)
    for i in range(MOTORS):
        servo_read(motion[i], x.position[i], x.speed[i])


def servo_read(m: np.ndarray, position: float, speed: float) -> None:
    """Fill the measurements of the drive."""
    m[SERVO_POSITION] = math.floor(m[SERVO_SCALE] * position + m[SERVO_ZERO] + 0.5)
    m[SERVO_ACTUAL_SPEED] = m[SERVO_SCALE] * speed


def servo_tick(
    m: np.ndarray, ring: np.ndarray, position: float, speed: float, drive: tuple, per_ampere: float, h: float
) -> float:
    """Return the torque at the winch [N m] over the next tick; `position` [rad] and `speed` [rad/s] are the winch's."""
    counts = m[SERVO_SCALE] * position + m[SERVO_ZERO]
    # Without power the demand follows the winch, so that switching on starts at its position.
    if m[SERVO_POWER] < 0.5:
        m[SERVO_DEMAND] = counts
        m[SERVO_DEMAND_SPEED] = 0.0
        m[SERVO_INTEGRAL] = 0.0
        m[SERVO_CURRENT] = 0.0
        m[SERVO_LATE] = 0.0
        m[SERVO_LEFT] = 0.0
        m[SERVO_AT_LIMIT] = 0.0
        ring[:] = counts  # and no old demand is pending
        return 0.0
    servo_generate(m, h)
    servo_limit(m)
    place = int(m[SERVO_PLACE]) + 1
    if place >= ring.shape[0]:
        place = 0
    m[SERVO_PLACE] = place
    ring[place] = m[SERVO_DEMAND]
    # Only the bus has latency: profiles are generated in the drive.
    demand = ring[place - int(m[SERVO_LAG])] if m[SERVO_MODE] == 8.0 else m[SERVO_DEMAND]
    servo_follow(m, demand - counts, h)
    gain, speed_limit, bandwidth, reset, _, supply, back_emf, inertia, _, _ = drive
    pull = per_ampere * m[SERVO_GEARING]
    # Counts have the drive's sign, the neck radians: the scale takes both over.
    wanted = min(max(gain * (demand - counts) / m[SERVO_SCALE], -speed_limit), speed_limit)
    error = inertia * bandwidth * (wanted - speed)
    asked = error + m[SERVO_INTEGRAL]
    most = m[SERVO_CURRENT_LIMIT] * pull  # the limit set in the drive, not the neck's own
    if m[SERVO_STUCK] > 0.5:
        # A blocked winch is held in place by a force stronger than the motor.
        m[SERVO_CURRENT] = math.copysign(m[SERVO_CURRENT_LIMIT], demand - counts)
        # That force: a PI controller for zero speed, without limit.
        m[SERVO_INTEGRAL] += -h * reset * inertia * bandwidth * speed
        return m[SERVO_INTEGRAL] - inertia * bandwidth * speed
    high = min(most, supply - back_emf * speed)
    low = max(-most, -supply - back_emf * speed)
    # Anti-windup, as in `drive_rates`.
    if not ((asked > high and error > 0.0) or (asked < low and error < 0.0)):
        m[SERVO_INTEGRAL] += h * reset * error
    torque = min(max(asked, low), high)
    # Positive in the drive's own sense, as its counts are.
    m[SERVO_CURRENT] = torque / pull * (1.0 if m[SERVO_SCALE] > 0.0 else -1.0)
    return torque


def servo_generate(m: np.ndarray, h: float) -> None:
    """Advance the demand by one tick in the active mode."""
    mode = m[SERVO_MODE]
    if mode == 8.0:
        if m[SERVO_LEFT] > 0.5:
            m[SERVO_LEFT] -= 1.0
            m[SERVO_DEMAND] += m[SERVO_SLOPE]
            m[SERVO_DEMAND_SPEED] = m[SERVO_SLOPE] / h
            # Slopes add up with rounding: the last tick lands on the target itself.
            if m[SERVO_LEFT] < 0.5:
                m[SERVO_DEMAND] = m[SERVO_TARGET]
        else:
            m[SERVO_DEMAND_SPEED] = 0.0
        return
    v = m[SERVO_DEMAND_SPEED]
    if mode == 1.0:
        way = m[SERVO_TARGET] - m[SERVO_DEMAND]
        # The speed from which the profile still stops at the target, one tick ahead.
        stop = math.sqrt(2.0 * m[SERVO_DECELERATION] * abs(way))
        # At most the remaining way within one tick.
        aim = math.copysign(min(min(m[SERVO_SPEED], stop), abs(way) / h), way)
        v = servo_ramp(v, aim, m[SERVO_ACCELERATION], m[SERVO_DECELERATION], h)
    elif mode == 3.0:
        v = servo_ramp(v, m[SERVO_TARGET_SPEED], m[SERVO_ACCELERATION], m[SERVO_DECELERATION], h)
    else:
        v = servo_ramp(v, 0.0, m[SERVO_ACCELERATION], m[SERVO_DECELERATION], h)
    m[SERVO_DEMAND_SPEED] = v
    m[SERVO_DEMAND] += h * v


def servo_ramp(v: float, aim: float, acceleration: float, deceleration: float, h: float) -> float:
    """Return the speed one tick later on the way to `aim`."""
    faster = abs(aim) > abs(v) and aim * v >= 0.0  # towards the other side it brakes first
    most = (acceleration if faster else deceleration) * h
    return min(max(aim, v - most), v + most)


def servo_limit(m: np.ndarray) -> None:
    """Limit the demand to the software limits (607Dh)."""
    m[SERVO_AT_LIMIT] = 0.0
    if m[SERVO_LOW] >= m[SERVO_HIGH]:
        return
    if m[SERVO_DEMAND] > m[SERVO_HIGH]:
        m[SERVO_DEMAND] = m[SERVO_HIGH]
        m[SERVO_AT_LIMIT] = 1.0
        m[SERVO_DEMAND_SPEED] = min(m[SERVO_DEMAND_SPEED], 0.0)  # only back inside
    elif m[SERVO_DEMAND] < m[SERVO_LOW]:
        m[SERVO_DEMAND] = m[SERVO_LOW]
        m[SERVO_AT_LIMIT] = -1.0
        m[SERVO_DEMAND_SPEED] = max(m[SERVO_DEMAND_SPEED], 0.0)


def servo_follow(m: np.ndarray, error: float, h: float) -> None:
    """Monitor the following error (6065h, 6066h)."""
    if m[SERVO_WINDOW] > 0.0 and abs(error) > m[SERVO_WINDOW]:
        m[SERVO_LATE] += h
        if m[SERVO_LATE] > m[SERVO_TIMEOUT]:
            m[SERVO_TRIPPED] = 1.0
    else:
        m[SERVO_LATE] = 0.0
