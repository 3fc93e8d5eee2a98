"""The channels a recording may have, their units, and the redefined inputs of the neck (paper, section 2.1)."""

from __future__ import annotations

import math
import re
from functools import cache

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, did_you_mean, to_si
from softneck.robot import Robot

NECK = Robot.preset("neck")
#: Names of the three channels with the motors' set-points of a neck.
SET_POINTS = NECK.set_points
MOTOR_POSITIONS = NECK.motor_positions
MOTOR_VELOCITIES = NECK.motor_velocities
# [rad] Motors stay within 6 rad. Two turns mean another unit: in degrees they would be hardly a motion.
MOTOR_TURNS = 4.0 * math.pi
OUTPUTS = NECK.outputs.names

# Suffixes of the channels that belong to an output and to its rate.
_OUTPUT_SUFFIXES = ("", "_measured", "_estimate", "_reference", "_lower", "_upper")
_RATE_SUFFIXES = ("_rate", "_rate_measured", "_rate_estimate")
_COMMON_UNITS = {
    "compression": "m",
    "payload": "kg",
    "payload_estimate": "kg",
    "push_x": "N",
    "push_y": "N",
    "base_tilt_pitch": "deg",
    "base_tilt_roll": "deg",
    "innovation": "1",
    "healthy": "1",
    "enabled": "1",
    "measurement_valid": "1",
}
# Channels that are commanded or boolean: they hold their value until the next sample.
_HELD_CHANNELS = re.compile(r"(motor_setpoint_\d|.*_setpoint|.*_reference|healthy|enabled|measurement_valid|payload)$")
_IMPORT = "use `softneck import` with --guess if this is a logger's table"
_COLUMN_TITLE = re.compile(r"^(?P<name>[^\[\]]+?)\s*\[(?P<unit>[^\[\]]*)\]$")


class ForeignColumnError(DataError):
    """A column that no recording of the robot has: the table may be one of another logger."""


@cache
def _file_units(robot: Robot) -> dict[str, str]:
    """Return channel -> unit in files, for all channels that a recording of `robot` may have."""
    unit, shown = robot.motors.unit, robot.outputs.display_unit
    return {
        "time": "s",
        **dict.fromkeys(robot.set_points, unit),
        **dict.fromkeys(robot.motor_positions, unit),
        **dict.fromkeys(robot.motor_velocities, f"{unit}/s"),
        **{f"tension_{j}": "N" for j in range(1, len(robot.motors.names) + 1)},
        **{f"{output}{what}": shown for output in robot.outputs.names for what in _OUTPUT_SUFFIXES},
        **{f"{output}{what}": f"{shown}/s" for output in robot.outputs.names for what in _RATE_SUFFIXES},
        "cocontraction_reference": unit,
        **_COMMON_UNITS,
    }


def known_channels(robot: Robot = NECK) -> tuple[str, ...]:
    """Return the names of all channels a recording of `robot` may have, `time` included."""
    return tuple(_file_units(robot))


def file_unit(channel: str, robot: Robot = NECK) -> str:
    """Return the unit in which files carry `channel`."""
    return _file_units(robot)[channel]


def si_unit(channel: str, robot: Robot = NECK) -> str:
    """Return the SI unit in which arrays carry `channel`."""
    return to_si(_file_units(robot)[channel])[1]


def column_name(channel: str, robot: Robot = NECK) -> str:
    """Return the column title of `channel`, such as `pitch [deg]`."""
    return f"{channel} [{_file_units(robot)[channel]}]"


def may_miss(channel: str, robot: Robot = NECK) -> bool:
    """Return whether samples of `channel` may be missing; files leave such a cell empty."""
    measured = (*robot.outputs.names, *robot.motor_positions, *robot.motor_velocities, "compression", "tension")
    return channel.startswith(measured) and not channel.endswith("_reference")


def is_held(channel: str) -> bool:
    """Return whether `channel` holds its value between samples: it is a command or a flag."""
    return bool(_HELD_CHANNELS.match(channel))


def parse_column(title: str, robot: Robot = NECK) -> tuple[str, float]:
    """Return (channel, factor to SI) of a column title such as `pitch [deg]`; a motor may have its number or name."""
    table = _file_units(robot)
    match = _COLUMN_TITLE.match(title.strip())
    if match is None:
        name = title.strip()
        if name in table:
            raise DataError(f"column `{name}` names no unit; write `{column_name(name, robot)}`.")
        raise ForeignColumnError(f"column `{name}` names no unit; {_IMPORT}.")
    name, unit = robot.own(match["name"]), match["unit"].strip()
    if name not in table:
        raise ForeignColumnError(
            f"column `{name}` is not a channel of a recording of robot {robot.label()}, whose outputs are "
            f"{', '.join(robot.outputs.names)}; {did_you_mean(name, table)}{_IMPORT}; or drop the column."
        )
    factor, unit_si = to_si(unit)
    if unit_si != si_unit(name, robot):
        raise DataError(f"column `{name}` cannot be in `{unit}`; expected {table[name]} or its SI unit.")
    return name, factor


#: [rad] Tendons of motors 1, 2 and 3 around the neck (Eq. 6 and 8).
TENDON_ANGLES = np.radians([0.0, 120.0, 240.0])


def redefinition_matrix(angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return T (3, 3) with (theta_i, phi_i, delta_i) = T (P1, P2, P3) of tendons at `angles` [rad] (Eq. 4, 5, 7, 11).

    `Robot.redefinition` does the same for any number of motors and outputs.

    Raises:
        SettingsError: the angles do not span the plane, so that T has no inverse.
    """
    gamma = np.asarray(angles, dtype=np.float64)
    finite = gamma.shape == (3,) and np.isfinite(gamma).all()
    T = np.array([np.cos(gamma), np.sin(gamma), np.full(3, 1.0 / 3.0)]) if finite else np.zeros((3, 3))
    # Near a zero determinant two tendons almost coincide, and the inverse has huge motor angles.
    if abs(np.linalg.det(T)) < 1e-3:
        raise SettingsError(f"three tendon angles that span the plane are needed [rad]; got {gamma.tolist()}.")
    T[np.abs(T) < 1e-15] = 0.0
    return T


def redefine(motors: Matrix, angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return theta_i, phi_i, delta_i (time, 3) of motor positions (time, 3) [rad] (Eq. 9-11)."""
    return np.asarray(motors) @ redefinition_matrix(angles).T


def motors_from(inputs: Matrix, angles: Vector = TENDON_ANGLES) -> Matrix:
    """Return the motor positions (time, 3) [rad] of theta_i, phi_i, delta_i (time, 3), the inverse of `redefine`."""
    return np.asarray(inputs) @ np.linalg.inv(redefinition_matrix(angles)).T
