"""Self-contained HTML pages: text, tables and charts in one file that opens offline."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from softneck.core import ReprMixin, percent, write_text

from ._chart import Chart, Curve
from ._interactive import LICENCE, draw, gzip_base64, library


@dataclass(frozen=True, slots=True, repr=False)
class Table(ReprMixin):
    """A table, whose first `text` columns hold words instead of numbers; cells "holds" and "fails" are coloured."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int = 1


def cell(value: Any, spec: str = ".4g") -> str:
    """Return a value as a table cell: a float by `spec` (`%`: a fit), `-` for None and NaN, `/` between outputs."""
    if isinstance(value, Mapping):
        return "/".join(cell(item, spec) for item in value.values())
    if value is None or value != value:
        return "-"
    if not isinstance(value, float):
        return str(value)
    return percent(value) if spec == "%" else f"{value:{spec}}"


@dataclass(frozen=True, slots=True, repr=False)
class Section(ReprMixin):
    """A part of a page: charts first, then numbers, then methods.

    Attributes:
        tables: under the charts.
        findings: (severity, sentence) pairs, a numbered list; severity is ok, note or warning.
        method: paragraphs at the end: definitions and methods of the numbers.
        html: controls above the charts, as trusted HTML.
    """

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    findings: Sequence[tuple[str, str]] = ()
    method: Sequence[str] = ()
    html: str = ""


@dataclass(frozen=True, slots=True, repr=False)
class Script(ReprMixin):
    """JavaScript that runs when the charts are drawn; it reads `data` (JSON values) by `await unpacked("data")`."""

    text: str
    data: Any


def page(
    title: str, sections: Sequence[Section], *, verdict: str = "", holds: bool | None = None, footer: str = "",
    script: Script | None = None,
) -> str:  # fmt: skip
    """Return the HTML text of a page; all text is escaped, charts and their library are included.

    Its content security policy forbids every request.

    Args:
        sections: the first one shows the evidence for the verdict.
        verdict: one sentence, at the top.
        holds: whether the verdict is good or bad; None: neither.
        footer: program that wrote the page.
        script: of the controls in the sections' `html`.
    """
    import jinja2

    charts = iter(thin_charts([chart for section in sections for chart in section.charts]))
    drawn: dict[str, Any] = {}
    parts = [_part(number, section, charts, drawn) for number, section in enumerate(sections, start=1)]
    packed = _packed(drawn)
    own = None if script is None else {"text": Markup(script.text), "data": _packed(script.data)}
    code = Markup(library()) if any(section.charts for section in sections) else ""
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_file("_page.html"))
    return template.render(
        title=title, verdict=verdict, mark={None: "", True: "holds", False: "fails"}[holds], sections=parts,
        footer=footer, library=code, licence=LICENCE, charts=packed, start=Markup(_file("_page.js")), script=own,
    )  # fmt: skip


def _part(number: int, section: Section, charts: Iterator[Chart], drawn: dict[str, Any]) -> dict[str, Any]:
    """Return the template's values for a section; its charts are added to `drawn`."""
    parts = []
    for k, _ in enumerate(section.charts, start=1):
        chart, name = next(charts), f"c{number}-{k}"
        drawn[name], height = draw(chart)
        parts.append({"id": name, "title": chart.title, "caption": chart.caption, "height": height})
    taken = {name: getattr(section, name) for name in ("title", "text", "tables", "findings", "method")}
    return {**taken, "charts": parts, "html": Markup(section.html)}


def _packed(values: Any) -> Markup:
    return Markup(gzip_base64(json.dumps(values, separators=(",", ":")).encode()))


def _file(name: str) -> str:
    return files("softneck.plots").joinpath(name).read_text(encoding="utf-8")


def write_page(path: str | Path, html: str, *, force: bool = False) -> None:
    """Write a page atomically; raise OutputFileError if it exists (and not `force`) or cannot be written."""
    write_text(path, html, force=force)


# Samples of a page: about three bytes each when compressed, four as text.
_MAX_SAMPLES = 300_000
_CONTINUOUS_STYLES = ("line", "dashed", "dotted", "step", "band", "points")


def thin_charts(charts: Sequence[Chart], most: int = _MAX_SAMPLES) -> list[Chart]:
    """Return charts with at most `most` samples; longer curves are reduced to extremes, which captions mention."""
    sizes = [curve.y.size for chart in charts for panel in chart.panels for curve in panel.curves]
    limit = max(sizes, default=0)
    while sum(min(size, limit) for size in sizes) > most:
        limit = int(0.9 * limit)
    return [_thin_chart(chart, limit) for chart in charts]


def _thin_chart(chart: Chart, limit: int) -> Chart:
    longest = max((curve.y.size for panel in chart.panels for curve in panel.curves), default=0)
    if longest <= limit:
        return chart
    panels = [replace(panel, curves=[_thin_curve(curve, limit) for curve in panel.curves]) for panel in chart.panels]
    note = f"Of {longest} samples the minimum and the maximum of each {2 * longest / limit:.0f} are drawn."
    return replace(chart, panels=panels, caption=f"{chart.caption} {note}".strip())


def _thin_curve(curve: Curve, limit: int) -> Curve:
    """Return the minimum and the maximum of each piece, in their order, at its first and middle x."""
    if curve.y.size <= limit or curve.style not in _CONTINUOUS_STYLES:
        return curve
    edges = np.unique(np.linspace(0, curve.y.size, limit // 2 + 1).astype(int))
    start, stop = edges[:-1], edges[1:]
    x = np.column_stack([curve.x[start], curve.x[(start + stop) // 2]]).ravel()
    least, most = (np.where(np.isnan(curve.y), fill, curve.y) for fill in (np.inf, -np.inf))
    low, high = np.minimum.reduceat(least, start), np.maximum.reduceat(most, start)
    gap = ~np.isfinite(low)
    low[gap] = high[gap] = np.nan
    if curve.upper is not None:
        top = np.maximum.reduceat(np.where(np.isnan(curve.upper), -np.inf, curve.upper), start)
        top[~np.isfinite(top)] = np.nan
        return replace(curve, x=x, y=np.repeat(low, 2), upper=np.repeat(top, 2))
    falls = curve.y[stop - 1] < curve.y[start]
    pair = np.where(falls[:, None], np.column_stack([high, low]), np.column_stack([low, high]))
    return replace(curve, x=x, y=pair.ravel())
