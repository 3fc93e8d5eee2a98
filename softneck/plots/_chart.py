"""Charts as plain data: curves in panels, drawn by a matplotlib figure or an interactive page."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, ReprMixin, Vector, require_one_of, to_si
from softneck.robot import MOTOR_RANGE, OUTPUT_RANGE, Robot, Scaling

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Palette of Okabe and Ito.
BLUE, ORANGE, GREEN, RED, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#666666"
SKY = "#56B4E9"
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
MOTOR_COLOURS = (BLUE, ORANGE, GREEN)
# Of eight motors; the first three also stand for other things.
ALL_MOTOR_COLOURS = (*MOTOR_COLOURS, RED, PURPLE, SKY, GREY, "black")


def in_display_unit(values: np.ndarray, robot: Robot) -> np.ndarray:
    """Convert outputs from SI to the robot's display unit."""
    return values * (1.0 / to_si(robot.outputs.display_unit)[0])


# Share of the scaled range, 0.01 deg and 0.0012 rad of the neck: less is rounding, or below what its sensor resolves.
_LEAST_SHARE = 1e-4


def least_spans(scaling: Scaling, robot: Robot) -> dict[str, float]:
    """Return the least span of a panel of each output [display unit], set-point and motor position [motors' unit].

    `scaling`: of the robot, by the data that are drawn where it gives no ranges.
    """
    sizes = in_display_unit(2.0 * OUTPUT_RANGE * _LEAST_SHARE * scaling.output_unit, robot)
    motor = 2.0 * MOTOR_RANGE * _LEAST_SHARE * scaling.motor_unit / to_si(robot.motors.unit)[0]
    return dict(zip(robot.outputs.names, sizes.tolist(), strict=True)) | dict.fromkeys(
        (*robot.set_points, *robot.motor_positions), motor
    )


def curve_styles() -> Iterator[tuple[str, str]]:
    """Yield (colour, style) of one curve after the other: all colours as lines, then dashed, then dotted."""
    return itertools.cycle([(colour, style) for style in ("line", "dashed", "dotted") for colour in COLOURS])


# Styles of curves. `step` holds each value until the next sample, as a motor holds its set-point; `marked` is a line
# with its samples as points; `stems` are thin bars from zero.
STYLES = ("line", "dashed", "dotted", "points", "marked", "step", "bars", "stems", "band")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Curve(ReprMixin):
    """A set of points in one style; a NaN breaks lines and bands.

    Attributes:
        x: (n,), in the unit of the panel's label.
        y: (n,); of a `band` the lower edge, of `bars` and `stems` the heights.
        label: in the legend, if not empty. Curves of one label are shown and hidden together in a chart.
        colour: as #rrggbb, or "black".
        width: of lines, or of the points' diameter / 3 [points].
        upper: (n,) upper edge of a `band`; None for other styles.
    """

    x: Vector
    y: Vector
    label: str = ""
    colour: str = BLUE
    style: str = "line"
    width: float = 1.0
    upper: Vector | None = None

    def __post_init__(self) -> None:
        require_one_of("style", self.style, STYLES)
        if (self.upper is not None) != (self.style == "band"):
            raise DataError(
                f"curve `{self.label}`: `upper` belongs to a band and only there; its style is {self.style}."
            )
        for name in ("x", "y", "upper"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, np.ascontiguousarray(values, dtype=np.float64))
        shapes = {values.shape for values in (self.x, self.y, self.upper) if values is not None}
        if len(shapes) > 1 or self.x.ndim != 1:
            raise DataError(f"curve `{self.label}`: x and y must have one shape (n,); got {sorted(shapes)}.")

    @property
    def upper_edge(self) -> Vector:
        """Upper edge of a band; of other styles y."""
        return self.y if self.upper is None else self.upper


@dataclass(frozen=True, slots=True)
class Level:
    """A straight line through a whole panel: a bound, a limit, or a border.

    Attributes:
        value: y of a horizontal line, x of a `vertical` one.
        label: in the legend, if not empty.
    """

    value: float
    label: str = ""
    colour: str = GREY
    dashed: bool = True
    vertical: bool = False


