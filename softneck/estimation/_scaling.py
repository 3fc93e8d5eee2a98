"""The scaling of a robot by its model, where its robot file gives no ranges and no time constant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.identification import Model
from softneck.robot import TIME_CONSTANT, Robot, Scaling

# The neck's outputs run over 46 of the 63 deg that its static gain makes of all motors at their ends.
_OF_ENDS = 0.73
# Motors at random, each level for so many samples: what tells how far a nonlinear model goes.
_LEVELS, _HELD = 60, 50


def plants_scaling(robot: Robot, plants: Sequence[Any], weights: Matrix, what: str) -> Scaling:
    """Return the scaling of a robot with a linear plant for each output.

    Args:
        robot: whose plants they are; what it gives counts first.
        plants: with `static_gain`, `time_constant` and `sample_time`.
        weights: (outputs, motors) of the motors in each output's direction.
        what: such as "an observer", for the message.

    Raises:
        SettingsError: the robot does not say where its set-points end.
    """
    seconds = max(max(plant.time_constant, plant.sample_time) for plant in plants)
    if robot.motors.nominal is not None:
        return Scaling.of(robot, time_constant=seconds)
    ends = np.array(motor_ends(robot, what))
    most = np.abs(weights) @ (0.5 * (ends[1] - ends[0]))
    spans = _OF_ENDS * np.array([abs(plant.static_gain) for plant in plants]) * most
    return Scaling.of(robot, set_points=ends, outputs=np.array([-spans, spans]), time_constant=seconds)


def model_scaling(model: Model) -> Scaling:
    """Return the scaling of a model's robot, by the set-points that it was trained on and a run over them."""
    robot, seconds = model.robot, slowest_seconds(model)
    if robot.motors.nominal is not None:
        return Scaling.of(robot, time_constant=seconds)
    ports = model.block().inputs[: len(robot.motors.names)]
    ends = np.array([[getattr(port, end) for port in ports] for end in ("minimum", "maximum")], dtype=np.float64)
    return Scaling.of(robot, set_points=ends, outputs=_random_run(model, ends), time_constant=seconds)


def slowest_seconds(model: Model) -> float:
    """Return the time constant of a model's robot [s]: its own, else the slowest that the data showed."""
    return model.robot.time_constant_s or max(model.findings.get("time_constants_s", [TIME_CONSTANT]))


def _random_run(model: Model, ends: Matrix) -> Matrix:
    """Return the outputs (time, outputs) of a free run over levels at random between `ends` (2, motors)."""
    block, motors = model.block(), ends.shape[1]
    rows = np.full((_LEVELS * _HELD, len(block.inputs)), np.nan)
    levels = np.random.default_rng(0).uniform(ends[0], ends[1], (_LEVELS, motors))
    rows[:, :motors] = np.repeat(levels, _HELD, axis=0)
    return block.run(block.initial_state(), rows)[1][:, : len(model.robot.outputs.names)]


def motor_ends(robot: Robot, what: str) -> tuple[Vector, Vector]:
    """Return the lowest and highest set-points (motors,) in SI; raise SettingsError where `what` finds none."""
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if motors.setpoint_min is None or motors.setpoint_max is None:
        raise SettingsError(
            f"robot {robot.label()} gives no `motors.setpoint_min` and `setpoint_max`, which {what} needs to "
            "know how far its outputs go; add them."
        )
    return factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)
