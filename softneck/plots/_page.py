"""Self-contained HTML pages: text, tables and figures in one file that opens offline."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from softneck.core import atomic_write
from softneck.core._shown import Shown

from ._chart import Chart
from ._interactive import LICENCE, draw, library
from ._packed import Packer, thinned

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, repr=False)
class Table(Shown):
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
class Section(Shown):
    """One part of a page; what is shown stands before its numbers, and these before how they came about.

    Attributes:
        title: of the part.
        text: paragraphs.
        tables: under the pictures.
        figures: captions and matplotlib figures.
        charts: interactive ones.
        findings: severity (ok, note, warning) and a sentence of each; a numbered list.
        method: paragraphs at the end: how the numbers are defined and made.
        cards: what leads elsewhere: title, link, a small picture as SVG and a line of text.
    """

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, Figure]] = field(default=())
    charts: Sequence[Chart] = ()
    findings: Sequence[tuple[str, str]] = ()
    method: Sequence[str] = ()
    cards: Sequence[tuple[str, str, str, str]] = ()


def page(
    title: str, sections: Sequence[Section], *, verdict: str = "", holds: bool | None = None, footer: str = ""
) -> str:
    """Return the HTML text of a page; all text is escaped, figures, charts and what draws them are inside.

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
    packer = Packer()
    parts = [_part(number, section, charts, packer) for number, section in enumerate(sections, start=1)]
    script = Markup(library()) if any(section.charts for section in sections) else ""
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_file("_page.html"))
    return template.render(
        title=title, verdict=verdict, mark={None: "", True: "holds", False: "fails"}[holds], sections=parts,
        footer=footer, library=script, licence=LICENCE, charts=Markup(packer.text()), start=Markup(_file("_page.js")),
    )  # fmt: skip


def _part(number: int, section: Section, charts: Iterator[Chart], packer: Packer) -> dict[str, Any]:
    """Return what the template shows of a section; its charts' numbers go to the packer."""
    shown = []
    for k, _ in enumerate(section.charts, start=1):
        chart, name = next(charts), f"c{number}-{k}"
        item, height = draw(chart)
        packer.add(name, item)
        shown.append({"id": name, "title": chart.title, "caption": chart.caption, "height": height})
    figures = [{"caption": caption, "data": figure_png(figure)} for caption, figure in section.figures]
    cards = [{"title": a, "link": b, "picture": Markup(c), "text": d} for a, b, c, d in section.cards]
    taken = {name: getattr(section, name) for name in ("title", "text", "tables", "findings", "method")}
    return {**taken, "charts": shown, "figures": figures, "cards": cards}


def _file(name: str) -> str:
    return files("softneck.plots").joinpath(name).read_text(encoding="utf-8")


def write_page(path: str | Path, html: str, *, force: bool = False) -> None:
    """Write a page in one piece; raises OutputFileError if it exists (and not `force`) or cannot be written."""
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(html, encoding="utf-8")


def figure_png(figure: Figure) -> str:
    """Return a figure as base64 text of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode()
