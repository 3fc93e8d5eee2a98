"""Ports of all controllers, and limits of set-points, among them tautness of tendons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, require_between, require_finite, require_positive, to_si
from softneck.robot import MOTOR_RANGE as MAX_MOTOR
from softneck.robot import OUTPUT_RANGE as MAX_REFERENCE
from softneck.robot import Robot, Scaling
from softneck.runtime import Port

MAX_SLEW = 1000.0
_NECK = Robot.preset("neck")
# A reference that nobody limits: beyond any number in SI that a robot's output has, and a number in files still.
_NO_LIMIT = 1e12


def limit_ports(starts: tuple[float, float, float, float, float], robot: Robot = _NECK) -> tuple[Port, ...]:
    """Return the parameters of every controller with allocation, in the order of `_allocation_runtime`'s callers.

    `starts`: position limit [rad], slew limit [rad/s], lead limit, least position, least co-contraction [rad]; of
    another robot in the SI unit of its motors. `robot`: whose motors they are.
    """
    position, slew, lead, least, common = starts
    unit = to_si(robot.motors.unit)[1]
    largest = nominal_ends(robot)
    bounded, size = largest is not None, 1.0 if largest is None else largest / MAX_MOTOR
    smallest = 0.01 if bounded else 0.0

    def port(name: str, start: float, low: float, most: float, what: str = "", per: str = "") -> Port:
        return Port(name=name, unit=unit + per, start=start, minimum=size * low if bounded or low == 0.0 else None,
                    maximum=size * most if bounded else None, description=what,
                    display_unit="" if per else robot.motors.shown)  # fmt: skip

    return (
        port("position_limit", position, smallest, MAX_MOTOR),
        port("slew_limit", slew, smallest, MAX_SLEW, per="/s"),
        port("lead_limit", lead, smallest, 2.0 * MAX_MOTOR),
        port("least_position", least, -MAX_MOTOR, MAX_MOTOR, "no motor below this, co-contraction is raised instead"),
        port("least_cocontraction", common, -MAX_MOTOR, MAX_MOTOR, "lower bound of the co-contraction reference"),
    )


def controller_outputs(robot: Robot = _NECK) -> tuple[Port, ...]:
    """Return the outputs: the motors' set-points."""
    ranges = motor_ranges(robot, None)
    return _motors(robot, robot.set_points, "set-point of motor", ranges)


def controller_inputs(robot: Robot = _NECK) -> tuple[Port, ...]:
    """Return the inputs: references, outputs, motors and flags."""
    unit, shown = to_si(robot.outputs.unit)[1], robot.outputs.shown
    lowest, highest = reference_ranges(robot)
    ranges = motor_ranges(robot, None)
    references = tuple(
        Port(name=f"{name}_reference", unit=unit, description=f"wanted {name}", display_unit=shown,
             minimum=None if low <= -_NO_LIMIT else low, maximum=None if high >= _NO_LIMIT else high)
        for name, low, high in zip(robot.outputs.names, map(float, lowest), map(float, highest), strict=True)
    )  # fmt: skip
    cocontraction = Port(
        name="cocontraction_reference", unit=to_si(robot.motors.unit)[1], display_unit=robot.motors.shown,
        minimum=None if ranges is None else float(min(ranges[0])),
        maximum=None if ranges is None else float(max(ranges[1])),
        description=f"wanted {robot.cocontraction_name}, the mean of the motors that moves no output",
    )  # fmt: skip
    angles = tuple(
        Port(name=name, unit=unit, description=f"{name} of the robot", display_unit=shown)
        for name in robot.outputs.names
    )
    motors = _motors(robot, robot.motor_positions, "measured position of motor", ranges)
    flags = (
        Port(name="healthy", description="the angles can be trusted", start=1.0, boolean=True),
        Port(name="enabled", description="may move the motors", start=1.0, boolean=True),
    )
    return (*references, cocontraction, *angles, *motors, *flags)


