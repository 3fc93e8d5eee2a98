"""Charts drawn in the browser: zoomed, hovered over, curves hidden by a click on the legend; with Bokeh, offline.

Bokeh's JavaScript ships inside its Python package, so that a page can carry its one copy along. It is imported when
the first page with a chart is made, for the command line to start fast.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Vector

from ._chart import Chart, Curve, Panel

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource, DataRenderer, Legend, UIElement
    from bokeh.plotting import figure as Plot

_PIXELS_PER_INCH = 96
# Left of the frame, for the panels of a column to stand under each other whatever their numbers need.
_MARGIN = 72
_FONT = "system-ui, sans-serif"
_DASHES = {"dashed": [6, 4], "dotted": [2, 3]}
_TOOLS = "box_zoom,pan,reset,save"


@dataclass(frozen=True, slots=True)
class Drawn:
    """A chart as a page holds it.

    Attributes:
        data: JSON that Bokeh draws; safe inside a <script>.
        height: that the chart takes [pixels].
    """

    data: str
    height: int


def library() -> str:
    """Return the JavaScript that draws charts: Bokeh's core, one copy for a page, without widgets or tables."""
    from bokeh.resources import Resources

    return "\n".join(Resources(mode="inline", components=["bokeh"], log_level="error").js_raw)


def draw(chart: Chart) -> Drawn:
    """Return a chart for the browser.

    All samples are there. Heights are kept to 7 digits (32 bit, which halves the page); x keeps all 64 bits.
    """
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import BoxZoomTool, ToolProxy

    plots: list[Plot] = []
    shown: dict[str, list[DataRenderer]] = {}
    sources = _Sources()
    for number, panel in enumerate(chart.panels):
        plot = _plot(panel, chart, number)
        if chart.linked and plots:
            plot.x_range = plots[0].x_range
        _fill(plot, panel, sources, shown)
        plots.append(plot)
    _link(shown)
    rows: list[list[UIElement | None]] = [
        [*plots[first : first + chart.columns]] for first in range(0, len(plots), chart.columns)
    ]
    grid = gridplot(rows, toolbar_location="right", sizing_mode="stretch_width", toolbar_options={"logo": None})
    for tool in grid.toolbar.tools:
        if isinstance(tool, ToolProxy) and isinstance(tool.tools[0], BoxZoomTool):
            grid.toolbar.active_drag = tool
    # `<` would let a label end the script; JSON may spell it otherwise.
    text = json.dumps(json_item(grid), separators=(",", ":")).replace("<", "\\u003c")
    return Drawn(text, sum(plot.height or 0 for plot in plots[:: chart.columns]))


class _Sources:
    """Curves with one x share a source, so that the page holds the x once."""

    def __init__(self) -> None:
        self._known: list[tuple[Vector, ColumnDataSource]] = []

    def add(self, x: Vector, y: Vector) -> tuple[ColumnDataSource, str]:
        """Return the source that now holds `y` and the name of its column."""
        from bokeh.models import ColumnDataSource

        source = next((s for known, s in self._known if known is x or np.array_equal(known, x)), None)
        if source is None:
            source = ColumnDataSource({"x": x})
            self._known.append((x, source))
        column = f"y{len(source.column_names)}"
        source.add(y.astype(np.float32), column)
        return source, column


def _plot(panel: Panel, chart: Chart, number: int) -> Plot:
    from bokeh.models import Range1d, Title, WheelZoomTool
    from bokeh.plotting import figure

    x_label = chart.x_label_of(number)
    height = max(140, round(0.82 * chart.row_height * _PIXELS_PER_INCH))
    plot = figure(
        height=height + (30 if x_label else 0) + (20 if panel.title else 0),
        sizing_mode="stretch_width",
        tools=_TOOLS,
        x_axis_type="log" if panel.log_x else "linear",
        y_axis_type="log" if panel.log_y else "linear",
        x_axis_label=x_label or None,
        y_axis_label=panel.y_label,
        match_aspect=panel.equal,
        min_border_left=_MARGIN,
        min_border_right=12,
        min_border_top=4,
        min_border_bottom=4,
        outline_line_color=None,
    )
    # A bare wheel scrolls the page; with Ctrl (a pinch on a touchpad) it zooms along x.
    plot.add_tools(WheelZoomTool(dimensions="both" if panel.equal else "width", modifiers={"ctrl": True}))
    if panel.y_range is None:
        plot.y_range.update(only_visible=True)  # a hidden curve leaves its room to the others
    else:
        plot.y_range = Range1d(*panel.y_range)
    plot.x_range.update(range_padding=0.01)
    plot.grid.grid_line_alpha = 0.4
    for axis in plot.axis:
        axis.update(axis_label_text_font=_FONT, axis_label_text_font_style="normal", axis_label_text_font_size="12px")
        axis.update(major_label_text_font=_FONT, major_label_text_font_size="11px", minor_tick_line_color=None)
    if chart.linked and not x_label:
        plot.xaxis.major_label_text_font_size = "0px"  # the panel below has the same axis
    if panel.title:
        plot.title = Title(text=panel.title, text_font=_FONT, text_font_size="12px")
    return plot


