"""Settings of the Kalman filter and how a model becomes one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_one_of,
    require_positive,
    to_si,
)
from softneck.identification import Model
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.signals import redefinition_matrix

from ._axis import AxisPlant, HasTransferFunctions, axis_plant, directions_of, robot_of
from ._forms import (
    FORMS,
    FilterMatrices,
    Reach,
    gyro_form,
    model_form,
)
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_MORE_LAGS
from ._nonlinear import NonlinearObserver, is_nonlinear
from ._reach import linear_reach, simulated_reach

ORDERS = ("sequential", "jacobi")
# Set-points that an observer keeps to predict over its sensor's delay [samples].
_MOST_LEAD = 1000
# Sample times and delays that are whole multiples but for the rounding of decimal fractions.
_ROUNDING = 1e-6
_WHAT = "an observer"
_NECK_PERIOD = 0.02
# A sensor is given up after five samples without one, and taken for frozen after so many that are the same.
_MISSED, _FROZEN = 5, 20
# Part of good measurements that the gate lets pass, chi-square; after so many refusals in a row the next is taken in by
# force, for then the filter is wrong.
_GATE, _REJECTIONS = 0.9999, 10
# Levels of a neck; of another robot they are stretched by how far and how fast its outputs go.
_LEVELS = {
    # The neck moves by up to 0.8 deg in 20 ms, and a fit to large moves is some 20 % off in small ones.
    "model_noise_std": math.radians(0.15),
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
    """Kalman filter of pitch and roll, or of another robot's outputs, in one of three forms.

    "model": the angle is what an identified linear model makes of the delayed set-points plus a disturbance that
    walks. "gyro": the angle rises by what the gyro says minus a bias that walks. "nonlinear": the angle is what a
    nonlinear model makes of the set-points in free run plus a disturbance that walks as far as the model moves; "model"
    is this form where the model is nonlinear. Measurement noise is white.

    The defaults are the neck's. Of another robot noise, delay and rate of the sensor are those of its file, and the
    other levels follow from how far and how fast its outputs go; those given are in the unit of its outputs, angles in
    rad. All levels are parameters of the block.

    Attributes:
        form: "model", "gyro" or "nonlinear".
        sensor: preset of the sensor's noise: "mpu9250", "3dm-gx5-10", "paper".
        measurement_noise_std: [rad]; None for that of the sensor.
        disturbance_noise_std: "model": step of the disturbance's walk, each sample [rad].
        sample_time: of the loop [s]; None for that of the model. Must divide the model's.
        sensor_delay: how late measurements are [s]; the estimate is then of the angle now. 0 estimates the angle at
            the instant of the measurement, for which controllers of a neck are designed. Of another robot and in form
            "nonlinear" it is that of the sensor, else of the robot's file, where nobody gives it.
        gyro_delay: how late the gyro's rates are [s], at most the sensor's delay; where neither is given, they are of
            one sensor and equally late.
        order: of the loop it will run in; in "jacobi" the observer sees set-points one sample younger.
    """

    form: str = "model"
    sensor: str = "paper"
    measurement_noise_std: float | None = None
    # What a linear model misses of a neck in fast motion, in a sample: as much as the neck moves. Chosen by
    # `benchmarks/leave_one_neck_out.py observer.disturbance_noise_std`.
    disturbance_noise_std: float = NeckDefault(math.radians(1.5))
    sample_time: float | None = None
    # A look-ahead by 50 ms makes designs on one `oe` swing, whether they know of it or not: `docs/howto/observer.md`.
    sensor_delay: float = NeckDefault(0.0)
    gyro_delay: float = NeckDefault(0.0)
    order: str = "sequential"

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        find_sensor(self.sensor)
        require_positive("disturbance_noise_std", self.disturbance_noise_std, "rad")
        for name, unit in (("measurement_noise_std", "rad"), ("sample_time", "s")):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name), unit)
        require_between("sensor_delay", self.sensor_delay, 0.0, 1e6, "s")
        require_between("gyro_delay", self.gyro_delay, 0.0, 1e6, "s")
        if self.gyro_delay > self.sensor_delay and not isinstance(self.sensor_delay, NeckDefault):
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
        reach = Reach() if robot.is_neck else simulated_reach(model)
        noise, sensor = asked.levels(robot, reach, period)
        return NonlinearObserver(
            model=model,
            noise=noise,
            constants=asked.timed(robot).constants((0,) * len(robot.outputs.names), period, robot),
            start=reach.start,
            slew=_slew(robot),
            sensor=sensor,
            order=self.order,
            gate_level=_GATE,
            delay_source=asked._delay_source(robot),
        )

    def _over_linear(self, model: HasTransferFunctions) -> KalmanObserver:
        robot = robot_of(model)
        names = robot.outputs.names
        plants = [axis_plant(model, axis) for axis in names]
        times = [plant.sample_time for plant in plants]
        if not all(math.isclose(times[0], time, rel_tol=1e-9) for time in times):
            each = " and ".join(f"{time:g} s" for time in times)
            raise SettingsError(f"{' and '.join(names)} have different sample times, {each}.")
        period = times[0] if self.sample_time is None else self.sample_time
        plants = [plant.resampled(period) for plant in plants]
        asked = self.timed(robot, 0.0 if robot.is_neck else None)
        reach = Reach() if robot.is_neck else linear_reach(plants, robot, directions_of(model))
        noise, sensor = self.levels(robot, reach, period)
        constants = asked.constants([plant.delay for plant in plants], period, robot, reach)
        arrays = self._form(plants, period, reach).arrays(self._sources(robot, model), constants)
        return KalmanObserver(
            form=self.form,
            sample_time=period,
            arrays=arrays,
            noise=noise,
            sensor=sensor,
            order=self.order,
            gate_level=_GATE,
            robot=robot,
            delay_source=self._delay_source(robot),
        )

    def _delay_source(self, robot: Robot) -> str:
        if (robot.is_neck and self.form != "nonlinear") or not isinstance(self.sensor_delay, NeckDefault):
            return "given"
        return "robot" if find_sensor(self.sensor).delay is None else "sensor"

    def timed(self, robot: Robot, usual: float | None = None) -> KalmanSettings:
        """Return the settings with the delay of the robot's sensor, or a `usual` one [s], where nobody says otherwise.

        Raises:
            SettingsError: the robot gives no delay of its sensor.
        """
        if not isinstance(self.sensor_delay, NeckDefault):
            return self
        known = find_sensor(self.sensor).delay if usual is None else usual
        delay = float(robot.require("delay_s", _WHAT) if known is None else known)
        # A sensor whose delay nobody gave: its rates come with its angles.
        gyro = delay if isinstance(self.gyro_delay, NeckDefault) and self.form == "gyro" else float(self.gyro_delay)
        return replace(self, sensor_delay=max(delay, gyro), gyro_delay=gyro)

    def levels(self, robot: Robot, reach: Reach, period: float) -> tuple[tuple[float, float, float], str]:
        """Return the noise levels of the form in SI, and which sensor they are of.

        Raises:
            SettingsError: a level that neither the robot's file nor a setting says, or that is in degrees.
        """
        (factor, si), preset = to_si(robot.outputs.unit), find_sensor(self.sensor)
        given, neck = self.measurement_noise_std, robot.is_neck
        named = neck or self.sensor != "paper"
        if neck and max(given or 0.0, self.disturbance_noise_std) > math.pi:
            name = "measurement_noise_std" if (given or 0.0) > math.pi else "disturbance_noise_std"
            raise SettingsError(f"`{name}` is a standard deviation in rad; got {getattr(self, name):g}: degrees?")
        if self.sensor != "paper" and si != "rad":
            raise SettingsError(f"`sensor` {self.sensor} measures angles, robot {robot.label()} has none; drop it.")
        sensor = "none" if given is not None else self.sensor if named else "robot"
        if given is not None:
            first = float(given) if si == "rad" else factor * float(given)
        elif named:
            first = preset.noise_std
        elif not (first := factor * float(robot.require("noise_std", _WHAT))) > 0.0:
            raise SettingsError(
                f"robot {robot.label()} gives `sensor.noise_std` = 0, and {_WHAT} needs a positive one; raise "
                "it, or give `measurement_noise_std`."
            )
        moved = 1.0 if neck else reach.rate / Reach().rate
        a_sample = moved if neck else moved * period / _NECK_PERIOD
        if self.form == "nonlinear":
            return (first, _LEVELS["rest_noise_std"] * a_sample, _MOTION), sensor
        if self.form == "gyro":
            if not named:
                raise SettingsError(f"robot {robot.label()} says nothing of its rates' noise; give `sensor`.")
            return (first, _ALIGNED * preset.gyro_noise_std, _LEVELS["bias_noise_std"] * moved), sensor
        walk = self.disturbance_noise_std
        if isinstance(walk, NeckDefault):
            second = float(walk) * a_sample
        else:
            second = float(walk) if si == "rad" else factor * float(walk)
        return (first, _LEVELS["model_noise_std"] * a_sample, second), sensor

    def _form(self, plants: list[AxisPlant], period: float, reach: Reach) -> FilterMatrices:
        if self.form == "model":
            return model_form(plants, reach)
        return gyro_form(period, len(plants), reach)

    def _sources(self, robot: Robot, model: HasTransferFunctions) -> Matrix:
        if self.form == "gyro":
            return np.eye(len(robot.outputs.names))
        return redefinition_matrix()[:2] if robot.is_neck else directions_of(model)

    def constants(self, delays: Sequence[int], period: float, robot: Robot, reach: Reach | None = None) -> Vector:
        """Return the constants in the places that `_kalman_parts_runtime` names.

        Args:
            delays: samples that set-points need to act on each output, beyond the first.
            period: the filter's sample time [s].
            robot: whose sensor it is.
            reach: how fast the outputs go; None: as fast as the neck's.
        """
        from scipy.stats import chi2

        lags = [0.0 for _ in delays]
        if self.form in ("model", "nonlinear"):
            lags = [delay + float(self.order == "jacobi") for delay in delays]
        if self.form == "gyro":
            # Between two measurements acts the mean of the rates at both ends: half a sample ago.
            lags = [0.5 + (self.sensor_delay - self.gyro_delay) / period] * len(delays)
        gate = float(chi2.ppf(_GATE, df=len(delays)))
        # Whole samples, and no more than the sensor takes: what it holds counts as an old sample that long.
        rate = 1.0 / period if robot.is_neck and robot.rate_hz is None else float(robot.require("rate_hz", _WHAT))
        divider = max(1, math.floor(1.0 / (rate * period) + 1e-6))
        timeout = _MISSED * divider
        lead = self.sensor_delay / period
        if lead > _MOST_LEAD:
            raise SettingsError(
                f"`sensor_delay` of {self.sensor_delay:g} s is {lead:.0f} samples of {period:g} s; at most "
                f"{_MOST_LEAD} fit."
            )
        lead = round(lead) if abs(lead - round(lead)) < _ROUNDING else lead
        gap = (reach or Reach()).rate * period
        found = np.zeros(KALMAN_MORE_LAGS + max(len(lags) - 2, 0))
        found[KALMAN_LAG : KALMAN_LAG + min(len(lags), 2)] = lags[:2]
        found[2:KALMAN_MORE_LAGS] = (
            gate, _REJECTIONS, timeout, period, lead, divider, _FROZEN,
            float(self.form == "gyro"), gap,
        )  # fmt: skip
        found[KALMAN_MORE_LAGS:] = lags[2:]
        return found


def _slew(robot: Robot) -> tuple[float, ...] | None:
    """Return how fast set-points move a model at most [SI/s], None without a limit."""
    limits, factor = robot.motors.rate_limit, to_si(robot.motors.unit)[0]
    return None if limits is None else tuple(factor * limit for limit in limits)