def _motors(robot: Robot, names: Sequence[str], what: str, ranges: tuple[Vector, Vector] | None) -> tuple[Port, ...]:
    ends = (
        [(None, None)] * len(names) if ranges is None else [(float(a), float(b)) for a, b in zip(*ranges, strict=True)]
    )
    return tuple(
        Port(
            name=name,
            unit=to_si(robot.motors.unit)[1],
            description=f"{what} {j}",
            minimum=low,
            maximum=high,
            display_unit=robot.motors.shown,
        )
        for j, (name, (low, high)) in enumerate(zip(names, ends, strict=True), start=1)
    )


def nominal_ends(robot: Robot) -> float | None:
    """Return the largest set-point in SI of a robot with a nominal one; None without."""
    return None if robot.motors.nominal is None else MAX_MOTOR * Scaling.of(robot).motor_unit


def motor_ranges(robot: Robot, position: float | None) -> tuple[Vector, Vector] | None:
    """Return the lowest and highest set-points (motors,) in SI; None if neither robot nor `position` gives them."""
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if (largest := nominal_ends(robot)) is not None:
        most = np.full(len(motors.names), largest)
        return -most, most
    if motors.setpoint_min is None or motors.setpoint_max is None:
        most = np.full(len(motors.names), 0.0 if position is None else position)
        return None if position is None else (-most, most)
    low, high = factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)
    return (low, high) if position is None else (np.maximum(low, -position), np.minimum(high, position))


def reference_ranges(robot: Robot) -> tuple[Vector, Vector]:
    """Return the lowest and highest references (outputs,) in SI: the range of the robot's outputs."""
    outputs, factor, size = robot.outputs, to_si(robot.outputs.unit)[0], len(robot.outputs.names)
    if outputs.nominal is not None:
        most = MAX_REFERENCE * Scaling.of(robot).output_unit
        return -most, most
    low = np.full(size, -_NO_LIMIT) if outputs.min is None else factor * np.array(outputs.min)
    high = np.full(size, _NO_LIMIT) if outputs.max is None else factor * np.array(outputs.max)
    return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerLimits:
    """Limits of set-points; the runtime shares each limit among the motors.

    Attributes:
        position_limit: of each motor [rad].
        slew_limit: of each motor [rad/s]; the default is 0.25 rad in 20 ms.
        lead_limit: how far a set-point may be from its motor [rad].
        least_position: no motor is let out below this [rad], co-contraction is raised instead; tendons stay taut.
            -6 for no such rule.
        least_cocontraction: the co-contraction reference is at least this [rad of delta_i]; -6 for no such rule.
        robot: whose motors they are; of another than the neck all are in the SI unit of its motors, which stay within
            its own `setpoint_min` and `setpoint_max` as well.
    """

    position_limit: float = MAX_MOTOR
    slew_limit: float = 12.5
    lead_limit: float = 0.8
    least_position: float = -MAX_MOTOR
    least_cocontraction: float = -MAX_MOTOR
    robot: Robot = field(default_factory=Robot.preset)

    def __post_init__(self) -> None:
        for name in LIMITS:
            check = require_finite if name.startswith("least_") else require_positive
            check(name, getattr(self, name))
        largest, unit = nominal_ends(self.robot), to_si(self.robot.motors.unit)[1]
        if largest is not None:
            least = 0.01 * largest / MAX_MOTOR
            require_between("position_limit", self.position_limit, least, largest, unit)
            require_between("lead_limit", self.lead_limit, least, 2.0 * largest, unit)
            for name in LIMITS[3:]:
                require_between(name, getattr(self, name), -largest, largest, unit)
        for name in LIMITS[3:]:
            _require_room(name, getattr(self, name), self.position_limit, self.robot.motors.unit)

    def ports(self) -> tuple[Port, ...]:
        """Return them as parameters of a block."""
        starts = (self.position_limit, self.slew_limit, self.lead_limit, self.least_position, self.least_cocontraction)
        return limit_ports(starts, self.robot)

    def header(self) -> dict[str, float]:
        """Return the numbers as a file keeps them."""
        return {name: getattr(self, name) for name in LIMITS}

    @classmethod
    def from_header(cls, header: Mapping[str, Any], robot: Robot) -> ControllerLimits:
        """Return the limits of a file; files of the first version lack the limits of tautness."""
        return cls(robot=robot, **{name: float(header[name]) for name in LIMITS if name in header})

    def constants(self, sample_time: float) -> Vector:
        """Return the runtime's constants: sample time, of another robot also ranges of set-points, references."""
        ranges = motor_ranges(self.robot, self.position_limit)
        if ranges is None:
            return np.array([sample_time])
        low, high = reference_ranges(self.robot)
        if (np.abs(ranges) == MAX_MOTOR).all() and (np.abs([low, high]) == MAX_REFERENCE).all():
            return np.array([sample_time])  # the runtime's own
        return np.array([sample_time, *ranges[0], *ranges[1], *low, ranges[0].min(), *high, ranges[1].max()])

    def lines(self, sample_time: float) -> list[str]:
        """Return some lines for people, in the unit of the motors."""
        unit = self.robot.motors.unit
        factor = to_si(unit)[0]
        ranges = motor_ranges(self.robot, self.position_limit)
        ends = "" if ranges is None else (
            f"set-points {max(ranges[0].min(), -self.position_limit) / factor:g} to "
            f"{min(ranges[1].max(), self.position_limit) / factor:g} {unit}, "
        )  # fmt: skip
        slew, lead = self.slew_limit / factor, self.lead_limit / factor
        most = min(self.robot.motors.rate_limit or (0.0,))
        allowed = f"; its robot allows {most:g} {unit}/s" if most > slew * (1.0 + 1e-9) else ""
        rules = [("no motor below", self.least_position), ("co-contraction at least", self.least_cocontraction)]
        what = "motors" if self.robot.tendon_angles is None else "tendons kept taut"
        taut = [f"{rule} {limit / factor:g} {unit}" for rule, limit in rules if limit > -self.position_limit]
        return [
            f"  limits: {ends}slew {slew:g} {unit}/s ({slew * sample_time:g} {unit} per sample{allowed}), "
            f"lead {lead:g} {unit} before the motors",
            *([f"  {what}: {', '.join(taut)}"] if taut else []),
        ]


