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
    require_whole,
    to_si,
)
from softneck.identification import Model
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ._axis import AxisPlant, HasTransferFunctions, axis_plant, directions_of, robot_of
from ._forms import (
    FORMS,
    NOISES,
    FilterMatrices,
    Reach,
    gyro_form,
    model_form,
    noise_units,
)
from ._kalman import KalmanObserver
from ._kalman_parts_runtime import KALMAN_LAG, KALMAN_MORE_LAGS
from ._nonlinear import NonlinearObserver, is_nonlinear
from ._reach import linear_reach, simulated_reach
from ._sensors import find_sensor

ORDERS = ("sequential", "jacobi")
# Sample times and delays that are whole multiples but for the rounding of decimal fractions.
_ROUNDING = 1e-6
_WHAT = "an observer"
_NECK_PERIOD = 0.02
# A sensor that gives a sample every 20 ms is given up after 0.1 s without one.
_MISSED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanSettings:
    """Kalman filter of pitch and roll, or of another robot's outputs, in one of three forms.

    "model": the angle is what an identified linear model makes of the delayed set-points plus a disturbance that
    walks. "gyro": the angle rises by what the gyro says minus a bias that walks. "nonlinear": the angle is what a
    nonlinear model makes of the set-points in free run plus a disturbance that walks as far as the model moves; "model"
    is this form where the model is nonlinear. Measurement noise is white.

    The defaults are the neck's. Of another robot noise, delay and rate of the sensor are those of its file, and the
    other levels follow from how far and how fast its outputs go; those given are in the unit of its outputs, angles in
    rad.

    Attributes:
        form: "model", "gyro" or "nonlinear".
        sensor: preset of the measurement noise: "mpu9250", "3dm-gx5-10", "paper".
        measurement_noise_std: [rad]; None for that of the sensor.
        model_noise_std: "model": of the model's angle, added each sample [rad].
        disturbance_noise_std: "model": step of the disturbance's walk, each sample [rad].
        gyro_noise_std: "gyro": of the rates, with what their alignment misses [rad/s]; None for thrice the sensor's.
        bias_noise_std: "gyro": step of the bias's walk, each sample [rad/s].
        rest_noise_std: "nonlinear": step of the disturbance's walk at rest, each sample [rad].
        motion_noise_ratio: "nonlinear": that step over the model's fastest motion in a sample of late.
        slew_ratio: "nonlinear": set-points move the model by at most so many times `motors.rate_limit` of the robot's
            file, where it has one; inf: as they come.
        sample_time: of the loop [s]; None for that of the model. Must divide the model's.
        sensor_period: of the inclinometer [s], a multiple of the sample time; None: a new sample each time.
        sensor_delay: how late measurements are [s]; the estimate is then of the angle now. 0 estimates the angle at
            the instant of the measurement, for which controllers of a neck are designed. Of another robot and in form
            "nonlinear" it is that of the sensor, else of the robot's file, where nobody gives it.
        gyro_delay: how late the gyro's rates are [s], at most the sensor's delay; where neither is given, they are of
            one sensor and equally late.
        gate_level: part of good measurements that the gate lets pass, chi-square with 2 degrees of freedom.
        max_rejections: after so many in a row the next measurement is taken in by force.
        healthy_timeout: [s] without an accepted measurement until `healthy` goes false.
        frozen_samples: so many identical samples are a frozen sensor: not used, not healthy. 0: never.
        order: of the loop it will run in; in "jacobi" the observer sees set-points one sample younger.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    form: str = "model"
    sensor: str = "paper"
    measurement_noise_std: float | None = None
    # The neck moves by up to 0.8 deg in 20 ms, and a fit to large moves is some 20 % off in small ones.
    model_noise_std: float = NeckDefault(math.radians(0.15))
    # What a linear model misses of a neck in fast motion, in a sample: as much as the neck moves. Chosen by
    # `benchmarks/leave_one_neck_out.py observer.disturbance_noise_std`.
    disturbance_noise_std: float = NeckDefault(math.radians(1.5))
    gyro_noise_std: float | None = None
    # A bias that wanders by 0.2 deg/s in some 10 s.
    bias_noise_std: float = NeckDefault(math.radians(0.01))
    # All necks choose a ratio of 1 (`benchmarks/leave_one_neck_out.py nonlinear.motion_noise_ratio`); the level at rest
    # is worth 2 % between 0.02 and 0.5 deg (`.rest_noise_std`), and this one is quiet.
    rest_noise_std: float = NeckDefault(math.radians(0.1))
    motion_noise_ratio: float = 1.0
    slew_ratio: float = 1.0
    sample_time: float | None = None
    sensor_period: float | None = None
    # A look-ahead by 50 ms makes designs on one `oe` swing, whether they know of it or not: `docs/howto/observer.md`.
    sensor_delay: float = NeckDefault(0.0)
    gyro_delay: float = NeckDefault(0.0)
    gate_level: float = 0.9999
    max_rejections: int = 10
    healthy_timeout: float = NeckDefault(0.1)
    frozen_samples: int = 20
    order: str = "sequential"
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        require_one_of("form", self.form, FORMS)
        find_sensor(self.sensor)
        for names in NOISES.values():
            for name, unit in names:
                if getattr(self, name) is not None:
                    require_positive(name, getattr(self, name), unit)
        if not self.slew_ratio > 0.0:
            raise SettingsError(f"`slew_ratio` must be positive, or inf; got {self.slew_ratio:g}.")
        for name in ("sample_time", "sensor_period"):
            if getattr(self, name) is not None:
                require_positive(name, getattr(self, name), "s")
        require_between("sensor_delay", self.sensor_delay, 0.0, 1.0, "s")
        require_between("gyro_delay", self.gyro_delay, 0.0, 1.0, "s")
        if self.gyro_delay > self.sensor_delay and not isinstance(self.sensor_delay, NeckDefault):
            raise SettingsError(
                f"`gyro_delay` {self.gyro_delay:g} s must be at most `sensor_delay`, {self.sensor_delay:g} s: the "
                "rates between two measurements must be known when the second comes."
            )
        require_between("gate_level", self.gate_level, 0.5, 1.0 - 1e-12)
        require_between("max_rejections", self.max_rejections, 0, 1_000_000)
        require_positive("healthy_timeout", self.healthy_timeout, "s")
        require_whole("frozen_samples", self.frozen_samples, 0, 1_000_000)
        require_one_of("order", self.order, ORDERS)

    @property
    def noise(self) -> tuple[float, float, float]:
        """The noise levels that hold, in the order of the form's."""
        sensor = find_sensor(self.sensor)
        preset = {"measurement_noise_std": sensor.noise_std, "gyro_noise_std": 3.0 * sensor.gyro_noise_std}
        first, second, third = (
            preset[name] if getattr(self, name) is None else float(getattr(self, name)) for name, _ in NOISES[self.form]
        )
        return first, second, third

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
        if robot.is_neck:
            reach, noise = Reach(), asked.noise
            sensor = self.sensor if self.measurement_noise_std is None else "none"
        else:
            reach = simulated_reach(model)
            noise, sensor = asked.robot_noise(robot, reach, period)
        return NonlinearObserver(
            model=model,
            noise=noise,
            constants=asked.robot_timing(robot, period).constants((0,) * len(robot.outputs.names), period),
            start=reach.start,
            slew=self._slew(robot),
            sensor=sensor,
            order=self.order,
            gate_level=self.gate_level,
            delay_source=asked._delay_source(robot),
        )

    def _slew(self, robot: Robot) -> tuple[float, ...] | None:
        """Return how fast set-points move the model at most [SI/s], None without a limit."""
        limits, factor = robot.motors.rate_limit, to_si(robot.motors.unit)[0]
        if limits is None or math.isinf(self.slew_ratio):
            return None
        return tuple(self.slew_ratio * factor * limit for limit in limits)

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
        if robot.is_neck:
            asked, reach, noise = self.of_neck(), Reach(), self.noise
            sensor = self.sensor if self.measurement_noise_std is None else "none"
        else:
            asked, reach = self.robot_timing(robot, period), linear_reach(plants, robot, directions_of(model))
            noise, sensor = self.robot_noise(robot, reach, period)
        constants = asked.constants([plant.delay for plant in plants], period, reach)
        arrays = self._form(plants, period, reach).arrays(self._sources(robot, model), constants)
        return KalmanObserver(
            form=self.form,
            sample_time=period,
            arrays=arrays,
            noise=noise,
            sensor=sensor,
            order=self.order,
            gate_level=self.gate_level,
            robot=robot,
            delay_source=self._delay_source(robot),
        )

    def _delay_source(self, robot: Robot) -> str:
        if (robot.is_neck and self.form != "nonlinear") or not isinstance(self.sensor_delay, NeckDefault):
            return "given"
        return "robot" if find_sensor(self.sensor).delay is None else "sensor"

    def of_neck(self) -> KalmanSettings:
        """Return the settings, which must be a neck's.

        Raises:
            SettingsError: noise levels beyond pi, or rates later than the angles.
        """
        for name, unit in {pair for names in NOISES.values() for pair in names}:
            value = getattr(self, name)
            if unit == "rad" and value is not None and value > math.pi:
                raise SettingsError(f"`{name}` is a standard deviation in rad; got {value:g}: degrees?")
        return self._late(float(self.sensor_delay)) if isinstance(self.sensor_delay, NeckDefault) else self

    def _late(self, delay: float) -> KalmanSettings:
        """Return the settings of a sensor whose delay nobody gave: its rates come with its angles."""
        gyro = delay if isinstance(self.gyro_delay, NeckDefault) and self.form == "gyro" else self.gyro_delay
        return replace(self, sensor_delay=max(delay, gyro), gyro_delay=float(gyro))

    def robot_timing(self, robot: Robot, period: float) -> KalmanSettings:
        """Return the settings with delay and rate of the robot's sensor, where nobody says otherwise.

        Raises:
            SettingsError: the robot gives no delay or rate of its sensor.
        """
        delay, wait, timeout = self.sensor_delay, self.sensor_period, self.healthy_timeout
        if isinstance(delay, NeckDefault):
            known = find_sensor(self.sensor).delay
            late = self._late(float(robot.require("delay_s", _WHAT) if known is None else known))
            return replace(late, form=self.form).robot_timing(robot, period)
        if wait is None:
            # Whole samples, and no more than the sensor takes: what it holds counts as an old sample that long.
            wait = period * max(1, math.floor(1.0 / (float(robot.require("rate_hz", _WHAT)) * period) + 1e-6))
        if isinstance(timeout, NeckDefault):
            timeout = _MISSED * wait
        return replace(self, sensor_delay=float(delay), sensor_period=wait, healthy_timeout=float(timeout))

    def robot_noise(self, robot: Robot, reach: Reach, period: float) -> tuple[tuple[float, float, float], str]:
        """Return the noise levels of the form in SI, and which sensor they are of.

        Levels that are given are in the unit of the robot's outputs (angles in rad), those that are not are the neck's,
        stretched by how far and how fast the outputs go.

        Raises:
            SettingsError: a level that neither the robot's file nor a setting says.
        """
        factor, si = to_si(robot.outputs.unit)
        moved = reach.rate / Reach().rate
        scales = {
            "model_noise_std": moved * period / _NECK_PERIOD, "disturbance_noise_std": moved * period / _NECK_PERIOD,
            "bias_noise_std": moved, "rest_noise_std": moved * period / _NECK_PERIOD,
        }  # fmt: skip
        preset = None if self.sensor == "paper" else find_sensor(self.sensor)
        if preset is not None and si != "rad":
            raise SettingsError(f"`sensor` {self.sensor} measures angles, robot {robot.label()} has none; drop it.")
        levels, sensor = [], self.sensor if preset is not None else "robot"
        for name, unit in noise_units(self.form, robot):
            value = getattr(self, name)
            if isinstance(value, NeckDefault):
                levels.append(float(value) * scales[name])
            elif value is not None:
                levels.append(float(value) if si == "rad" or not unit else factor * float(value))
                sensor = "none" if name == "measurement_noise_std" else sensor
            elif name == "measurement_noise_std":
                told = preset.noise_std if preset is not None else factor * float(robot.require("noise_std", _WHAT))
                if not told > 0.0:
                    raise SettingsError(
                        f"robot {robot.label()} gives `sensor.noise_std` = 0, and {_WHAT} needs a positive one; raise "
                        f"it, or give `{name}`."
                    )
                levels.append(told)
            elif preset is not None:
                levels.append(3.0 * preset.gyro_noise_std)
            else:
                raise SettingsError(f"robot {robot.label()} says nothing of its rates' noise; give `{name}` [{unit}].")
        return (levels[0], levels[1], levels[2]), sensor

    def _form(self, plants: list[AxisPlant], period: float, reach: Reach) -> FilterMatrices:
        if self.form == "model":
            return model_form(plants, reach)
        return gyro_form(period, len(plants), reach)

    def _sources(self, robot: Robot, model: HasTransferFunctions) -> Matrix:
        if self.form == "gyro":
            return np.eye(len(robot.outputs.names))
        return redefinition_matrix(np.array(self.tendon_angles))[:2] if robot.is_neck else directions_of(model)

    def constants(self, delays: Sequence[int], period: float, reach: Reach | None = None) -> Vector:
        """Return the constants in the places that `_kalman_parts_runtime` names.

        Args:
            delays: samples that set-points need to act on each output, beyond the first.
            period: the filter's sample time [s].
            reach: how fast the outputs go; None: as fast as the neck's.
        """
        from scipy.stats import chi2

        lags = [0.0 for _ in delays]
        if self.form in ("model", "nonlinear"):
            lags = [delay + float(self.order == "jacobi") for delay in delays]
        if self.form == "gyro":
            # Between two measurements acts the mean of the rates at both ends: half a sample ago.
            lags = [0.5 + (self.sensor_delay - self.gyro_delay) / period] * len(delays)
        gate = float(chi2.ppf(self.gate_level, df=len(delays)))
        timeout = math.ceil(self.healthy_timeout / period - 1e-9)
        lead = self.sensor_delay / period
        lead = round(lead) if abs(lead - round(lead)) < _ROUNDING else lead
        gap = (reach or Reach()).rate * period
        found = np.zeros(KALMAN_MORE_LAGS + max(len(lags) - 2, 0))
        found[KALMAN_LAG : KALMAN_LAG + min(len(lags), 2)] = lags[:2]
        found[2:KALMAN_MORE_LAGS] = (
            gate, self.max_rejections, timeout, period, lead, self._divider(period), self.frozen_samples,
            float(self.form == "gyro"), gap,
        )  # fmt: skip
        found[KALMAN_MORE_LAGS:] = lags[2:]
        return found

    def _divider(self, period: float) -> int:
        if self.sensor_period is None:
            return 1
        divider = round(self.sensor_period / period)
        if divider < 1 or not math.isclose(divider * period, self.sensor_period, rel_tol=_ROUNDING):
            raise SettingsError(
                f"`sensor_period` {self.sensor_period:g} s must be a multiple of the sample time, {period:g} s, as "
                f"{max(divider, 1) * period:g} s is."
            )
        if divider * period >= self.healthy_timeout:
            raise SettingsError(
                f"`healthy_timeout` {self.healthy_timeout:g} s must be longer than `sensor_period`, "
                f"{self.sensor_period:g} s, or the filter is never healthy."
            )
        return divider