def _fill(plot: Plot, panel: Panel, sources: _Sources, shown: dict[str, list[DataRenderer]]) -> None:
    from bokeh.models import HoverTool, Legend, LegendItem, Span

    items: dict[str, list[DataRenderer]] = {}
    touched: list[DataRenderer] = []
    for curve in panel.curves:
        drawn, hovered = _draw_curve(plot, curve, sources)
        touched += hovered
        if curve.label:
            items.setdefault(curve.label, []).extend(drawn)
            shown.setdefault(curve.label, []).extend([*drawn, *hovered])
    for level in panel.levels:
        dash = [6, 4] if level.dashed else []
        dimension = "height" if level.vertical else "width"
        plot.add_layout(
            Span(location=level.value, dimension=dimension, line_color=level.colour, line_width=1, line_dash=dash)
        )
        if level.label:
            # A Span has no entry in a legend; an empty line with its look has.
            sample = plot.line([np.nan], [np.nan], color=level.colour, line_dash=dash)
            items.setdefault(level.label, []).append(sample)
    if touched:
        text = "<div><b>$name</b> $snap_y{%.4g} <span style='color:#666'>at $snap_x{%.6g}</span></div>"
        hover = HoverTool(tooltips=text, mode="vline", line_policy="nearest", description="values")
        hover.update(renderers=touched, formatters={"$snap_y": "printf", "$snap_x": "printf"})
        plot.add_tools(hover)
    if panel.legend and items:
        legend = Legend(items=[LegendItem(label=name, renderers=drawn) for name, drawn in items.items()])
        plot.add_layout(_dressed(legend), "above")


def _dressed(legend: Legend) -> Legend:
    legend.update(
        orientation="horizontal", click_policy="hide", border_line_color=None, padding=2, margin=2, spacing=14
    )
    legend.update(label_text_font=_FONT, label_text_font_size="12px", label_height=16, glyph_height=14, ncols=6)
    return legend


def _draw_curve(plot: Plot, curve: Curve, sources: _Sources) -> tuple[list[DataRenderer], list[DataRenderer]]:
    """Return what is drawn, and what answers to the mouse."""
    from bokeh.models import ColumnDataSource

    colour, width, name = curve.colour, 1.3 * curve.width, curve.label or " "
    if curve.style == "band":
        source = ColumnDataSource(_outlines(curve))
        band = plot.patches("xs", "ys", source=source, color=colour, fill_alpha=0.25, line_color=None, name=name)
        return [band], []
    source, y = sources.add(curve.x, curve.y)
    places: dict[str, Any] = {"source": source, "name": name, "color": colour}
    match curve.style:
        case "bars":
            bars = plot.vbar("x", top=y, width=_pitch(curve.x), fill_alpha=0.6, line_color=None, **places)
            return [bars], [bars]
        case "stems":
            stems = plot.vbar("x", top=y, width=0.3 * _pitch(curve.x), line_color=None, **places)
            return [stems], [stems]
        case "points":
            points = plot.scatter("x", y, size=4.0 * curve.width, **places)
            return [points], [points]
        case "marked":
            line = plot.line("x", y, line_width=width, **places)
            return [line, plot.scatter("x", y, size=5.0 * curve.width, **places)], [line]
        case "step":
            # Bokeh's steps do not answer to the mouse; a line that is not seen does, at the samples.
            step = plot.step("x", y, mode="after", line_width=width, **places)
            return [step], [plot.line("x", y, line_alpha=0.0, **places)]
        case _:
            line = plot.line("x", y, line_width=width, line_dash=_DASHES.get(curve.style, []), **places)
            return [line], [line]


def _outlines(curve: Curve) -> dict[str, list[Vector]]:
    """Return the outline of each piece of a band without a NaN (Bokeh's own bands are drawn across one)."""
    lower, upper = curve.y, curve.upper_edge
    good = np.isfinite(curve.x + lower + upper)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]]))).reshape(-1, 2).tolist()
    xs = [np.concatenate([curve.x[a:b], curve.x[a:b][::-1]]) for a, b in edges]
    ys = [np.concatenate([lower[a:b], upper[a:b][::-1]]).astype(np.float32) for a, b in edges]
    return {"xs": xs, "ys": ys}


def _pitch(x: Vector) -> float:
    return float(np.min(np.diff(np.sort(x)))) if x.size > 1 else 1.0


def _link(shown: Mapping[str, Sequence[DataRenderer]]) -> None:
    """Let curves of one label appear and vanish together, in all panels of a chart."""
    for renderers in shown.values():
        ring = list(dict.fromkeys(renderers))
        for one, other in zip(ring, [*ring[1:], ring[0]], strict=True):
            if one is not other:
                one.js_link("visible", other, "visible")
