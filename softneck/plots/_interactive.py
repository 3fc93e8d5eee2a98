"""Interactive charts in the browser with zoom, values under the mouse and hidden curves; by Bokeh, offline.

A page carries its one copy of Bokeh's JavaScript, which ships inside the Python package. Bokeh is imported with the
first chart, since that takes a while.
"""

from __future__ import annotations

import base64
import gzip
import itertools
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Vector

from ._chart import Chart, Curve, Panel, bar_width

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource, GlyphRenderer, Legend, UIElement
    from bokeh.plotting import figure as Plot

_PIXELS_PER_INCH = 96
# Left margin, which aligns the panels of a column whatever the width of their numbers.
_LEFT_MARGIN_PX = 72
# Longer curves are one pixel wide: browsers draw those 5 to 10 times faster.
_MAX_WIDE_SAMPLES = 2_000
_FONT_NAME = "system-ui, sans-serif"
# Names under an axis: slant [rad] and additional height [pixels].
_TICK_SLANT, _TICK_NAMES_PX = 0.5, 60
_DASHES = {"dashed": [6, 4], "dotted": [2, 3]}
#: Notice required by Bokeh's licence (BSD-3); the text in the packed library is not readable.
LICENCE = "Plots: Bokeh, Copyright (c) Anaconda, Inc., and Bokeh Contributors; BSD-3-Clause, text in the library."
_TOOL_NAMES = "box_zoom,pan,reset,save"


def gzip_base64(data: bytes) -> str:
    """Return bytes as base64 text of their gzip; the result is reproducible."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()


@lru_cache(maxsize=1)
def library() -> str:
    """Return Bokeh's core JavaScript, packed, without widgets or tables."""
    from bokeh.resources import Resources

    return gzip_base64("\n".join(Resources(mode="inline", components=["bokeh"], log_level="error").js_raw).encode())


def draw(chart: Chart) -> tuple[Any, int]:
    """Return a chart as Bokeh's JSON, and its height [pixels]."""
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot
    from bokeh.models import BoxZoomTool, ToolProxy

    plots: list[Plot] = []
    sources = _Sources()
    for number, panel in enumerate(chart.panels):
        plot = _plot(panel, chart, number)
        if chart.linked and plots:
            plot.x_range = plots[0].x_range
        _fill(plot, panel, sources, panel.x_label or chart.x_label)
        plots.append(plot)
    rows: list[list[UIElement | None]] = [
        [*plots[first : first + chart.columns]] for first in range(0, len(plots), chart.columns)
    ]
    grid = gridplot(rows, toolbar_location="right", sizing_mode="stretch_width", toolbar_options={"logo": None})
    for tool in grid.toolbar.tools:
        if isinstance(tool, ToolProxy) and isinstance(tool.tools[0], BoxZoomTool):
            grid.toolbar.active_drag = tool
    return json_item(grid), sum(plot.height or 0 for plot in plots[:: chart.columns])


class _Sources:
    """Data sources, one for all curves with the same x, so that a page holds x once."""

    def __init__(self) -> None:
        self._known: list[tuple[Vector, ColumnDataSource]] = []

    def add(self, x: Vector, y: Vector) -> tuple[ColumnDataSource, str]:
        """Return the source that holds `y` and the name of its column."""
        from bokeh.models import ColumnDataSource

        source = next((s for known, s in self._known if known is x or np.array_equal(known, x)), None)
        if source is None:
            source = ColumnDataSource({"x": x})
            self._known.append((x, source))
        column = f"y{len(source.column_names)}"
        values: Any = y.astype(np.float32)  # Bokeh's type hint lacks arrays
        source.add(values, column)
        return source, column


def _plot(panel: Panel, chart: Chart, number: int) -> Plot:
    from bokeh.models import BoxZoomTool, Range1d, Title, WheelZoomTool
    from bokeh.plotting import figure

    x_label = chart.x_label_of(number)
    height = max(140, round(0.82 * chart.row_height * _PIXELS_PER_INCH))
    plot = figure(
        height=height + (30 if x_label else 0) + (20 if panel.title else 0),
        sizing_mode="stretch_width",
        tools=_TOOL_NAMES,
        x_axis_type="log" if panel.log_x else "linear",
        y_axis_type="log" if panel.log_y else "linear",
        x_axis_label=x_label or None,
        y_axis_label=panel.y_label,
        match_aspect=panel.equal,
        min_border_left=_LEFT_MARGIN_PX,
        min_border_right=12,
        min_border_top=4,
        min_border_bottom=4,
        outline_line_color=None,
    )
    plot.toolbar.active_drag = next(tool for tool in plot.tools if isinstance(tool, BoxZoomTool))
    # The wheel scrolls the page; with Ctrl (a pinch on a touchpad) it zooms along x.
    plot.add_tools(WheelZoomTool(dimensions="both" if panel.equal else "width", modifiers={"ctrl": True}))
    if (limits := panel.limits) is None:
        plot.y_range.update(only_visible=True)  # the range follows the visible curves
    else:
        plot.y_range = Range1d(start=limits[0], end=limits[1])
    plot.x_range.update(range_padding=0.01)
    plot.grid.grid_line_alpha = 0.4
    for axis in plot.axis:
        axis.update(
            axis_label_text_font=_FONT_NAME, axis_label_text_font_style="normal", axis_label_text_font_size="12px"
        )
        axis.update(major_label_text_font=_FONT_NAME, major_label_text_font_size="11px", minor_tick_line_color=None)
    if chart.linked and not x_label:
        # The panel below has the same axis. On a logarithmic axis Bokeh fails at size 0 (NaN box).
        plot.xaxis.major_label_text_font_size = "1px" if panel.log_x else "0px"
        plot.xaxis.major_label_text_alpha = 0.0
        plot.xaxis.major_label_orientation = _TICK_SLANT
        plot.height = (plot.height or 0) + _TICK_NAMES_PX
    if panel.title:
        plot.title = Title(text=panel.title, text_font=_FONT_NAME, text_font_size="12px")
    return plot