LIMITS = ("position_limit", "slew_limit", "lead_limit", "least_position", "least_cocontraction")
# Of scaled set-points, where a file with nominal ones allows more: 0.25 in 20 ms.
_NOMINAL_SLEW = 12.5


def limits_of(robot: Robot, *, lead_limit: float | None, least_cocontraction: float | None) -> ControllerLimits:
    """Return the limits of a robot's motors, and the two limits of the controller.

    `robot`: whose motors they are. `lead_limit`, `least_cocontraction`: [SI]; None for no such limit. Raises
    SettingsError: a limit that the robot's file does not say.
    """
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    largest, ranges = nominal_ends(robot), motor_ranges(robot, None)
    missing = ["`motors.setpoint_min` and `setpoint_max`"] * (ranges is None)
    missing += ["`motors.rate_limit`"] * (motors.rate_limit is None and largest is None)
    if ranges is None or missing:
        raise robot.error_without(missing, "a controller needs")
    rates = [factor * rate for rate in motors.rate_limit or ()]
    most = float(np.abs(ranges).max())
    least = -most
    if largest is not None:
        scaling = Scaling.of(robot)
        most = min((largest, *(factor * high for high in motors.setpoint_max or ())))
        # Down to the same limit there is no need of a rule.
        least = max((-largest, *(factor * low for low in motors.setpoint_min or () if factor * low > -most)))
        rates.append(_NOMINAL_SLEW * scaling.motor_unit / scaling.second)
    return ControllerLimits(
        robot=robot, position_limit=most, slew_limit=min(rates), least_position=least,
        lead_limit=2.0 * most if lead_limit is None else lead_limit,
        least_cocontraction=-(largest or most) if least_cocontraction is None else least_cocontraction,
    )  # fmt: skip


def _require_room(name: str, value: float, position_limit: float, unit: str) -> None:
    if value >= position_limit:
        most, got = (number / to_si(unit)[0] for number in (position_limit, value))
        raise SettingsError(
            f"`{name}` must be below `position_limit`, {most:g} {unit}, or no room to tilt is left; got {got:g}."
        )
