"""Metrics of a robot: names, titles, and limits scaled from those of the neck by range and time constant."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import metric_of, to_si
from softneck.estimation import NECK_REACH, REACH_OF_STATIC_GAIN, motor_ends
from softneck.loop import error_unit
from softneck.robot import MOTOR_RANGE, Robot, Scaling

from ._linear import LARGE, SMALL
from ._plants import PlantSource
from ._steps import METRICS

#: Groups of metrics of stability and margins, which nobody is told to loosen.
MARGIN_GROUPS = ("stability.", "axes.", "mimo.", "robust.")
# Sensor noise of the defaults.
_NOISE_DEG = 0.05
# Angles of every robot, independent of the unit of its outputs.
_ANGLE_KEYS = ("orientations_deg", "phase_margin_deg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """Factors from the neck's limits to those of a robot; all are 1 for the neck.

    `robot`: of the requirements. `time`: factor of seconds. `size`: of degrees, in the display unit of the outputs.
    `load`: of radians at the plant's input, in the unit of the motors. `noise`: of degrees of sensor noise, as `size`.
    `known`: whether robot and plants give all factors; else stated values are not checked against them.
    """

    robot: Robot = field(default_factory=Robot.preset)
    time: float = 1.0
    size: float = 1.0
    load: float = 1.0
    noise: float = 1.0
    known: bool = True

    @classmethod
    def of(cls, robot: Robot, sources: Sequence[PlantSource] = ()) -> Scale:
        """Return the scale from the robot file, else from its ranges and plants."""
        slowest = [1.0 / float(box.nominal[1]) for source in sources for box in source.axes]
        slowest += [each for source in sources for each in (source.sample_time, source.decay)]
        scaling = Scaling.of(robot, time_constant=max(slowest, default=None))
        motors, outputs = robot.motors, robot.outputs
        load, output = scaling.motor_unit, float(scaling.output_unit.min())
        if sources and (motors.nominal is None or outputs.nominal is None):
            low, high = motor_ends(robot, "verification")
            most = [np.abs(source.weights) @ (0.5 * (high - low)) for source in sources]
            load = min(float(each.min()) for each in most) / (2.0 * MOTOR_RANGE)
            reached = min(
                REACH_OF_STATIC_GAIN * abs(float(box.nominal[0])) * float(v) / NECK_REACH
                for source, each in zip(sources, most, strict=True) for box, v in zip(source.axes, each, strict=True)
            )  # fmt: skip
            output = reached if outputs.min is None or outputs.max is None else min(output, reached)
        size = output * math.radians(1.0) / _unit_factor(robot)
        noise = size * _NOISE_DEG
        if robot.noise_std is not None:
            noise = robot.noise_std * to_si(outputs.unit)[0] / _unit_factor(robot)
        return cls(
            robot=robot, time=scaling.second, size=size, load=load / to_si(motors.unit)[0],
            noise=round_12_digits(noise / _NOISE_DEG),
            known=bool(sources) or None not in (robot.time_constant_s, motors.nominal, outputs.nominal),
        )  # fmt: skip

    @property
    def gain(self) -> float:
        """SI value of a unit gain in scaled quantities."""
        return self.si(self.size) / math.radians(1.0) / (to_si(self.robot.motors.unit)[0] * self.load)

    def factor(self, name: str) -> float:
        """Return the factor of a key or metric such as `size_deg` or `settling_s`."""
        if name == "load_rad":
            return self.load
        if name == "noise_deg":
            return self.noise
        if name == "circle_rad_s":
            return 1.0 / self.time
        if name.endswith("_deg") and name not in _ANGLE_KEYS:
            # A steady-state error is at least the sensor noise.
            return max(self.size, self.noise) if name == "steady_rms_deg" else self.size
        return self.time if name.endswith(("_s", "_ms")) else 1.0

    def name_of(self, name: str) -> str:
        """Return the robot's name of a key or metric: `load_rms_mm` for `load_rms_deg`, `max_bar` for `max_rad`."""
        if name.rpartition(".")[2] in _ANGLE_KEYS:
            return name
        motor = self.robot.motors.unit.replace("/", "_")
        own = re.sub(r"_deg$", f"_{error_unit(self.robot)[0]}", name)
        return re.sub(r"_rad$", f"_{motor}", own.replace("variation_rad_s", f"variation_{motor}_s"))

    def table(self, defaults: Mapping[str, Any]) -> dict[str, Any]:
        """Return a table of defaults scaled to the robot, with keys in its units."""
        return {
            self.name_of(key): _times(self.factor(key.rpartition(".")[2]), value) for key, value in defaults.items()
        }

    def si(self, value: float) -> float:
        """Convert an output from its display unit, such as deg, to SI."""
        factor = error_unit(self.robot)[1]
        return math.radians(value) if factor is None else factor * value

    def shown(self, values: Any) -> Any:
        """Convert outputs from SI to their display unit."""
        factor = error_unit(self.robot)[1]
        return np.degrees(values) if factor is None else values / factor


def _unit_factor(robot: Robot) -> float:
    factor = error_unit(robot)[1]
    return math.radians(1.0) if factor is None else factor


def _times(factor: float, value: Any) -> Any:
    """Scale numbers, also in tables; lists, texts and booleans stay."""
    if isinstance(value, Mapping):
        return {key: _times(factor, item) for key, item in value.items()}
    plain = isinstance(value, bool) or not isinstance(value, int | float) or factor == 1.0
    return value if plain else round_12_digits(factor * value)


def round_12_digits(value: float) -> float:
    """Round to 12 digits, which removes rounding errors of unit conversions."""
    return float(f"{value:.12g}")


# Metrics of the loops of [track], which only `tune` runs.
_TRACK_METRICS = ("circle_rms_deg", "ahead_rms_deg", "variation_rad_s")
_AXIS_METRICS = (*LARGE, *SMALL)
_SIM_METRICS = (
    "overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg", "load_rms_deg", "max_rad",
    "limit_violation_s", "slack_s",
)  # fmt: skip


def metric_names(robot: Robot, *, track: bool = False) -> tuple[str, ...]:
    """Return the names of all metrics of a robot; with `track`, also those of [track]."""
    name_of = Scale(robot=robot).name_of
    return (
        "stability.radius",
        "stability.searched_radius",
        *(f"{axis}.{name}" for axis in ("axes", *robot.outputs.names) for name in _AXIS_METRICS),
        "mimo.disk_margin",
        "robust.mu",
        *(f"step.{name_of(name)}" for name in METRICS),
        *(f"sim.{name_of(name)}" for name in _SIM_METRICS),
        *(f"track.{name_of(name)}" for name in _TRACK_METRICS if track),
    )


_GROUPS = {
    "stability": "every plant", "axes": "worst axis", "mimo": "all axes at once", "robust": "whole uncertainty",
    "step": "linear plants", "sim": "simulation", "track": "simulation",
}  # fmt: skip


def metric_title(metric: str) -> str:
    """Return the plain name of a metric with its key: "gain margin, worst axis (axes.gain_margin)"."""
    group = metric.partition(".")[0]
    return f"{metric_of(metric).title}, {_GROUPS.get(group, group)} ({metric})"
