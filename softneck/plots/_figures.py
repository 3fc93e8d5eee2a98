"""Charts as matplotlib figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.signals.recording._channels import NECK

from ._chart import Chart, Curve, Panel, bar_width
from ._charts import validation_chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES = {"dashed": "--", "dotted": ":"}


def chart_figure(chart: Chart, *, width: float = 10.0) -> Figure:
    """Draw a chart.

    Args:
        chart: what to draw.
        width: of the figure [inch].
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, chart.row_height * chart.rows + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(chart.rows, chart.columns, sharex=chart.linked, squeeze=False).ravel()
    for number, (ax, panel) in enumerate(zip(axes, chart.panels, strict=False)):
        _draw(ax, panel)
        ax.set_xlabel(chart.x_label_of(number))
    for ax in axes[len(chart.panels) :]:
        ax.remove()
    figure.suptitle(chart.title)
    return figure


def _draw(ax: Axes, panel: Panel) -> None:
    ax.grid(alpha=0.3)
    ax.spines[["top", "right"]].set_visible(False)
    for curve in panel.curves:
        _draw_curve(ax, curve)
    for level in panel.levels:
        line = ax.axvline if level.vertical else ax.axhline
        line(level.value, color=level.colour, lw=0.8, ls="--" if level.dashed else "-", label=level.label or "_")
    if panel.log_x:
        ax.set_xscale("log")
    if panel.log_y:
        ax.set_yscale("log")
    if panel.equal:
        ax.set_aspect("equal", adjustable="datalim")
    if panel.y_range is not None:
        ax.set_ylim(*panel.y_range)
    if panel.ticks:
        ax.set_xticks(range(len(panel.ticks)), panel.ticks, rotation=30, ha="right")
    ax.set_ylabel(panel.y_label)
    ax.set_title(panel.title, fontsize="medium", loc="left")
    if panel.legend and any(item.label for item in (*panel.curves, *panel.levels)):
        # Above the axes, so that no curve hides under it.
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize="small", ncols=4, frameon=False)


def _draw_curve(ax: Axes, curve: Curve) -> None:
    x, y, colour, name = curve.x, curve.y, curve.colour, curve.label or "_"  # no legend
    match curve.style:
        case "band":
            # A band is light, for the curves on it to be seen.
            ax.fill_between(x, y, curve.upper_edge, color=colour, alpha=0.25, lw=0, label=name)
        case "bars":
            ax.bar(x, y, width=bar_width(x), color=colour, alpha=0.6, label=name)
        case "stems":
            ax.vlines(x, 0.0, y, color=colour, lw=2.0 * curve.width, label=name)
        case "points":
            ax.plot(x, y, "o", ms=3.0 * curve.width, color=colour, label=name)
        case "marked":
            ax.plot(x, y, "o-", ms=3.0 * curve.width, lw=curve.width, color=colour, label=name)
        case "step":
            ax.step(x, y, where="post", color=colour, lw=curve.width, label=name)
        case _:
            ax.plot(x, y, ls=_DASHES.get(curve.style, "-"), color=colour, lw=curve.width, label=name)


def validation_figure(
    time: Vector,
    measured: Matrix,
    predictions: Mapping[str, Matrix],
    title: str,
    *,
    bounds: tuple[Matrix, Matrix] | None = None,
    run: np.ndarray | None = None,
    robot: Robot = NECK,
) -> Figure:
    """Draw `validation_chart`: measured and predicted outputs, of a neck (time, 2) [rad], each with its error below."""
    return chart_figure(validation_chart(time, measured, predictions, title, bounds=bounds, run=run, robot=robot))
