"""One look for all figures: colours that colour-blind readers can tell apart, the units that people read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import to_si
from softneck.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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


def new_figure(rows: int, *, width: float = 10.0, row_height: float = 2.3) -> tuple[Figure, list[Axes]]:
    """Return a figure with `rows` axes under each other that share their time axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, row_height * rows + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, list(axes)


def label(ax: Axes, ylabel: str, *, legend: bool = True) -> None:
    """Name the y axis and show the legend beside the curves."""
    ax.set_ylabel(ylabel)
    if legend:
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize="small", ncols=4, frameon=False)
