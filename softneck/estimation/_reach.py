"""How far and how fast outputs of another robot than the neck go: by its motors' ranges, or a run of its model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.identification import Model
from softneck.robot import Robot

from ._axis import AxisPlant
from ._forms import Reach

_NECK = Reach()
# The paper's neck reaches 40 of the 63 deg that its static gain makes of all motors at their ends.
REACHED = 0.64
# Motors at random, each level for so many samples: what tells how far and how fast a nonlinear model goes.
_LEVELS, _HELD = 60, 50


def linear_reach(plants: Sequence[AxisPlant], robot: Robot, weights: Matrix) -> Reach:
    """Return how far and how fast the outputs of a linear model go, by what its motors may do.

    Raises:
        SettingsError: the robot does not say where its set-points end.
    """
    low, high = motor_ends(robot, "an observer")
    most = np.abs(weights) @ (0.5 * (high - low))
    spans = [REACHED * abs(plant.static_gain) * float(v) for plant, v in zip(plants, most, strict=True)]
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


def motor_ends(robot: Robot, what: str) -> tuple[Vector, Vector]:
    """Return the lowest and highest set-points (motors,) in SI; raise SettingsError where `what` finds none."""
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if motors.setpoint_min is None or motors.setpoint_max is None:
        raise SettingsError(
            f"robot {robot.label()} gives no `motors.setpoint_min` and `motors.setpoint_max`, which {what} needs to "
            "know how far its outputs go; add them."
        )
    return factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)
