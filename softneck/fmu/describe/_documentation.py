"""What an FMU says about itself beyond its variables: its texts, and `documentation/index.html`.

The page says what the model is, its variables, its timing, and what the host must have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from html import escape

from softneck.runtime import Block, Port

from ._figures import response_figure


@dataclass(frozen=True, slots=True, kw_only=True)
class FmuInfo:
    """Texts for people, and the length of the default experiment.

    Attributes:
        description: one line.
        author: who made the model, "" for none.
        license: SPDX name, "" for none.
        version: of the model, "" for none.
        copyright: one line, "" for none.
        documentation: HTML that goes into the body of `documentation/index.html`: how the model was
            identified, its scores, what it is not good for.
        stop_time: of the default experiment [s].
        robot: name and hash of another robot than the neck, for loops to refuse parts of two.
    """

    description: str = ""
    author: str = ""
    license: str = ""
    version: str = ""
    copyright: str = ""
    documentation: str = ""
    stop_time: float = 10.0
    robot: tuple[str, str] | None = field(default=None, repr=False)  # which an FMU's GUID is made of


# What the slave's syntax needs.
MINIMUM_PYTHON = (3, 11)
HOST_NEEDS = (
    f"The host needs Python {'.'.join(map(str, MINIMUM_PYTHON))} or newer with numpy (nothing of softneck); "
    "a host that is not a Python program finds it through LD_PRELOAD=libpython3.x.so and PYTHONPATH, and is better "
    "served by an FMU of `softneck fmu --backend compiled`, which needs no Python."
)
_NUMBA = (
    "Where the host has numba too, a runtime that is slow in plain Python is compiled or taken from softneck's cache; "
    "the environment variable SOFTNECK_FMU_NUMBA=0 leaves that out, =1 always does it."
)
_PATHS = (
    "pythonfmu's binary decodes only %20 in the path it is unpacked to: keep +, #, %, parentheses and "
    "letters beyond ASCII out of it (softneck's own tools do)."
)
_TIMING = {
    "plant": "Inputs are read at the sample instants and held; the outputs they cause show one sample later.",
    "other": "Inputs are read at the sample instants; the outputs show at once and are held.",
}
_STYLE = (
    "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "svg{width:100%;height:auto;background:#fff}figure{margin:1em 0}pre{overflow:auto}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}"
)


def documentation_page(name: str, block: Block, info: FmuInfo, host: str = "", *, ahead: int = 0) -> str:
    """Return the page as one HTML text without any outside resource.

    Args:
        name: of the model.
        block: with its outputs of the next sample, `ahead` of them.
        info: what the FMU says about itself.
        host: what the host needs; "" for Python.
        ahead: how many of the last outputs the block's own step does not fill.
    """
    own = replace(block, outputs=block.outputs[: len(block.outputs) - ahead])
    title = escape(info.description or f"{block.kind} ({block.role})")
    timing = _TIMING["plant" if block.role == "plant" else "other"]
    parts = [
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(name)}</title>',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{escape(name)}</h1><p>{title}</p>",
        info.documentation,
        response_figure(own),
        "<h2>Variables</h2>",
        _table(block),
        f"<h2>Timing</h2><p>Internal sample time {block.sample_time:g} s; any communication step is legal.",
        f"{timing}</p>",
        f"<h2>Host</h2><p>{escape(host or f'{HOST_NEEDS} {_NUMBA} {_PATHS}')}</p>",
        '<p>Licences: <a href="licenses/">licenses/</a>. '
        f"{escape(' · '.join(text for text in (info.author, info.copyright, info.license) if text))}</p>",
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _table(block: Block) -> str:
    head = "<tr><th>variable</th><th>is</th><th>unit</th><th>start</th><th>range</th><th>meaning</th></tr>"
    rows = [
        _row(port, word)
        for word, ports in (("input", block.inputs), ("output", block.outputs), ("parameter", block.parameters))
        for port in ports
    ]
    return f"<table>{head}{''.join(rows)}</table>"


def _row(port: Port, word: str) -> str:
    low = -math.inf if port.minimum is None else port.minimum
    high = math.inf if port.maximum is None else port.maximum
    span = "" if math.isinf(low) and math.isinf(high) else f"{low:g} to {high:g}"
    start = "" if word == "output" else f"{bool(port.start)}".lower() if port.boolean else f"{port.start:g}"
    unit = "Boolean" if port.boolean else port.unit
    note = " NaN: not measured." if port.missing else ""
    cells = (port.name, word, unit, start, span, port.description + note)
    return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
