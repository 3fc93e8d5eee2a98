"""Settings of the Kalman filter, and the design of a filter from a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, require_between, require_one_of, require_positive, to_si
from softneck.identification import Model
from softneck.robot import Robot, Scaling

from ._axis import HasTransferFunctions, axis_plant, directions_of, model_scaling, plants_scaling, robot_of
from ._forms import FORMS, NECK_REACH, RATE_STD, gyro_form, model_form
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_MORE_LAGS
from ._nonlinear import NonlinearObserver, is_nonlinear

ORDERS = ("sequential", "jacobi")
# Longest delay of the sensor that an observer predicts over [samples].
_MAX_LEAD_SAMPLES = 1000
# Rounding of decimal fractions in sample times and delays.
_TIME_TOLERANCE = 1e-6
_NAME_IN_MESSAGES = "an observer"
# Sample time that the levels below are for [scaled s].
_NOMINAL_PERIOD_S = 0.02
# A sensor is lost after 5 samples without a measurement, and frozen after 20 identical ones.
_MISSED_SAMPLES, _FROZEN_SAMPLES = 5, 20
# Share of good measurements that pass the chi-square gate. After 10 rejections in a row the filter is wrong, and the
# next measurement passes without the gate.
_GATE_LEVEL, _MAX_REJECTIONS = 0.9999, 10
# Scaled standard deviations of a step in one nominal sample.
_LEVELS = {
    # Outputs move by up to 0.8 deg in a sample, and a fit to large moves has an error of some 20 % in small ones.
    "model_noise_std": math.radians(0.15),
    # Error of a linear model in fast motion: as large as the motion. Chosen by
    # `benchmarks/leave_one_neck_out.py observer.disturbance_noise_std`.
    "disturbance_noise_std": math.radians(1.5),
    # A bias that drifts by 0.2 deg/s in some 10 s.
    "bias_noise_std": math.radians(0.01),
    # From 0.02 to 0.5 deg the error changes by 2 % on all necks; 0.1 deg gives quiet estimates.
    "rest_noise_std": math.radians(0.1),
}
# Step of the disturbance over the model's recent motion in a sample. 0.4 is best on all necks, by 3 %; over a model of
# 0 kg that carries 0.3 to 1 kg it has 9 % more error.
_MOTION_NOISE_RATIO = 0.6
# Scaled standard deviation of how much later or earlier than the model a robot moves: from 14 to 30 ms the error
# changes by 1.5 %.
_TIMING_STD_S = 0.02
# Noise of a gyro in motion, with its misalignment, over its noise at rest.
_GYRO_NOISE_FACTOR = 3.0


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """An inclinometer.

    noise_std: of pitch and of roll at rest [rad]; gyro_noise_std: of its rates from sample to sample [rad/s]; delay: of
    its angles, with the lag of its filter [s]; None: unknown, the robot's file is used.
    """

    name: str
    noise_std: float
    gyro_noise_std: float
    source: str
    delay: float | None = None


# Upper ends of the noise on plateaus of the recordings: too large a level adds a little lag, too small a level rejects
# good samples. Rates were not recorded: they are of the data sheet's class.
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
            delay=0.015,  # 10 ms after a filter of 5 ms, as in the virtual neck
        ),
        SensorNoise(
            "paper", math.radians(0.05), math.radians(0.1), "the virtual neck's inclinometer in the paper preset"
        ),
    )
}


def find_sensor(name: str) -> SensorNoise:
    """Return the sensor of a name; raise SettingsError with the known names if there is none."""
    try:
        return SENSORS[name]
    except KeyError:
        raise SettingsError(f"unknown sensor `{name}`; use one of {', '.join(SENSORS)}.") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanSettings:
    """Kalman filter of a robot's outputs in one of three forms.

    "model": the output is that of an identified linear model of the delayed set-points, plus a random-walk disturbance.
    "gyro": the angle is the integral of the gyro's rate minus a random-walk bias. "nonlinear": the output is the
    simulation of a nonlinear model, plus a random-walk disturbance whose step grows with the model's motion; "model" is
    this form if the model is nonlinear. Measurement noise is white.

    Noise and rate of the sensor are those of the robot's file, the noise at least that of the recordings of a nonlinear
    model; other levels follow from the range and the speed of its outputs. Levels are given in the unit of its outputs,
    angles in rad. All levels are parameters of the block.

    Attributes:
        form: "model", "gyro" or "nonlinear".
        sensor: preset of an inclinometer's noise: "mpu9250", "3dm-gx5-10"; with "paper" that of the robot's file.
        measurement_noise_std: [rad]; None for that of the sensor.
        disturbance_noise_std: "model": step of the disturbance in each sample [rad]; None: from the outputs' motion.
        sample_time: of the loop [s]; None for that of the model. Must divide the model's.
        sensor_delay: delay of measurements [s]; the estimate is then of the output now, with 0 of that at the instant
            of the measurement. None takes the delay of the sensor, else of the robot's file; in form "gyro", and for
            `KalmanSettings.design` over a linear model, 0.
        gyro_delay: delay of the gyro's rates [s], at most the sensor's delay; None for the same delay if `sensor_delay`
            is not given either, else 0.
        order: of the loop that it runs in; in "jacobi" the observer gets set-points one sample earlier.
    """

    form: str = "model"
    sensor: str = "paper"
    measurement_noise_std: float | None = None
    disturbance_noise_std: float | None = None
    sample_time: float | None = None
    # A prediction over 50 ms makes designs on one `oe` oscillate: `docs/howto/observer.md`.
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
                do not divide, a robot file without sensor or motor ranges, or form "nonlinear" without an identified
                model.
        """
        if self.form == "nonlinear" or (self.form == "model" and is_nonlinear(model)):
            return self._over_nonlinear(model)
        return self._over_linear(model)

    def _over_nonlinear(self, model: Any) -> NonlinearObserver:
        if not isinstance(model, Model):
            raise SettingsError(f"form nonlinear needs an identified model; got {type(model).__name__}.")
        if self.sample_time is not None and not math.isclose(
            self.sample_time, model.sample_time, rel_tol=_TIME_TOLERANCE
        ):
            raise SettingsError(
                f"`sample_time` {self.sample_time:g} s must be the model's, {model.sample_time:g} s: a nonlinear model "
                "cannot be taken to another. Resample the recording and identify again."
            )
        own, robot, period = replace(self, form="nonlinear"), model.robot, model.sample_time
        scaling = model_scaling(model)
        usual, source = find_sensor(self.sensor).delay, "sensor"
        if usual is None:
            said = float(robot.require("delay_s", _NAME_IN_MESSAGES))
            usual = _as_recorded(said, model)
            source = "robot" if usual == said else "recording"
        delay, gyro = own._delays(usual)
        noise, sensor = own.levels(robot, scaling, period)
        recorded = max(model.findings.get("sensor", {}).get("noise_std", [0.0]))
        if recorded > noise[0] and sensor in ("paper", "robot"):
            noise, sensor = (recorded, *noise[1:]), "recording"
        return NonlinearObserver(
            model=model,
            noise=noise,
            constants=own.constants([0] * len(robot.outputs.names), (delay, gyro), period, robot, scaling),
            start=NECK_REACH * float(scaling.output_unit.max()),
            timing=_TIMING_STD_S * scaling.second,
            slew=_slew(robot),
            sensor=sensor,
            order=self.order,
            gate_level=_GATE_LEVEL,
            delay_source="given" if self.sensor_delay is not None else source,
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
        plants = [plant.resample(period) for plant in plants]
        scaling = plants_scaling(robot, plants, directions, _NAME_IN_MESSAGES)
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
            gate_level=_GATE_LEVEL,
            robot=robot,
        )

    def _delays(self, usual: float) -> tuple[float, float]:
        """Return the delays [s] of the sensor and of the gyro; `usual` where none is set."""
        delay = usual if self.sensor_delay is None else self.sensor_delay
        # If neither is given, the rates come with the angles.
        shared = delay if self.sensor_delay is None and self.form == "gyro" else 0.0
        gyro = shared if self.gyro_delay is None else self.gyro_delay
        return max(delay, gyro), gyro

    def levels(self, robot: Robot, scaling: Scaling, period: float) -> tuple[tuple[float, float, float], str]:
        """Return the noise levels of the form in SI, and the name of their sensor.

        Raises:
            SettingsError: a level that neither the robot's file nor a setting gives, or that is in degrees.
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
        in_a_sample = size * (period / (_NOMINAL_PERIOD_S * scaling.second))
        if self.form == "nonlinear":
            return (first, _LEVELS["rest_noise_std"] * in_a_sample, _MOTION_NOISE_RATIO), sensor
        if self.form == "gyro":
            bias = _LEVELS["bias_noise_std"] * (size / scaling.second)
            return (first, _GYRO_NOISE_FACTOR * preset.gyro_noise_std, bias), sensor
        walk = self.disturbance_noise_std
        given = None if walk is None else (1.0 if angles else factor) * float(walk)
        second = _LEVELS["disturbance_noise_std"] * in_a_sample if given is None else given
        return (first, _LEVELS["model_noise_std"] * in_a_sample, second), sensor

    def _measurement(self, robot: Robot, preset: SensorNoise, unit: float) -> tuple[float, str]:
        """Return the sensor's noise [SI] and its source; a given level is in `unit` [SI]."""
        if self.measurement_noise_std is not None:
            return unit * float(self.measurement_noise_std), "none"
        if self.sensor != "paper":
            return preset.noise_std, self.sensor
        noise = to_si(robot.outputs.unit)[0] * float(robot.require("noise_std", _NAME_IN_MESSAGES))
        if not noise > 0.0:
            raise SettingsError(
                f"robot {robot.label()} gives `sensor.noise_std` = 0, and {_NAME_IN_MESSAGES} needs a positive one; "
                "raise it, or give `measurement_noise_std`."
            )
        return noise, "paper" if noise == preset.noise_std else "robot"

    def constants(
        self, delays: Sequence[int], late: tuple[float, float], period: float, robot: Robot, scaling: Scaling
    ) -> Vector:
        """Return the constants in the places that `_kalman_parts_runtime` names.

        Args:
            delays: dead time from set-points to each output, beyond the first sample [samples].
            late: delays of measurements and of the gyro's rates [s].
            period: the filter's sample time [s].
            robot: of the sensor.
            scaling: of the robot.
        """
        from scipy.stats import chi2

        gyro = self.form == "gyro"
        # The mean of the rates at both ends of a sample acts: half a sample ago.
        newer, more = 0.5 + (late[0] - late[1]) / period, float(self.order == "jacobi")
        lags = [newer if gyro else delay + more for delay in delays]
        # Whole samples, rounded down: a held value counts as an old sample for so long.
        divider = max(1, math.floor(1.0 / ((robot.rate_hz or 1.0 / period) * period) + 1e-6))
        lead = late[0] / period
        if lead > _MAX_LEAD_SAMPLES:
            raise SettingsError(
                f"`sensor_delay` {late[0]:g} s is {lead:.0f} samples of {period:g} s; at most {_MAX_LEAD_SAMPLES} fit."
            )
        lead = round(lead) if abs(lead - round(lead)) < _TIME_TOLERANCE else lead
        gap = RATE_STD * float(scaling.output_unit.max()) / scaling.second * period
        found = np.zeros(KALMAN_MORE_LAGS + max(len(lags) - 2, 0))
        found[KALMAN_LAG : KALMAN_LAG + min(len(lags), 2)] = lags[:2]
        gate, timeout = float(chi2.ppf(_GATE_LEVEL, df=len(delays))), _MISSED_SAMPLES * divider
        rest = (gate, _MAX_REJECTIONS, timeout, period, lead, divider, _FROZEN_SAMPLES, float(gyro), gap)
        found[2:KALMAN_MORE_LAGS] = rest
        found[KALMAN_MORE_LAGS:] = lags[2:]
        return found


def _as_recorded(said: float, model: Model) -> float:
    """Return the sensor's delay of the robot's file [s], or the nearest that a model's recordings allow; 0 stays."""
    least, most = model.findings.get("sensor_delay_s", (0.0, None))
    nearest = max(said, least) if most is None else min(max(said, least), most)
    return nearest if said > 0.0 else said


def _slew(robot: Robot) -> tuple[float, ...] | None:
    """Return the rate limit of each set-point [SI/s], None without a limit."""
    limits, factor = robot.motors.rate_limit, to_si(robot.motors.unit)[0]
    return None if limits is None else tuple(factor * limit for limit in limits)
