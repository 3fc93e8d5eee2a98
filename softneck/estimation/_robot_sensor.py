"""What an observer of another robot than the neck is told: by its file of its sensor, by its model of its motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.identification import Model
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault

from ._axis import AxisPlant
from ._forms import Reach, noise_units

if TYPE_CHECKING:
    from ._settings import KalmanSettings

_WHAT = "an observer"
_NECK, _NECK_PERIOD = Reach(), 0.02
# The paper's neck reaches 40 of the 63 deg that its static gain makes of all motors at their ends.
_REACHED = 0.64
# Motors at random, each level for so many samples: what tells how far and how fast a nonlinear model goes.
_LEVELS, _HELD = 60, 50
# A sensor that gives a sample every 20 ms is given up after 0.1 s without one.
_MISSED = 5


def linear_reach(plants: Sequence[AxisPlant], robot: Robot, weights: Matrix) -> Reach:
    """Return how far and how fast the outputs of a linear model go, by what its motors may do.

    Raises:
        SettingsError: the robot does not say where its set-points end.
    """
    low, high = _ends(robot)
    most = np.abs(weights) @ (0.5 * (high - low))
    spans = [_REACHED * abs(plant.static_gain) * float(v) for plant, v in zip(plants, most, strict=True)]
    # The neck goes as far as it reaches in a second.
    rate = max(span / plant.stretch for span, plant in zip(spans, plants, strict=True))
    return _reach(max(spans), rate)


def simulated_reach(model: Model) -> Reach:
    """Return how far and how fast the outputs of any model go, by a run over the set-points that it was trained on."""
    y = random_run(model, np.random.default_rng(0))
    span = 0.5 * float(np.ptp(y, axis=0).max())
    return _reach(span, float(np.abs(np.diff(y, axis=0)).max()) / model.sample_time)


def random_run(model: Model, rng: np.random.Generator) -> Matrix:
    """Return the outputs (time, outputs) of a free run over levels at random."""
    block, motors = model.block(), len(model.robot.motors.names)
    rows = np.full((_LEVELS * _HELD, len(block.inputs)), np.nan)
    rows[:, :motors] = np.repeat(trained_levels(model, rng, _LEVELS), _HELD, axis=0)
    return block.run(block.initial_state(), rows)[1][:, : len(model.robot.outputs.names)]


def trained_levels(model: Model, rng: np.random.Generator, count: int) -> Matrix:
    """Return set-points (count, motors) within what the model was trained on."""
    ports = model.block().inputs[: len(model.robot.motors.names)]
    low, high = (np.array([getattr(port, end) for port in ports]) for end in ("minimum", "maximum"))
    return rng.uniform(low, high, (count, len(ports)))


def _reach(span: float, rate: float) -> Reach:
    return Reach(start=span, held=span / 3.0, rate=rate, bias=rate * _NECK.bias / _NECK.rate)


def _ends(robot: Robot) -> tuple[Vector, Vector]:
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if motors.setpoint_min is None or motors.setpoint_max is None:
        raise SettingsError(
            f"robot `{robot.name}` gives no `motors.setpoint_min` and `motors.setpoint_max`, which {_WHAT} needs to "
            "know how far its outputs go; add them."
        )
    return factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)


def robot_timing(settings: KalmanSettings, robot: Robot, period: float) -> KalmanSettings:
    """Return the settings with delay and rate of the robot's sensor, where nobody says otherwise.

    Raises:
        SettingsError: the robot gives no delay or rate of its sensor.
    """
    delay, wait, timeout = settings.sensor_delay, settings.sensor_period, settings.healthy_timeout
    if isinstance(delay, NeckDefault):
        delay = max(float(robot.require("delay_s", _WHAT)), settings.gyro_delay)
    if wait is None:
        # Whole samples, and no more than the sensor takes: what it holds counts as an old sample that long.
        wait = period * max(1, math.floor(1.0 / (float(robot.require("rate_hz", _WHAT)) * period) + 1e-6))
    if isinstance(timeout, NeckDefault):
        timeout = _MISSED * wait
    return replace(settings, sensor_delay=float(delay), sensor_period=wait, healthy_timeout=float(timeout))


def robot_noise(
    settings: KalmanSettings, robot: Robot, reach: Reach, stretch: float, period: float
) -> tuple[tuple[float, float, float], str]:
    """Return the noise levels of the form in SI, and which sensor they are of.

    Levels that are given are in the unit of the robot's outputs (angles in rad), those that are not are the neck's,
    stretched by how far and how fast the outputs go.

    Raises:
        SettingsError: a level that neither the robot's file nor a setting says.
    """
    from ._settings import find_sensor

    factor, si = to_si(robot.outputs.unit)
    moved = reach.rate / _NECK.rate
    scales = {
        "model_noise_std": moved * period / _NECK_PERIOD, "disturbance_noise_std": moved * period / _NECK_PERIOD,
        "acceleration_noise_std": moved / stretch, "angle_noise_std": reach.start / _NECK.start,
        "bias_noise_std": moved,
    }  # fmt: skip
    preset = None if settings.sensor == "paper" else find_sensor(settings.sensor)
    if preset is not None and si != "rad":
        raise SettingsError(
            f"`sensor` {settings.sensor} measures angles, robot {robot.label()} has none; leave it out."
        )
    levels, sensor = [], settings.sensor if preset is not None else "robot"
    for name, unit in noise_units(settings.form, robot):
        value = getattr(settings, name)
        if isinstance(value, NeckDefault):
            levels.append(float(value) * scales[name])
        elif value is not None:
            levels.append(float(value) if si == "rad" else factor * float(value))
            sensor = "none" if name == "measurement_noise_std" else sensor
        elif name == "measurement_noise_std":
            told = preset.noise_std if preset is not None else factor * float(robot.require("noise_std", _WHAT))
            if not told > 0.0:
                raise SettingsError(
                    f"robot `{robot.name}` gives `sensor.noise_std` = 0, and {_WHAT} needs a positive one; raise it, "
                    f"or give `{name}`."
                )
            levels.append(told)
        elif preset is not None:
            levels.append(3.0 * preset.gyro_noise_std)
        else:
            raise SettingsError(f"robot `{robot.name}` says nothing of its rates' noise; give `{name}` [{unit}].")
    return (levels[0], levels[1], levels[2]), sensor
