"""Self-contained HTML pages: text, tables and figures in one file that opens offline."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from softneck.core import atomic_write

from ._chart import Chart
from ._interactive import draw, library

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline';
 style-src 'unsafe-inline'; img-src data: blob:">
<link rel="icon" href="data:,">
<title>{{ title }}</title>
<style>
:root { color-scheme: light dark; --ink: #1c2530; --paper: #fbfbf9; --line: #d5d9de; --good: #00734f; --bad: #b3400a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e8ec; --paper: #15191e; --line: #3a424b; --good: #4cc39a; --bad: #ff9a66; } }
* { box-sizing: border-box; }
body { font: 16px/1.55 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0 auto;
  max-width: 66rem; padding: 1rem; }
h1, h2, h3, p, nav a { overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; line-height: 1.2; } h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; } a { color: inherit; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; margin: .6rem 0; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { white-space: normal; vertical-align: bottom; }
th.text, td.text { text-align: left; } td.text ~ td.text { white-space: normal; min-width: 16rem; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
td.holds { color: var(--good); font-weight: 600; } td.fails { color: var(--bad); font-weight: 600; }
figure { margin: 1rem 0; } figure img { width: 100%; background: #fff; border-radius: 4px; display: block; }
figcaption { font-size: .9rem; } .chart { background: #fff; border-radius: 4px; padding: .2rem; }
figure h3 { font-size: 1rem; margin: .4rem 0; } .hint { font-size: .85rem; opacity: .8; }
footer { margin-top: 3rem; font-size: .85rem; border-top: 1px solid var(--line); }
</style>
</head>
<body>
<h1>{{ title }}</h1>
{% if library %}<p class="hint">Plots: drag to zoom, Ctrl and wheel to zoom along x, click a name to hide its
curves; the tools beside a plot move and reset it, and save it as a picture.</p>{% endif %}
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
{% for chart in section.charts %}
<figure><h3>{{ chart.title }}</h3>
<div class="chart" id="{{ chart.id }}" role="img" aria-label="{{ chart.title }}"
 style="min-height: {{ chart.height }}px">
<noscript>This plot is drawn by JavaScript, which is switched off here.</noscript></div>
{% if chart.caption %}<figcaption>{{ chart.caption }}</figcaption>{% endif %}</figure>
<script type="application/json" id="{{ chart.id }}-data">{{ chart.data }}</script>
{% endfor %}
{% for figure in section.figures %}
<figure><img alt="{{ figure.caption }}" src="data:image/png;base64,{{ figure.data }}">
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}
</section>
{% endfor %}
<footer>{{ footer }}</footer>
{% if library %}
<script id="library">{{ library }}</script>
{% endif %}
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
    """One part of a page: paragraphs, then tables, then interactive charts, then figures with captions."""

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, Figure]] = field(default=())
    charts: Sequence[Chart] = ()


@dataclass(frozen=True, slots=True)
class _Picture:
    caption: str
    data: str


@dataclass(frozen=True, slots=True)
class _Plot:
    id: str
    title: str
    caption: str
    data: Markup
    height: int


def page(title: str, sections: Sequence[Section], *, footer: str = "") -> str:
    """Return the HTML text of a page; all text is escaped, figures, charts and what draws them are inside.

    The page forbids itself every request, by its content security policy.
    """
    import jinja2

    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_TEMPLATE)
    parts = [
        {
            "title": section.title,
            "text": section.text,
            "tables": section.tables,
            "charts": [_plot(f"c{number}-{k}", chart) for k, chart in enumerate(section.charts, start=1)],
            "figures": [_Picture(caption, figure_png(figure)) for caption, figure in section.figures],
        }
        for number, section in enumerate(sections, start=1)
    ]
    script = Markup(library()) if any(section.charts for section in sections) else ""
    return template.render(title=title, sections=parts, footer=footer, library=script)


def _plot(name: str, chart: Chart) -> _Plot:
    drawn = draw(chart)
    # Its JSON holds no `<`.
    return _Plot(name, chart.title, chart.caption, Markup(drawn.data), drawn.height)


def write_page(path: str | Path, html: str, *, force: bool = False) -> None:
    """Write a page in one piece; raises OutputFileError if it exists (and not `force`) or cannot be written."""
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(html, encoding="utf-8")


def figure_png(figure: Figure) -> str:
    """Return a figure as base64 text of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return base64.b64encode(buffer.getvalue()).decode()
