"""Scaling between a robot's SI quantities and the scaled ones that estimators, designs and verification use.

Scaled quantities have the size of the preset `neck`: set-points run over about +-6, outputs over about +-0.8, and
outputs follow set-points with a time constant of 0.2. Constants chosen for the neck hold for every robot, and the
maps of the neck itself are the identity. No other code in softneck multiplies by a unit or a time scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, Vector, to_si

from ._robot import Robot

#: Half the range of scaled set-points and of scaled outputs, and their time constant: section 3.1, 5 and Eq. 31.
MOTOR_RANGE, OUTPUT_RANGE, TIME_CONSTANT = 6.0, 0.8, 0.2
# Of theta_i = P_1 - P_2 / 2 - P_3 / 2 (Eq. 9): the norm of its weights.
_INPUT_WEIGHT = math.sqrt(1.5)
# Scaled data are rounded to this, so that iterative fits get the same numbers for any unit of the file.
_SCALED_RESOLUTION = 2.0**-40


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scaling:
    """Affine maps between SI and scaled quantities: `scaled = (SI - rest) / unit`.

    Attributes:
        motor_unit: of set-points and motor positions, one for all motors, so that directions keep their angles [SI].
        motor_rest: (motors,) set-points that are zero when scaled [SI].
        output_unit: (outputs,) of the outputs [SI].
        output_rest: (outputs,) outputs that are zero when scaled [SI].
        second: length of one scaled second [s].
    """

    motor_unit: float
    motor_rest: Vector
    output_unit: Vector
    output_rest: Vector
    second: float = 1.0

    @classmethod
    def of(
        cls, robot: Robot, *, set_points: Matrix | None = None, outputs: Matrix | None = None,
        time_constant: float | None = None,
    ) -> Scaling:  # fmt: skip
        """Return the scaling of a robot: by its nominal values, else by its ranges, else by data.

        Args:
            robot: its `nominal`, `rest`, `setpoint_min`, `min` and so on take precedence over data.
            set_points: (time, motors) data in SI, for values that the robot does not give; without data 0 and 1.
            outputs: (time, outputs) data in SI, likewise.
            time_constant: of the data [s]; the robot's own takes precedence.
        """
        motors, measured = robot.motors, robot.outputs
        inputs = to_si(motors.unit)[0], motors.nominal, motors.rest, motors.setpoint_min, motors.setpoint_max
        units, rest = _sizes(*inputs, set_points, MOTOR_RANGE, len(motors.names))
        values = to_si(measured.unit)[0], measured.nominal, measured.rest, measured.min, measured.max
        output_units, output_rest = _sizes(*values, outputs, OUTPUT_RANGE, len(measured.names))
        seconds = robot.time_constant_s or time_constant or TIME_CONSTANT
        return cls(
            motor_unit=float(units.max()), motor_rest=rest, output_unit=output_units, output_rest=output_rest,
            second=seconds / TIME_CONSTANT,
        )  # fmt: skip

    @property
    def is_identity(self) -> bool:
        """Whether scaled quantities are those in SI, as of the preset `neck`."""
        ones = self.motor_unit == 1.0 and self.second == 1.0 and bool((self.output_unit == 1.0).all())
        return ones and not self.motor_rest.any() and not self.output_rest.any()

    def scale_motors(self, values: Matrix) -> Matrix:
        """Return set-points or motor positions (..., motors) [SI] as scaled ones."""
        return np.asarray((values - self.motor_rest) / self.motor_unit)

    def unscale_motors(self, values: Matrix) -> Matrix:
        """Return scaled set-points or motor positions (..., motors) in SI."""
        return np.asarray(self.motor_rest + self.motor_unit * values)

    def scale_outputs(self, values: Matrix) -> Matrix:
        """Return outputs (..., outputs) [SI] as scaled ones."""
        return np.asarray((values - self.output_rest) / self.output_unit)

    def unscale_outputs(self, values: Matrix) -> Matrix:
        """Return scaled outputs (..., outputs) in SI."""
        return np.asarray(self.output_rest + self.output_unit * values)

    def input_units(self, weights: Matrix) -> Vector:
        """Return the units (outputs,) of redefined inputs in SI, in which every direction has the norm of theta_i.

        Args:
            weights: (outputs, motors) of the motors in each output's direction.
        """
        pull = np.linalg.norm(weights, axis=1) / _INPUT_WEIGHT
        # The ratio is rounded, so that the rounding of the norm leaves the neck's at exactly one.
        return self.motor_unit * np.exp2(round_scaled(np.log2(pull)))

    def scale_seconds(self, seconds: float) -> float:
        """Return a time [s] in scaled seconds."""
        return seconds / self.second

    def unscale_seconds(self, seconds: float) -> float:
        """Return scaled seconds in seconds."""
        return seconds * self.second


def scaled_robot(robot: Robot, scaling: Scaling) -> Robot:
    """Return the robot in scaled quantities: dimensionless, with the size and time constant of the preset `neck`."""
    motors, outputs = robot.motors, robot.outputs
    per, out = to_si(motors.unit)[0] / scaling.motor_unit, to_si(outputs.unit)[0]

    def convert(values: tuple[float, ...] | None, scale: Callable[[Vector], Matrix], factor: float) -> Any:
        return None if values is None else tuple(scale(factor * np.array(values)).tolist())

    return replace(
        robot,
        motors=replace(
            motors, unit="1", sign=(1.0,) * len(motors.names), nominal=(1.0,) * len(motors.names),
            rest=(0.0,) * len(motors.names),
            rate_limit=None if motors.rate_limit is None else tuple(
                rate * per * scaling.second for rate in motors.rate_limit),
            setpoint_min=convert(motors.setpoint_min, scaling.scale_motors, to_si(motors.unit)[0]),
            setpoint_max=convert(motors.setpoint_max, scaling.scale_motors, to_si(motors.unit)[0]),
        ),
        outputs=replace(
            outputs, unit="1", display_unit="1", nominal=(1.0,) * len(outputs.names), rest=(0.0,) * len(outputs.names),
            min=convert(outputs.min, scaling.scale_outputs, out), max=convert(outputs.max, scaling.scale_outputs, out),
        ),
        sample_time_s=None if robot.sample_time_s is None else scaling.scale_seconds(robot.sample_time_s),
        time_constant_s=TIME_CONSTANT,
        noise_std=None if robot.noise_std is None else robot.noise_std * out / float(scaling.output_unit.max()),
        delay_s=None if robot.delay_s is None else scaling.scale_seconds(robot.delay_s),
        rate_hz=None if robot.rate_hz is None else robot.rate_hz * scaling.second,
    )  # fmt: skip


def round_scaled(values: Matrix) -> Matrix:
    """Return scaled data rounded to 2^-40: far below any sensor's resolution, far above the rounding of a unit."""
    return np.round(values / _SCALED_RESOLUTION) * _SCALED_RESOLUTION


def _sizes(
    factor: float, nominal: tuple[float, ...] | None, rest: tuple[float, ...] | None, low: tuple[float, ...] | None,
    high: tuple[float, ...] | None, data: Matrix | None, half_range: float, count: int,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Return unit and rest (count,) in SI."""
    known = np.zeros((1, count)) if data is None else np.where(np.isfinite(data).any(axis=0), data, 0.0)
    middle = np.nanmean(known, axis=0) if rest is None else factor * np.array(rest)
    if nominal is not None:
        return factor * np.array(nominal), middle
    if low is not None and high is not None:
        return factor * (np.array(high) - np.array(low)) / (2.0 * half_range), middle
    spans = np.ones(count) if data is None else np.nanmax(known, axis=0) - np.nanmin(known, axis=0)
    units = spans / (1.0 if data is None else 2.0 * half_range)
    return np.where(units > 0.0, units, 1.0), middle
