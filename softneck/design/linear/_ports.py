"""The ports that all controllers share, and what set-points may do: limits, and tendons that stay taut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, require_between, require_finite, require_positive, to_si
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.runtime import Port

# The neck's inclination stays below 0.7 rad; motors within 6 rad (paper, section 5).
MAX_REFERENCE = 0.8
MAX_MOTOR = 6.0
MAX_SLEW = 1000.0
_NECK = Robot.preset("neck")
# A reference that nobody limits: beyond any number in SI that a robot's output has, and a number in files still.
_UNLIMITED = 1e12


def limit_ports(starts: tuple[float, float, float, float, float], robot: Robot = _NECK) -> tuple[Port, ...]:
    """Return the parameters of every controller with allocation, in the order of `_allocation_runtime`'s callers.

    Args:
        starts: position limit [rad], slew limit [rad/s], lead limit, least position, least co-contraction [rad]; of
            another robot in the SI unit of its motors.
        robot: whose motors they are.
    """
    position, slew, lead, least, common = starts
    unit, neck = to_si(robot.motors.unit)[1], robot.is_neck
    smallest = 0.01 if neck else 0.0

    def port(name: str, start: float, low: float, most: float, what: str = "", per: str = "") -> Port:
        return Port(name=name, unit=unit + per, start=start, minimum=low if neck or low == 0.0 else None,
                    maximum=most if neck else None, description=what)  # fmt: skip

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
    neck, unit, shown = robot.is_neck, to_si(robot.outputs.unit)[1], robot.outputs.shown
    lowest, highest = reference_ranges(robot)
    ranges = motor_ranges(robot, None)
    references = tuple(
        Port(name=f"{name}_reference", unit=unit, description=f"wanted {name}", display_unit=shown,
             minimum=None if low <= -_UNLIMITED else low, maximum=None if high >= _UNLIMITED else high)
        for name, low, high in zip(robot.outputs.names, map(float, lowest), map(float, highest), strict=True)
    )  # fmt: skip
    cocontraction = Port(
        name="cocontraction_reference", unit=to_si(robot.motors.unit)[1], display_unit=robot.motors.shown,
        minimum=None if ranges is None else float(min(ranges[0])),
        maximum=None if ranges is None else float(max(ranges[1])),
        description="wanted delta_i (Eq. 11)" if neck else "wanted mean of the motors that moves no output",
    )  # fmt: skip
    whose = "the neck" if neck else robot.name
    angles = tuple(
        Port(name=name, unit=unit, description=f"{name} of {whose}", display_unit=shown) for name in robot.outputs.names
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


def motor_ranges(robot: Robot, position: float | None) -> tuple[Vector, Vector] | None:
    """Return the lowest and highest set-points (motors,) in SI; None where neither the robot nor `position` says."""
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if robot.is_neck:
        return np.full(3, -MAX_MOTOR), np.full(3, MAX_MOTOR)
    if motors.setpoint_min is None or motors.setpoint_max is None:
        most = np.full(len(motors.names), 0.0 if position is None else position)
        return None if position is None else (-most, most)
    low, high = factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)
    return (low, high) if position is None else (np.maximum(low, -position), np.minimum(high, position))


def reference_ranges(robot: Robot) -> tuple[Vector, Vector]:
    """Return the lowest and highest references (outputs,) in SI: what the robot's outputs may be."""
    outputs, factor, size = robot.outputs, to_si(robot.outputs.unit)[0], len(robot.outputs.names)
    if robot.is_neck:
        return np.full(size, -MAX_REFERENCE), np.full(size, MAX_REFERENCE)
    low = np.full(size, -_UNLIMITED) if outputs.min is None else factor * np.array(outputs.min)
    high = np.full(size, _UNLIMITED) if outputs.max is None else factor * np.array(outputs.max)
    return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerLimits:
    """What set-points may do; the runtime shares each limit among the motors.

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
        if not self.robot.is_neck:
            require_limits({name: getattr(self, name) for name in LIMITS})
            for name in LIMITS[3:]:
                _require_room(name, getattr(self, name), self.position_limit, self.robot.motors.unit)
            return
        require_between("position_limit", self.position_limit, 0.01, MAX_MOTOR, "rad")
        require_between("slew_limit", self.slew_limit, 0.01, MAX_SLEW, "rad/s")
        require_between("lead_limit", self.lead_limit, 0.01, 2.0 * MAX_MOTOR, "rad")
        require_taut(self.least_position, self.least_cocontraction, self.position_limit)

    def ports(self) -> tuple[Port, ...]:
        """Return them as parameters of a block."""
        starts = (self.position_limit, self.slew_limit, self.lead_limit, self.least_position, self.least_cocontraction)
        return limit_ports(starts, self.robot)

    def header(self) -> dict[str, float]:
        """Return the numbers as a file keeps them."""
        return {name: getattr(self, name) for name in LIMITS}

    @classmethod
    def from_header(cls, header: Mapping[str, Any], robot: Robot) -> ControllerLimits:
        """Return the limits of a file; those of the first version do not know the rules for taut tendons."""
        return cls(robot=robot, **{name: float(header[name]) for name in LIMITS if name in header})

    def constants(self, sample_time: float) -> Vector:
        """Return the runtime's constants: sample time, of another robot also ranges of set-points, references."""
        ranges = motor_ranges(self.robot, self.position_limit)
        if self.robot.is_neck or ranges is None:
            return np.array([sample_time])
        low, high = reference_ranges(self.robot)
        return np.array([sample_time, *ranges[0], *ranges[1], *low, ranges[0].min(), *high, ranges[1].max()])

    def lines(self, sample_time: float) -> list[str]:
        """Return some lines for people."""
        if not self.robot.is_neck:
            return [self._line_of_robot()]
        return [
            f"  limits: |P| <= {self.position_limit:g} rad, slew {self.slew_limit:g} rad/s "
            f"({self.slew_limit * sample_time:g} rad per sample{self._of_robot()}), lead {self.lead_limit:g} rad "
            "before the motors",
            *_taut_lines(self.least_position, self.least_cocontraction),
        ]

    def _of_robot(self) -> str:
        """Return by how much more the robot's file would allow: a default that is stricter is said."""
        most = min(self.robot.motors.rate_limit or (0.0,))
        return f"; its robot allows {most:g} rad/s" if most > self.slew_limit else ""

    def _line_of_robot(self) -> str:
        """Return a line in the unit of the robot's files."""
        unit = self.robot.motors.unit
        factor = to_si(unit)[0]
        ranges = motor_ranges(self.robot, self.position_limit)
        told = (
            ""
            if ranges is None
            else f"set-points {ranges[0].min() / factor:g} to {ranges[1].max() / factor:g} {unit}, "
        )
        return (
            f"  robot {self.robot.label()}: {told}slew {self.slew_limit / factor:g} {unit}/s, lead "
            f"{self.lead_limit / factor:g} {unit} before the motors"
        )


