"""How far outputs go by their motors' ranges; for `varying` and `verification` until they scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix
from softneck.robot import Robot

from ._axis import AxisPlant
from ._forms import Reach
from ._scaling import motor_ends as motor_ends

# The paper's neck reaches 40 of the 63 deg that its static gain makes of all motors at their ends.
REACHED = 0.64


def linear_reach(plants: Sequence[AxisPlant], robot: Robot, weights: Matrix) -> Reach:
    """Return how far the outputs of a linear model go, by what its motors may do."""
    low, high = motor_ends(robot, "an observer")
    most = np.abs(weights) @ (0.5 * (high - low))
    return Reach(start=max(REACHED * abs(plant.static_gain) * float(v) for plant, v in zip(plants, most, strict=True)))