def _fill(plot: Plot, panel: Panel, sources: _Sources, x_name: str) -> None:
    from bokeh.models import Legend, LegendItem, Span

    items: dict[str, list[Any]] = {}
    columns: dict[ColumnDataSource, list[tuple[str, str]]] = {}
    for curve in panel.curves:
        drawn, column = _draw_curve(plot, curve, sources)
        if curve.label:
            items.setdefault(curve.label, []).extend(drawn)
        if column:
            source: Any = drawn[0].data_source
            columns.setdefault(source, []).append((curve.label or panel.y_label, f"@{column}{{%.4g}}"))
    for level in panel.levels:
        dash = [6, 4] if level.dashed else []
        dimension = "height" if level.vertical else "width"
        plot.add_layout(
            Span(location=level.value, dimension=dimension, line_color=level.colour, line_width=1, line_dash=dash)
        )
        if level.label:
            # A Span has no legend entry, an empty line with its look has one.
            sample = plot.line([np.nan], [np.nan], color=level.colour, line_dash=dash)
            items.setdefault(level.label, []).append(sample)
    _add_hover(plot, columns, x_name)
    if panel.legend and items:
        legend = Legend(items=[LegendItem(label=name, renderers=drawn) for name, drawn in items.items()])
        plot.add_layout(_style_legend(legend), "above")


def _add_hover(plot: Plot, columns: Mapping[ColumnDataSource, Sequence[tuple[str, str]]], x_name: str) -> None:
    """Show the values of all curves at the sample left of the mouse in one box.

    Bokeh's own hover makes a box for each curve, and they overlap. Here an invisible line with every sample responds;
    it is never hidden and does not count for the axis.
    """
    from bokeh.models import DataRange1d, HoverTool

    visible: Any = list(plot.renderers)
    if isinstance(plot.y_range, DataRange1d):
        plot.y_range.renderers = visible
    sides = itertools.cycle(("right", "left", "below", "above"))
    for (source, rows), side in zip(columns.items(), sides, strict=False):
        line = plot.line("x", "x", source=source, line_color=None)
        hover = HoverTool(tooltips=[(x_name, "@x{%.6g}"), *rows], mode="vline")
        hover.update(
            renderers=[line], formatters={"@x": "printf"} | {name[: name.index("{")]: "printf" for _, name in rows}
        )
        hover.update(line_policy="none", point_policy="follow_mouse", attachment=side, description="values")
        plot.add_tools(hover)


def _style_legend(legend: Legend) -> Legend:
    legend.update(
        orientation="horizontal", click_policy="hide", border_line_color=None, padding=2, margin=2, spacing=14
    )
    legend.update(label_text_font=_FONT_NAME, label_text_font_size="12px", label_height=16, glyph_height=14, ncols=6)
    return legend


def _draw_curve(plot: Plot, curve: Curve, sources: _Sources) -> tuple[list[GlyphRenderer[Any]], str]:
    """Return the glyphs of a curve, and the column of its values in its source; empty for a band."""
    from bokeh.models import ColumnDataSource

    colour, name = curve.colour, curve.label or None
    width = 1.3 * curve.width if curve.x.size <= _MAX_WIDE_SAMPLES else 1.0
    if curve.style == "band":
        outlines: Any = _outlines(curve)
        source = ColumnDataSource(outlines)
        return [plot.patches("xs", "ys", source=source, color=colour, fill_alpha=0.25, line_color=None, name=name)], ""
    source, y = sources.add(curve.x, curve.y)
    places: dict[str, Any] = {"source": source, "name": name, "color": colour}
    match curve.style:
        case "bars":
            return [plot.vbar("x", top=y, width=bar_width(curve.x), fill_alpha=0.6, line_color=None, **places)], y
        case "stems":
            return [plot.vbar("x", top=y, width=0.3 * bar_width(curve.x), line_color=None, **places)], y
        case "points":
            return [plot.scatter("x", y, size=4.0 * curve.width, **places)], y
        case "marked":
            line = plot.line("x", y, line_width=width, **places)
            return [line, plot.scatter("x", y, size=5.0 * curve.width, **places)], y
        case "step":
            return [plot.step("x", y, mode="after", line_width=width, **places)], y
        case _:
            return [plot.line("x", y, line_width=width, line_dash=_DASHES.get(curve.style, []), **places)], y


def _outlines(curve: Curve) -> dict[str, list[Vector]]:
    """Return the outline of each piece of a band without a NaN; Bokeh's own bands cross NaNs."""
    lower, upper = curve.y, curve.upper_edge
    good = np.isfinite(curve.x + lower + upper)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]]))).reshape(-1, 2).tolist()
    xs = [np.concatenate([curve.x[a:b], curve.x[a:b][::-1]]) for a, b in edges]
    ys = [np.concatenate([lower[a:b], upper[a:b][::-1]]).astype(np.float32) for a, b in edges]
    return {"xs": xs, "ys": ys}