LIMITS = ("position_limit", "slew_limit", "lead_limit", "least_position", "least_cocontraction")
# Of a neck, where its file allows more: 0.25 rad in 20 ms.
_NECK_SLEW = 12.5


def limits_of(robot: Robot, *, lead_limit: float, least_cocontraction: float) -> ControllerLimits:
    """Return the limits of a robot: what its file says of its motors, and two of a controller's own.

    Args:
        robot: whose motors they are.
        lead_limit, least_cocontraction: in the unit of its motors; a `NeckDefault` is of necks: other set-points may
            run ahead of the motors as far as these go.

    Raises:
        SettingsError: a limit that the robot's file does not say.
    """
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    given = {"lead_limit": lead_limit, "least_cocontraction": least_cocontraction}
    if robot.is_neck:
        position = min((MAX_MOTOR, *(motors.setpoint_max or ())))
        # Down to the same limit there is no need of a rule.
        lowest = [low for low in motors.setpoint_min or () if low > -position]
        return ControllerLimits(
            robot=robot, position_limit=position, slew_limit=min((_NECK_SLEW, *(motors.rate_limit or ()))),
            least_position=max((-MAX_MOTOR, *lowest)), **given,
        )  # fmt: skip
    ranges = motor_ranges(robot, None)
    if ranges is None or motors.rate_limit is None:
        missing = "setpoint_min` and `setpoint_max" if ranges is None else "rate_limit"
        raise SettingsError(
            f"robot {robot.label()} gives no `motors.{missing}`, which a controller needs; add it to its robot file."
        )
    most = float(np.abs(ranges).max())
    own = {name: factor * value for name, value in given.items() if not isinstance(value, NeckDefault)}
    usual = {"lead_limit": 2.0 * most, "least_cocontraction": -most}
    return ControllerLimits(
        robot=robot, position_limit=most, slew_limit=factor * min(motors.rate_limit), least_position=-most,
        **{**usual, **own},
    )  # fmt: skip


def require_limits(limits: Mapping[str, float]) -> None:
    """Raise SettingsError for limits that are none of any robot: how far its motors go is known when it is."""
    for name, value in limits.items():
        check = require_finite if name.startswith("least_") else require_positive
        check(name, value)


def require_taut(least_position: float, least_cocontraction: float, position_limit: float) -> None:
    """Raise SettingsError unless the rule for taut tendons leaves the motors room below their limit."""
    for name, value in (("least_position", least_position), ("least_cocontraction", least_cocontraction)):
        require_between(name, value, -MAX_MOTOR, MAX_MOTOR, "rad")
        _require_room(name, value, position_limit, "rad")


def _require_room(name: str, value: float, position_limit: float, unit: str) -> None:
    if value >= position_limit:
        most, got = (number / to_si(unit)[0] for number in (position_limit, value))
        raise SettingsError(
            f"`{name}` must be below `position_limit`, {most:g} {unit}, or no room to tilt is left; got {got:g}."
        )


def _taut_lines(least_position: float, least_cocontraction: float) -> list[str]:
    """Return a line on the rule for taut tendons, none where there is no rule."""
    parts = []
    if least_position > -MAX_MOTOR:
        parts.append(f"no motor below {least_position:g} rad")
    if least_cocontraction > -MAX_MOTOR:
        parts.append(f"co-contraction at least {least_cocontraction:g} rad")
    return [f"  tendons kept taut: {', '.join(parts)}"] if parts else []
