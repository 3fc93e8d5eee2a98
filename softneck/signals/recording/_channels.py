"""The channels a recording may have: SI unit inside, unit in files."""

from __future__ import annotations

import math
import re

from softneck.core import DataError, to_si

MOTORS = (1, 2, 3)
#: Names of the three channels with the motors' set-points.
SET_POINTS = tuple(f"motor_setpoint_{j}" for j in MOTORS)
MOTOR_POSITIONS = tuple(f"motor_position_{j}" for j in MOTORS)
# [rad] The motors stay within 6 rad: two turns are another unit, and in degrees hardly a move.
MOTOR_TURNS = 4.0 * math.pi
OUTPUTS = ("pitch", "roll")
REQUIRED = (*SET_POINTS, *OUTPUTS)

_ANGLES = ("pitch", "roll")
_TABLE: dict[str, str] = {
    "time": "s",
    **dict.fromkeys(SET_POINTS, "rad"),
    **dict.fromkeys(MOTOR_POSITIONS, "rad"),
    **{f"motor_velocity_{j}": "rad/s" for j in MOTORS},
    **{f"tension_{j}": "N" for j in MOTORS},
    **{f"{angle}{what}": "deg" for angle in _ANGLES
       for what in ("", "_measured", "_estimate", "_reference", "_lower", "_upper")},
    **{f"{angle}_rate{what}": "deg/s" for angle in _ANGLES for what in ("", "_measured", "_estimate")},
    "cocontraction_reference": "rad",
    "compression": "m",
    "payload": "kg",
    "push_x": "N",
    "push_y": "N",
    "base_tilt_pitch": "deg",
    "base_tilt_roll": "deg",
    "innovation": "1",
    "healthy": "1",
    "enabled": "1",
    "measurement_valid": "1",
}  # fmt: skip
# Channels in which an empty cell is a sample that the sensor missed.
_MAY_MISS = re.compile(r"(pitch|roll|motor_position|motor_velocity|compression|tension)")
# Channels that are set, not measured: they hold their value until the next one.
_HELD = re.compile(r"(motor_setpoint_\d|.*_reference|healthy|enabled|measurement_valid|payload)$")
_COLUMN = re.compile(r"^(?P<name>[^\[\]]+?)\s*\[(?P<unit>[^\[\]]*)\]$")


def known_channels() -> tuple[str, ...]:
    """Return the names of all channels a recording may have, `time` included."""
    return tuple(_TABLE)


def file_unit(channel: str) -> str:
    """Return the unit in which files carry `channel`."""
    return _TABLE[channel]


def si_unit(channel: str) -> str:
    """Return the SI unit in which arrays carry `channel`."""
    return to_si(_TABLE[channel])[1]


def column_name(channel: str) -> str:
    """Return the column title of `channel`, such as `pitch [deg]`."""
    return f"{channel} [{_TABLE[channel]}]"


def may_miss(channel: str) -> bool:
    """Return whether a sample of `channel` may be missing."""
    return bool(_MAY_MISS.match(channel)) and not channel.endswith("_reference")


def is_held(channel: str) -> bool:
    """Return whether `channel` is set or true-or-false, so that it holds its value between samples."""
    return bool(_HELD.match(channel))


def parse_column(title: str) -> tuple[str, float]:
    """Return (channel, factor to SI) of a column title such as `pitch [deg]`.

    Raises:
        DataError: no such channel, no unit, or a unit of another quantity.
    """
    match = _COLUMN.match(title.strip())
    if match is None:
        name = title.strip()
        hint = f"write `{column_name(name)}`" if name in _TABLE else "use `softneck import` with a layout"
        raise DataError(f"column `{name}` names no unit; {hint}.")
    name, unit = match["name"], match["unit"].strip()
    if name not in _TABLE:
        raise DataError(
            f"column `{name}` is not a channel of a recording (those are {', '.join(_TABLE)}, run); "
            "rename or drop it, or use `softneck import` with a layout."
        )
    factor, unit_si = to_si(unit)
    if unit_si != si_unit(name):
        raise DataError(f"column `{name}` cannot be in `{unit}`; expected {_TABLE[name]} or its SI unit.")
    return name, factor
