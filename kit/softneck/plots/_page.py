"""Self-contained HTML pages: text, tables and figures in one file that opens offline."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
from matplotlib.figure import Figure

from softneck.core import atomic_write

_TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --ink: #1c2530; --paper: #fbfbf9; --line: #d5d9de; --good: #00734f; --bad: #b3400a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e8ec; --paper: #15191e; --line: #3a424b; --good: #4cc39a; --bad: #ff9a66; } }
* { box-sizing: border-box; }
body { font: 16px/1.55 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 66rem; padding: 1rem; }
h1 { font-size: 1.7rem; line-height: 1.2; } h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; } a { color: inherit; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; margin: .6rem 0; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { white-space: normal; vertical-align: bottom; }
th.text, td.text { text-align: left; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
td.holds { color: var(--good); font-weight: 600; } td.fails { color: var(--bad); font-weight: 600; }
figure { margin: 1rem 0; } figure img { width: 100%; background: #fff; border-radius: 4px; display: block; }
figcaption { font-size: .9rem; } footer { margin-top: 3rem; font-size: .85rem; border-top: 1px solid var(--line); }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<nav>{% for section in sections %}<a href="#s{{ loop.index }}">{{ section.title }}</a>{% endfor %}</nav>
{% for section in sections %}
<section id="s{{ loop.index }}">
<h2>{{ section.title }}</h2>
{% for paragraph in section.text %}<p>{{ paragraph }}</p>{% endfor %}
{% for table in section.tables %}
<div class="scroll"><table><caption>{{ table.caption }}</caption>
<thead><tr>{% for cell in table.head -%}
<th{% if loop.index <= table.text %} class="text"{% endif %}>{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>{% for row in table.rows %}<tr>{% for cell in row %}<td{% if cell in ("holds", "fails") %} class="{{ cell }}"
{%- elif loop.index <= table.text %} class="text"{% endif %}>{{ cell }}</td>{% endfor %}</tr>{% endfor %}
</tbody></table></div>
{% endfor %}
{% for figure in section.figures %}
<figure><img alt="{{ figure.caption }}" src="data:image/png;base64,{{ figure.data }}">
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}
</section>
{% endfor %}
<footer>{{ footer }}</footer>
</body>
</html>
"""


@dataclass(frozen=True, slots=True)
class Table:
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


@dataclass(frozen=True, slots=True)
class Section:
    """One part of a page: paragraphs, then tables, then figures with captions."""

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, Figure]] = field(default=())


@dataclass(frozen=True, slots=True)
class _Picture:
    caption: str
    data: str


def page(title: str, sections: Sequence[Section], *, footer: str = "") -> str:
    """Return the HTML text of a page; all text is escaped, figures are inside."""
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_TEMPLATE)
    parts = [
        {
            "title": section.title,
            "text": section.text,
            "tables": section.tables,
            "figures": [_Picture(caption, figure_png(figure)) for caption, figure in section.figures],
        }
        for section in sections
    ]
    return template.render(title=title, sections=parts, footer=footer)


def write_page(path: str | Path, html: str, *, force: bool = False) -> None:
    """Write a page in one piece; raises OutputError if it exists (and not `force`) or cannot be written."""
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(html, encoding="utf-8")


def figure_png(figure: Figure) -> str:
    """Return a figure as base64 text of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode()
