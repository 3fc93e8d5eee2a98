"""One look for all figures: colours that colour-blind readers can tell apart, the units that people read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from softneck.core import to_si
from softneck.robot import Robot

# Okabe and Ito's palette.
BLUE, ORANGE, GREEN, RED, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#666666"
SKY = "#56B4E9"
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
MOTOR_COLOURS = (BLUE, ORANGE, GREEN)
# Of eight motors; where they stand for other things, the first three.
ALL_MOTOR_COLOURS = (*MOTOR_COLOURS, RED, PURPLE, SKY, GREY, "black")


def shown(values: np.ndarray, robot: Robot) -> np.ndarray:
    """Return values of outputs, in SI, in the unit in which people see the robot's."""
    return values * (1.0 / to_si(robot.outputs.display_unit)[0])


def looks() -> Iterator[tuple[str, str]]:
    """Return (colour, style) of one curve after the other: all colours drawn through, then dashed, then dotted."""
    return itertools.cycle([(colour, style) for style in ("line", "dashed", "dotted") for colour in COLOURS])
