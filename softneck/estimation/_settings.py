"""Settings of the Kalman filter and how a model becomes one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, require_between, require_one_of, require_positive, to_si
from softneck.identification import Model
from softneck.robot import Robot, Scaling

from ._axis import HasTransferFunctions, axis_plant, directions_of, robot_of
from ._forms import FORMS, RATE, START, gyro_form, model_form
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_MORE_LAGS
from ._nonlinear import NonlinearObserver, is_nonlinear
from ._scaling import model_scaling, plants_scaling

ORDERS = ("sequential", "jacobi")
# Set-points that an observer keeps to predict over its sensor's delay [samples].
_MOST_LEAD = 1000
# Sample times and delays that are whole multiples but for the rounding of decimal fractions.
_ROUNDING = 1e-6
_WHAT = "an observer"
# For which the levels of a sample were chosen, in scaled seconds.
_PERIOD = 0.02
# A sensor is given up after five samples without one, and taken for frozen after so many that are the same.
_MISSED, _FROZEN = 5, 20
# Part of good measurements that the gate lets pass, chi-square; after so many refusals in a row the next is taken in by
# force, for then the filter is wrong.
_GATE, _REJECTIONS = 0.9999, 10
# Scaled levels: of a bias, and of what a sample of `_PERIOD` adds.
_LEVELS = {
    # Outputs move by up to 0.8 deg in a sample, and a fit to large moves is some 20 % off in small ones.
    "model_noise_std": math.radians(0.15),
    # What a linear model misses in fast motion, as much as outputs move. Chosen by
    # `benchmarks/leave_one_neck_out.py observer.disturbance_noise_std`.
    "disturbance_noise_std": math.radians(1.5),
    # A bias that wanders by 0.2 deg/s in some 10 s.
    "bias_noise_std": math.radians(0.01),
    # Worth 2 % of the error between 0.02 and 0.5 deg on all necks, and this one is quiet.
    "rest_noise_std": math.radians(0.1),
}
# Step of the disturbance's walk over the model's fastest motion in a sample of late: all necks choose it.
_MOTION = 1.0
# Of a gyro, with what its alignment misses, over what it says at rest.
_ALIGNED = 3.0


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """An inclinometer.

    Attributes:
        name: what users type.
        noise_std: standard deviation of pitch and of roll at rest [rad].
        gyro_noise_std: standard deviation of its rates from sample to sample [rad/s].
        source: where the numbers come from.
        delay: how late its angles are, with the lag of its filter [s]; None: not known, that of the robot's file holds.
    """

    name: str
    noise_std: float
    gyro_noise_std: float
    source: str
    delay: float | None = None


# Upper ends of what the recordings show on plateaus: a filter that trusts too little lags a little,
# one that trusts too much rejects good samples. Rates were not recorded: data sheet class.
SENSORS: dict[str, SensorNoise] = {
    sensor.name: sensor
    for sensor in (
        SensorNoise(
            "mpu9250",
            math.radians(0.29),
            math.radians(0.1),
            "Arduino with MPU-9250: 0.26 to 0.29 deg on plateaus of the recordings; rates: data sheet class",
        ),
        SensorNoise(
            "3dm-gx5-10",
            math.radians(0.04),
            math.radians(0.05),
            "3DM-GX5-10, 50 Hz: 0.02 to 0.04 deg on plateaus of the recordings; rates: data sheet class",
            delay=0.015,  # 10 ms behind a filter of 5 ms, as the virtual one has
        ),
        SensorNoise(
            "paper", math.radians(0.05), math.radians(0.1), "the virtual neck's inclinometer in the paper preset"
        ),
    )
}


def find_sensor(name: str) -> SensorNoise:
    """Return the sensor of that name; raise SettingsError with the known ones if there is none."""
    try:
        return SENSORS[name]
    except KeyError:
        raise SettingsError(f"unknown sensor `{name}`; use one of {', '.join(SENSORS)}.") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanSettings:
    """Kalman filter of a robot's outputs in one of three forms.

    "model": the output is what an identified linear model makes of the delayed set-points plus a disturbance that
    walks. "gyro": the angle rises by what the gyro says minus a bias that walks. "nonlinear": the output is what a
    nonlinear model makes of the set-points in free run plus a disturbance that walks as far as the model moves; "model"
    is this form where the model is nonlinear. Measurement noise is white.

    Noise and rate of the sensor are those of the robot's file; other levels follow from how far and how fast its
    outputs go. What is given is in the unit of its outputs, angles in rad. All levels are parameters of the block.

    Attributes:
        form: "model", "gyro" or "nonlinear".
        sensor: preset of an inclinometer's noise: "mpu9250", "3dm-gx5-10"; with "paper" that of the robot's file.
        measurement_noise_std: [rad]; None for that of the sensor.
        disturbance_noise_std: "model": step of the disturbance's walk, each sample [rad]; None: as far as outputs move.
        sample_time: of the loop [s]; None for that of the model. Must divide the model's.
        sensor_delay: how late measurements are [s]; the estimate is then of the output now. None estimates it at the
            instant of the measurement, for which controllers are designed; in form "nonlinear" it is that of the
            sensor, else of the robot's file.
        gyro_delay: how late the gyro's rates are [s], at most the sensor's delay; where neither is given, they are of
            one sensor and equally late.
        order: of the loop it will run in; in "jacobi" the observer sees set-points one sample younger.
    """

    form: str = "model"
    sensor: str = "paper"
    measurement_noise_std: float | None = None
    disturbance_noise_std: float | None = None
    sample_time: float | None = None
    # A look-ahead by 50 ms makes designs on one `oe` swing, whether they know of it or not: `docs/howto/observer.md`.
    sensor_delay: float | None = None
    gyro_delay: float | None = None
    order: str = "sequential"

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        find_sensor(self.sensor)
        for name, unit in (("measurement_noise_std", "rad"), ("disturbance_noise_std", "rad"), ("sample_time", "s")):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name), unit)
        for name in ("sensor_delay", "gyro_delay"):
            if getattr(self, name) is not None:
                require_between(name, getattr(self, name), 0.0, 1e6, "s")
        if self.sensor_delay is not None and (self.gyro_delay or 0.0) > self.sensor_delay:
            raise SettingsError(
                f"`gyro_delay` {self.gyro_delay:g} s must be at most `sensor_delay`, {self.sensor_delay:g} s: the "
                "rates between two measurements must be known when the second comes."
            )
        require_one_of("order", self.order, ORDERS)

    def design(self, model: Model | HasTransferFunctions) -> Any:
        """Return the filter for `model`: a `KalmanObserver`, of form "nonlinear" a `NonlinearObserver`.

        Args:
            model: an identified one of any kind, or anything with `tf("pitch")` and `tf("roll")`, or of another robot's
                outputs.

        Raises:
            SettingsError: a linear model that is not discrete and stable, axes of different sample times, times that
                do not divide, what another robot's file does not say of its sensor and motors, or form "nonlinear"
                over anything but an identified model.
        """
        if self.form == "nonlinear" or (self.form == "model" and is_nonlinear(model)):
            return self._over_nonlinear(model)
        return self._over_linear(model)

    def _over_nonlinear(self, model: Any) -> NonlinearObserver:
        if not isinstance(model, Model):
            raise SettingsError(f"form nonlinear needs an identified model; got {type(model).__name__}.")
        if self.sample_time is not None and not math.isclose(self.sample_time, model.sample_time, rel_tol=_ROUNDING):
            raise SettingsError(
                f"`sample_time` {self.sample_time:g} s must be the model's, {model.sample_time:g} s: a nonlinear model "
                "cannot be taken to another. Resample the recording and identify again."
            )
        asked, robot, period = replace(self, form="nonlinear"), model.robot, model.sample_time
        scaling = model_scaling(model)
        usual = find_sensor(self.sensor).delay
        delay, gyro = asked._delays(float(robot.require("delay_s", _WHAT) if usual is None else usual))
        noise, sensor = asked.levels(robot, scaling, period)
        return NonlinearObserver(
            model=model,
            noise=noise,
            constants=asked.constants([0] * len(robot.outputs.names), (delay, gyro), period, robot, scaling),
            start=START * float(scaling.output_unit.max()),
            slew=_slew(robot),
            sensor=sensor,
            order=self.order,
            gate_level=_GATE,
            delay_source="given" if self.sensor_delay is not None else "robot" if usual is None else "sensor",
        )

    def _over_linear(self, model: HasTransferFunctions) -> KalmanObserver:
        robot, directions = robot_of(model), directions_of(model)
        names = robot.outputs.names
        plants = [axis_plant(model, axis) for axis in names]
        times = [plant.sample_time for plant in plants]
        if not all(math.isclose(times[0], time, rel_tol=1e-9) for time in times):
            each = " and ".join(f"{time:g} s" for time in times)
            raise SettingsError(f"{' and '.join(names)} have different sample times, {each}.")
        period = times[0] if self.sample_time is None else self.sample_time
        plants = [plant.resampled(period) for plant in plants]
        scaling = plants_scaling(robot, plants, directions, _WHAT)
        noise, sensor = self.levels(robot, scaling, period)
        constants = self.constants([plant.delay for plant in plants], self._delays(0.0), period, robot, scaling)
        gyro = self.form == "gyro"
        form = gyro_form(period, scaling) if gyro else model_form(plants, scaling, scaling.input_units(directions))
        return KalmanObserver(
            form=self.form,
            sample_time=period,
            arrays=form.arrays(np.eye(len(names)) if gyro else directions, constants),
            noise=noise,
            sensor=sensor,
            order=self.order,
            gate_level=_GATE,
            robot=robot,
        )

    def _delays(self, usual: float) -> tuple[float, float]:
        """Return the delays [s] of the sensor and of the gyro; `usual` where none is set."""
        delay = usual if self.sensor_delay is None else self.sensor_delay
        # Where neither is given: the rates come with the angles.
        shared = delay if self.sensor_delay is None and self.form == "gyro" else 0.0
        gyro = shared if self.gyro_delay is None else self.gyro_delay
        return max(delay, gyro), gyro

    def levels(self, robot: Robot, scaling: Scaling, period: float) -> tuple[tuple[float, float, float], str]:
        """Return the noise levels of the form in SI, and which sensor they are of.

        Raises:
            SettingsError: a level that neither the robot's file nor a setting says, or that is in degrees.
        """
        (factor, si), preset = to_si(robot.outputs.unit), find_sensor(self.sensor)
        angles, size = si == "rad", float(scaling.output_unit.max())
        for name in ("measurement_noise_std", "disturbance_noise_std"):
            if angles and (getattr(self, name) or 0.0) > math.pi:
                raise SettingsError(f"`{name}` is a standard deviation in rad; got {getattr(self, name):g}: degrees?")
        if not angles and (self.sensor != "paper" or self.form == "gyro"):
            what = f"`sensor` {self.sensor}" if self.sensor != "paper" else "a gyro"
            raise SettingsError(f"{what} measures angles, robot {robot.label()} has none; drop it.")
        first, sensor = self._measurement(robot, preset, 1.0 if angles else factor)
        in_a_sample = size * (period / (_PERIOD * scaling.second))
        if self.form == "nonlinear":
            return (first, _LEVELS["rest_noise_std"] * in_a_sample, _MOTION), sensor
        if self.form == "gyro":
            bias = _LEVELS["bias_noise_std"] * (size / scaling.second)
            return (first, _ALIGNED * preset.gyro_noise_std, bias), sensor
        walk = self.disturbance_noise_std
        given = None if walk is None else (1.0 if angles else factor) * float(walk)
        second = _LEVELS["disturbance_noise_std"] * in_a_sample if given is None else given
        return (first, _LEVELS["model_noise_std"] * in_a_sample, second), sensor

    def _measurement(self, robot: Robot, preset: SensorNoise, unit: float) -> tuple[float, str]:
        """Return the sensor's noise in SI, and where it is from; what is given is in `unit`."""
        if self.measurement_noise_std is not None:
            return unit * float(self.measurement_noise_std), "none"
        if self.sensor != "paper":
            return preset.noise_std, self.sensor
        noise = to_si(robot.outputs.unit)[0] * float(robot.require("noise_std", _WHAT))
        if not noise > 0.0:
            raise SettingsError(
                f"robot {robot.label()} gives `sensor.noise_std` = 0, and {_WHAT} needs a positive one; raise "
                "it, or give `measurement_noise_std`."
            )
        return noise, "paper" if noise == preset.noise_std else "robot"

    def constants(
        self, delays: Sequence[int], late: tuple[float, float], period: float, robot: Robot, scaling: Scaling
    ) -> Vector:
        """Return the constants in the places that `_kalman_parts_runtime` names.

        Args:
            delays: samples that set-points need to act on each output, beyond the first.
            late: how late measurements and the gyro's rates are [s].
            period: the filter's sample time [s].
            robot: whose sensor it is.
            scaling: of the robot.
        """
        from scipy.stats import chi2

        gyro = self.form == "gyro"
        # Between two measurements acts the mean of the rates at both ends: half a sample ago.
        newer, more = 0.5 + (late[0] - late[1]) / period, float(self.order == "jacobi")
        lags = [newer if gyro else delay + more for delay in delays]
        # Whole samples, and no more than the sensor takes: what it holds counts as an old sample that long.
        divider = max(1, math.floor(1.0 / ((robot.rate_hz or 1.0 / period) * period) + 1e-6))
        lead = late[0] / period
        if lead > _MOST_LEAD:
            raise SettingsError(
                f"`sensor_delay` of {late[0]:g} s is {lead:.0f} samples of {period:g} s; at most {_MOST_LEAD} fit."
            )
        lead = round(lead) if abs(lead - round(lead)) < _ROUNDING else lead
        gap = RATE * float(scaling.output_unit.max()) / scaling.second * period
        found = np.zeros(KALMAN_MORE_LAGS + max(len(lags) - 2, 0))
        found[KALMAN_LAG : KALMAN_LAG + min(len(lags), 2)] = lags[:2]
        found[2:KALMAN_MORE_LAGS] = (
            float(chi2.ppf(_GATE, df=len(delays))), _REJECTIONS, _MISSED * divider, period, lead, divider, _FROZEN,
            float(gyro), gap,
        )  # fmt: skip
        found[KALMAN_MORE_LAGS:] = lags[2:]
        return found


def _slew(robot: Robot) -> tuple[float, ...] | None:
    """Return how fast set-points move a model at most [SI/s], None without a limit."""
    limits, factor = robot.motors.rate_limit, to_si(robot.motors.unit)[0]
    return None if limits is None else tuple(factor * limit for limit in limits)
