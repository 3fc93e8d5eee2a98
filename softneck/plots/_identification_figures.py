"""Figures of identification: maps of local models, cover of an uncertain plant, frequency responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector, to_si
from softneck.robot import Robot

from ._style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, label, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY)
_QUANTITIES = ("pole [1/s]", "dead time [ms]")
# Two-sided 95 %.
_REACH = 1.96


def local_map_figure(
    groups: Mapping[str, tuple[Vector, Matrix, Matrix]], title: str, robot: Robot | None = None
) -> Figure:
    """Draw static gain, pole and dead time of local models against inclination, with 95 % bars.

    Args:
        groups: name -> inclination (n,) [rad], of robots other than the neck the distance of the outputs from their
            mean; numbers (n, 3) and standard deviations (n, 3 or more) of static gain, pole, dead time; in SI.
        title: of the figure.
        robot: whose; None: the neck's.
    """
    figure, axes = new_figure(3, row_height=2.1)
    unit, gain, per = shown_gain(robot or Robot.preset())
    scale = np.array([gain, 1.0, 1e3])
    for (name, (inclination, numbers, std)), colour in zip(groups.items(), _COLOURS, strict=False):
        for i, ax in enumerate(axes):
            ax.errorbar(
                per * inclination, scale[i] * numbers[:, i], yerr=_REACH * scale[i] * std[:, i],
                fmt="o", ms=4, lw=0.8, capsize=2, color=colour, label=name,
            )  # fmt: skip
    for ax, name in zip(axes, (f"static gain [{unit}]", *_QUANTITIES), strict=True):
        label(ax, name, legend=ax is axes[0])
    whose = robot or Robot.preset()
    what = "inclination" if whose.is_neck else "distance from the mean"
    axes[-1].set_xlabel(f"{what} [{whose.outputs.display_unit}]")
    figure.suptitle(title)
    return figure


def shown_gain(robot: Robot) -> tuple[str, float, float]:
    """Return the unit in which a robot's static gains are shown, the factor to it, and that of its outputs."""
    out, into = (to_si(unit)[0] for unit in (robot.outputs.display_unit, robot.motors.unit))
    return f"{robot.outputs.display_unit}/{robot.motors.unit}", into / out, 1.0 / out


def cover_figure(frequency: Vector, errors: Matrix, weight: Vector, title: str) -> Figure:
    """Draw relative errors of all samples (n, m) under the weight (m,) over `frequency` (m,) [rad/s]."""
    figure, (ax,) = new_figure(1, row_height=4.0)
    for number, row in enumerate(errors):
        ax.loglog(frequency, np.maximum(row, 1e-4), color=GREY, lw=0.6, label="samples" if number == 0 else None)
    ax.loglog(frequency, weight, color=RED, lw=1.6, label="|W|")
    label(ax, "|G/G0 - 1|")
    ax.set_xlabel("frequency [rad/s]")
    figure.suptitle(title)
    return figure


def frequency_response_figure(
    frequency: Vector,
    response: np.ndarray,
    radius: Vector,
    coherence: Vector,
    title: str,
    *,
    unit: str,
    models: Mapping[str, np.ndarray] | None = None,
) -> Figure:
    """Draw gain, phase and coherence of one entry of a frequency response, models beside it.

    Args:
        frequency: (n,) [rad/s].
        response: (n,) complex, NaN where it is not known.
        radius: (n,) of the circles in which it lies with 95 %.
        coherence: (n,) 0 to 1.
        title: of the figure.
        unit: of `response`.
        models: name -> (n,) complex.
    """
    figure, (gain, phase, explained) = new_figure(3, row_height=2.3)
    size = np.abs(response)
    gain.loglog(frequency, size, color=BLUE, lw=1.2, marker=".", ms=3, label="data, 95 %")
    # What reaches zero has no end on a logarithmic axis.
    gain.fill_between(frequency, np.maximum(size - radius, 1e-3 * size), size + radius, color=BLUE, alpha=0.2, lw=0)
    # The phase of a circle that holds zero is anything.
    known = radius < size
    phases = np.where(known, np.degrees(_unwrapped(response, known)), np.nan)
    reach = np.degrees(np.arcsin(np.where(known, radius / size, 0.0)))
    phase.semilogx(frequency, phases, color=BLUE, lw=1.2, marker=".", ms=3)
    phase.fill_between(frequency, phases - reach, phases + reach, color=BLUE, alpha=0.2, lw=0)
    for number, (name, values) in enumerate((models or {}).items()):
        colour = _COLOURS[1 + number % (len(_COLOURS) - 1)]
        gain.loglog(frequency, np.abs(values), color=colour, lw=1.2, label=name)
        phase.semilogx(frequency, np.degrees(np.unwrap(np.angle(values))), color=colour, lw=1.2)
    if known.any():
        # Frequencies at which nothing is known would flatten what is.
        gain.set_ylim(0.3 * size[known].min(), 3.0 * size[known].max())
    explained.semilogx(frequency, coherence, color=BLUE, lw=1.2)
    explained.set_ylim(-0.05, 1.05)
    label(gain, f"gain [{unit}]")
    label(phase, "phase [deg]", legend=False)
    label(explained, "coherence", legend=False)
    explained.set_xlabel("frequency [rad/s]")
    figure.suptitle(title)
    return figure


def _unwrapped(response: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the phase [rad] without jumps over what is known."""
    phase = np.full(response.shape, np.nan)
    phase[known] = np.unwrap(np.angle(response[known]))
    return phase
