"""Self-contained HTML pages: text, tables and figures in one file that opens offline."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from softneck.core import ReprMixin, atomic_write

from ._chart import Chart, Curve
from ._interactive import LICENCE, compressed, draw, library


@dataclass(frozen=True, slots=True, repr=False)
class Table(ReprMixin):
    """A table of text; a cell "holds" or "fails" is coloured.

    Attributes:
        caption: above it.
        head: titles of the columns.
        rows: of cells.
        text: so many columns, from the first, hold words and not numbers.
    """

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: int = 1


@dataclass(frozen=True, slots=True, repr=False)
class Section(ReprMixin):
    """One part of a page; what is shown stands before its numbers, and these before how they came about.

    Attributes:
        title: of the part.
        text: paragraphs.
        tables: under the pictures.
        charts: interactive ones.
        findings: severity (ok, note, warning) and a sentence of each; a numbered list.
        method: paragraphs at the end: how the numbers are defined and made.
    """

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    findings: Sequence[tuple[str, str]] = ()
    method: Sequence[str] = ()


def page(
    title: str, sections: Sequence[Section], *, verdict: str = "", holds: bool | None = None, footer: str = ""
) -> str:
    """Return the HTML text of a page; all text is escaped, charts and what draws them are inside.

    The page forbids itself every request, by its content security policy.

    Args:
        title: says the thing.
        sections: the first of them shows what proves the verdict.
        verdict: one sentence, before all else.
        holds: whether that is good or bad news; None: neither.
        footer: who wrote the page.
    """
    import jinja2

    charts = iter(thinned([chart for section in sections for chart in section.charts]))
    drawn: dict[str, Any] = {}
    parts = [_part(number, section, charts, drawn) for number, section in enumerate(sections, start=1)]
    packed = Markup(compressed(json.dumps(drawn, separators=(",", ":")).encode()))
    script = Markup(library()) if any(section.charts for section in sections) else ""
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_file("_page.html"))
    return template.render(
        title=title, verdict=verdict, mark={None: "", True: "holds", False: "fails"}[holds], sections=parts,
        footer=footer, library=script, licence=LICENCE, charts=packed, start=Markup(_file("_page.js")),
    )  # fmt: skip


def _part(number: int, section: Section, charts: Iterator[Chart], drawn: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a section; its charts go to `drawn`."""
    shown = []
    for k, _ in enumerate(section.charts, start=1):
        chart, name = next(charts), f"c{number}-{k}"
        drawn[name], height = draw(chart)
        shown.append({"id": name, "title": chart.title, "caption": chart.caption, "height": height})
    taken = {name: getattr(section, name) for name in ("title", "text", "tables", "findings", "method")}
    return {**taken, "charts": shown}


def _file(name: str) -> str:
    return files("softneck.plots").joinpath(name).read_text(encoding="utf-8")


def write_page(path: str | Path, html: str, *, force: bool = False) -> None:
    """Write a page in one piece; raises OutputFileError if it exists (and not `force`) or cannot be written."""
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(html, encoding="utf-8")


# Samples of a page: compressed, about three bytes each, and a third more as text.
_MOST_SAMPLES = 300_000
_CONTINUOUS = ("line", "dashed", "dotted", "step", "band", "points")


def thinned(charts: Sequence[Chart], most: int = _MOST_SAMPLES) -> list[Chart]:
    """Return charts of at most `most` samples: as they are, or their longest curves in pieces; captions say so."""
    sizes = [curve.y.size for chart in charts for panel in chart.panels for curve in panel.curves]
    limit = max(sizes, default=0)
    while sum(min(size, limit) for size in sizes) > most:
        limit = int(0.9 * limit)
    return [_thinned(chart, limit) for chart in charts]


def _thinned(chart: Chart, limit: int) -> Chart:
    longest = max(curve.y.size for panel in chart.panels for curve in panel.curves)
    if longest <= limit:
        return chart
    panels = [replace(panel, curves=[_piecewise(curve, limit) for curve in panel.curves]) for panel in chart.panels]
    said = f"Of {longest} samples the least and the most of each {2 * longest / limit:.0f} are drawn."
    return replace(chart, panels=panels, caption=f"{chart.caption} {said}".strip())


def _piecewise(curve: Curve, limit: int) -> Curve:
    """Return the least and the most of each piece, in the order in which they came, at its first and middle x."""
    if curve.y.size <= limit or curve.style not in _CONTINUOUS:
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
