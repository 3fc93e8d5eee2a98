"""Values that a robot gives its drives file: number of drives, tighter limits, signs of motors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, to_si
from softneck.plant import has_own_tendons
from softneck.robot import Robot, Scaling, find_robot, robot_file_of

from ..master._settings import ChannelSettings, LimitSettings

# What the watch needs to know of a robot; the defaults are the neck's.
_WATCHED = {"gain": "static output for one radian along its direction", "pole_per_s": "of the lag on the way there"}
_NUMBER_WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


def robot_of(given: str | Path | Robot | None, beside: Path | None) -> Robot | None:
    """Return the robot that is given, or whose file is beside or above the drives file; None: the neck, not spoken of.

    Raises SettingsError: no such robot, or one that these drives cannot move.
    """
    if given is None and (beside is None or robot_file_of(beside) is None):
        return None
    robot = find_robot(given, beside=beside)
    for what, unit in (("motors", robot.motors.unit), ("outputs", robot.outputs.unit)):
        if to_si(unit)[1] != "rad":
            raise SettingsError(
                f"robot {robot.label()} has {what} in {unit}; drives turn winches and inclinometers see angles: "
                "both must be in rad or deg."
            )
    for j, (low, high) in enumerate(_ranges_of(robot), start=1):
        if not low <= 0.0 <= high:
            raise SettingsError(
                f"robot {robot.label()}: motor {j} may go from {low:g} to {high:g} rad; drives begin and end at rest, "
                "where P is 0, which must be within."
            )
    return robot


def count_word(count: int) -> str:
    """Return a number of drives in words."""
    return _NUMBER_WORDS[count]


def require_table(table: Mapping[str, Any], robot: Robot | None) -> Mapping[str, Any]:
    """Return the table of a drives file, completed by the robot's values.

    Raises SettingsError: both say it and differ, or none says what the watch needs of a robot that is no neck.
    """
    if robot is None:
        return table
    neck = dict(table["neck"]) if isinstance(table.get("neck"), dict) else {}
    radius = robot.winch_radius_m
    if radius is not None and neck.setdefault("winch_radius_m", radius) != radius:
        raise SettingsError(
            f"[neck] winch_radius_m is {neck['winch_radius_m']:g}, but robot {robot.label()} has {radius:g} m; they "
            "must be the same."
        )
    watch = table.get("watch", {})
    missing = [key for key in _WATCHED if not isinstance(watch, dict) or key not in watch]
    if missing and not Scaling.of(robot).is_identity and robot.weights() is not None:
        raise SettingsError(
            f"[watch] `{missing[0]}` is missing ({_WATCHED[missing[0]]}): that of robot {robot.label()} is not assumed."
        )
    return {**table, "neck": neck}


def require_signs(turned: Sequence[bool], robot: Robot) -> None:
    """Raise SettingsError if the robot's `sign` and `reversed` of the drives contradict each other.

    `reversed` decides; a robot that counts no motor the other way says nothing about it.
    """
    if min(robot.motors.sign) > 0.0:
        return
    for j, (other_way, sign) in enumerate(zip(turned, robot.motors.sign, strict=True), start=1):
        if other_way != (sign < 0.0):
            raise SettingsError(
                f"[[drive]] {j} has reversed = {str(other_way).lower()}, but `motors.sign` of motor {j} is "
                f"{sign:g} in the file of robot {robot.label()}; correct one, or leave `sign` out: `reversed` decides."
            )


def channels_of(robot: Robot | None, limits: LimitSettings) -> ChannelSettings | None:
    """Return the robot's channels for the master; None if no robot is given."""
    if robot is None:
        return None
    weights = robot.weights()
    rows = () if weights is None else tuple(tuple(row) for row in weights.tolist())
    return ChannelSettings(
        outputs=robot.outputs.names,
        # Tendons of a neck file are those of [watch], or of the neck file that the drives are set up for.
        weights=None if has_own_tendons(robot) else rows,
        ranges=ranges(robot, limits),
    )


def ranges(robot: Robot | None, limits: LimitSettings) -> tuple[tuple[float, float, float], ...]:
    """Return the tighter limits of robot and drives file for each motor: lowest, highest [rad], speed [rad/s]."""
    most = limits.position
    if robot is None:
        return ((-most, most, limits.speed),) * 3
    speeds = _speeds_of(robot)
    return tuple(
        (max(low, -most), min(high, most), min(speed, limits.speed))
        for (low, high), speed in zip(_ranges_of(robot), speeds, strict=True)
    )


def limits_said(robot: Robot, limits: LimitSettings) -> list[str]:
    """Return for each motor which limits hold, and whose they are."""
    lines = []
    for (low, high), speed, chosen in zip(
        _ranges_of(robot), _speeds_of(robot), ranges(robot, limits), strict=True
    ):  # fmt: skip
        whose = ["robot" if own else "drives file" for own in
                 (low > -limits.position, high < limits.position, speed < limits.speed)]  # fmt: skip
        lines.append(
            f"{chosen[0]:g} rad ({whose[0]}) to {chosen[1]:g} rad ({whose[1]}), {chosen[2]:g} rad/s ({whose[2]})"
        )
    return lines


def _ranges_of(robot: Robot) -> list[tuple[float, float]]:
    """Return lowest and highest set-point of each motor [rad]; infinite where none is given."""
    unit, count, far = to_si(robot.motors.unit)[0], len(robot.motors.names), float("inf")
    low = robot.motors.setpoint_min or (-far,) * count
    high = robot.motors.setpoint_max or (far,) * count
    return [(unit * a, unit * b) for a, b in zip(low, high, strict=True)]


def _speeds_of(robot: Robot) -> list[float]:
    rates = robot.motors.rate_limit or (float("inf"),) * len(robot.motors.names)
    return [to_si(robot.motors.unit)[0] * rate for rate in rates]
