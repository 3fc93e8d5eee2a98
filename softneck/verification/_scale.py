"""What the default requirements, which are a neck's, are of another robot: its time and how far its outputs go."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from softneck.core import to_si
from softneck.estimation._forms import Reach
from softneck.estimation._reach import REACHED, motor_ends
from softneck.identification.models._directions import NECK_SECONDS
from softneck.loop._result import shown_unit

from ._plants import UncertainNeck
from ._requirements import Requirements

# The load of the defaults over the largest input that the neck's motors give, 12 rad.
_LOAD = 1.0 / 12.0


def scaled(asked: Requirements, sources: Sequence[UncertainNeck]) -> Requirements:
    """Return the requirements with their defaults for the robot of `sources`; what the user's file says stays.

    What was stretched before, as `tune` does for all that it judges, stays as well.

    Times go by the slowest pole over the neck's 0.2 s, sizes by the least that an output reaches and may over the
    neck's 40 deg, the load by what the motors can give.

    Raises:
        SettingsError: the robot does not say where its set-points end.
    """
    if asked.scale != (1.0, 1.0):
        return asked
    robot = asked.robot
    boxes = [box for source in sources for box in source.axes]
    slowest = max(1.0 / float(box.nominal[1]) for box in boxes)
    low, high = motor_ends(robot, "verification")
    most = [np.abs(_weights(source)) @ (0.5 * (high - low)) for source in sources]
    reached = min(
        REACHED * abs(float(box.nominal[0])) * float(v)
        for source, each in zip(sources, most, strict=True) for box, v in zip(source.axes, each, strict=True)
    )  # fmt: skip
    outputs = robot.outputs
    if outputs.min is not None and outputs.max is not None:
        spans = 0.5 * to_si(outputs.unit)[0] * (np.array(outputs.max) - np.array(outputs.min))
        reached = min(reached, float(spans.min()))
    factor = shown_unit(robot)[1]
    # Of the neck's 40 deg; in another unit the numbers of the defaults are so many deg.
    size = reached / Reach().start if factor is None else reached / factor / math.degrees(Reach().start)
    told = robot.noise_std
    noise = None if told is None else told * to_si(robot.outputs.unit)[0]
    shown = None if noise is None else math.degrees(noise) if factor is None else noise / factor
    load = _LOAD * float(asked.step["load_rad"]) * min(float(each.min()) for each in most)
    time = max(slowest, max(source.sample_time for source in sources)) / NECK_SECONDS
    return asked.scaled(time, size, load / to_si(robot.motors.unit)[0], shown)


def _weights(source: UncertainNeck) -> np.ndarray:
    if source.weights is None:
        raise ValueError("a neck's requirements are not scaled")
    return source.weights