@dataclass(frozen=True, slots=True, repr=False)
class Panel(ReprMixin):
    """A pair of axes.

    Attributes:
        curves: in drawing order, the last on top.
        y_label: with its unit, such as "pitch [deg]".
        x_label: with its unit; if empty, that of the chart under its lowest panels.
        y_range: initial limits of y; None fits the curves.
        least_span: the curves are fitted to no smaller range of y, so that rounding does not fill a panel.
        equal: one unit has the same length on both axes, as for a path over pitch and roll.
    """

    curves: Sequence[Curve]
    y_label: str
    x_label: str = ""
    levels: Sequence[Level] = ()
    title: str = ""
    legend: bool = True
    y_range: tuple[float, float] | None = None
    least_span: float = 0.0
    log_x: bool = False
    log_y: bool = False
    equal: bool = False

    @property
    def limits(self) -> tuple[float, float] | None:
        """Initial limits of y: `y_range`, or `least_span` around curves that span less; None fits the curves."""
        if self.y_range is not None or self.least_span <= 0.0 or not self.curves:
            return self.y_range
        y = np.concatenate([edge for curve in self.curves for edge in (curve.y, curve.upper_edge)])
        y = np.append(y[np.isfinite(y)], [level.value for level in self.levels if not level.vertical])
        if y.size == 0 or np.ptp(y) >= self.least_span:
            return None
        middle = 0.5 * float(y.min() + y.max())
        return middle - 0.5 * self.least_span, middle + 0.5 * self.least_span


@dataclass(frozen=True, slots=True, repr=False)
class Chart(ReprMixin):
    """Panels that belong together, in one or more columns.

    Attributes:
        x_label: of the lowest panels without their own.
        columns: number of panels in a row.
        linked: whether all panels share and zoom one x axis.
        row_height: of one panel [inch].
    """

    title: str
    panels: Sequence[Panel]
    x_label: str = "time [s]"
    columns: int = 1
    linked: bool = True
    caption: str = ""
    row_height: float = 2.3

    def __post_init__(self) -> None:
        if not self.panels:
            raise DataError(f"chart `{self.title}` has no panels.")
        if self.columns < 1:
            raise DataError(f"chart `{self.title}`: `columns` must be at least 1; got {self.columns}.")

    @property
    def rows(self) -> int:
        """Number of rows of panels."""
        return -(-len(self.panels) // self.columns)

    def x_label_of(self, number: int) -> str:
        """Return the x label of a panel: its own, or the chart's in the lowest row."""
        own = self.panels[number].x_label
        return own or (self.x_label if number + self.columns >= len(self.panels) else "")


def bar_width(x: Vector) -> float:
    """Return the width of adjacent bars at `x`."""
    return float(np.min(np.diff(np.sort(x)))) if x.size > 1 else 1.0


_DASHES = {"dashed": "--", "dotted": ":"}


def chart_figure(chart: Chart) -> Figure:
    """Draw a chart as a figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, chart.row_height * chart.rows + 0.4), layout="constrained")
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
    if panel.limits is not None:
        ax.set_ylim(*panel.limits)
    ax.set_ylabel(panel.y_label)
    ax.set_title(panel.title, fontsize="medium", loc="left")
    if panel.legend and any(item.label for item in (*panel.curves, *panel.levels)):
        # Above the axes, so that it hides no curve.
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), fontsize="small", ncols=4, frameon=False)


def _draw_curve(ax: Axes, curve: Curve) -> None:
    x, y, colour, name = curve.x, curve.y, curve.colour, curve.label or "_"  # no legend
    match curve.style:
        case "band":
            # A light band leaves the curves on it visible.
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


def signals_figure(time: Vector, columns: Mapping[str, Vector], units: Mapping[str, str], title: str) -> Figure:
    """Draw channels over time, one panel for each unit; angles in degrees."""
    groups: dict[str, list[str]] = {}
    for name in columns:
        groups.setdefault(units[name], []).append(name)
    panels = []
    for unit, names in groups.items():
        drawn = unit.replace("rad", "deg") if unit.startswith("rad") else unit
        scale = to_si("deg")[0] if drawn != unit else 1.0
        curves = [
            Curve(time, columns[name] / scale, name, colour, style)
            for name, (colour, style) in zip(names, curve_styles(), strict=False)
        ]
        label = names[0].rpartition("_")[0] or "value" if len(names) > 1 else names[0]
        panels.append(Panel(curves, f"{label} [{drawn or '-'}]"))
    return chart_figure(Chart(title, panels))
