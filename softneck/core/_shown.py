"""How an object shows itself: three lines in a terminal, the same and a small picture in a notebook."""

from __future__ import annotations

import dataclasses
import html
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ._types import Vector

_LINES, _COLUMNS = 3, 120
# Of one value among others in a line.
_VALUE, _ITEMS = 40, 4
# [px] of a picture, and into how many pieces a curve is cut: the least and the most of each are drawn.
_WIDTH, _HEIGHT, _PIECES = 240, 48, 120
# Seen on light and dark pages; of people who see no red the two of marks differ in brightness.
_COLOURS = ("#3b7dd8", "#e08a1e", "#2a9d70", "#b05fc4")
_HOLDS, _FAILS, _OPEN = "#7fc99a", "#b3261e", "#9a9a9a"
# What XML cannot hold.
_ODD = re.compile(r"[^\x20-\x7e\u00a0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class Shown:
    """Gives a dataclass made with `repr=False` a short `repr` and a page for notebooks."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "\n".join(_lines(self))

    def _repr_html_(self) -> str:
        title, *rest = (html.escape(line) for line in _lines(self))
        text = "".join(f"<br/>{line}" for line in rest)
        return f'<div style="font-family: monospace"><b>{title}</b>{text}<br/>{self._picture()}</div>'

    def _picture(self) -> str:
        """Return an SVG, or nothing."""
        return ""


def sparkline(curves: Iterable[ArrayLike]) -> str:
    """Return curves (time,) of one unit as an SVG; what is not finite is a gap."""
    kept = [np.asarray(curve, dtype=np.float64) for curve in curves]
    finite = [values for curve in kept if (values := curve[np.isfinite(curve)]).size]
    if not finite:
        return ""
    low, high = min(v.min() for v in finite), max(v.max() for v in finite)
    scale = (_HEIGHT - 4) / ((high - low) or 1.0)
    drawn = []
    for number, curve in enumerate(kept):
        path, pen = [], "M"
        for place, value in _pieces(curve):
            path.append("" if np.isnan(value) else f"{pen}{place:.1f} {_HEIGHT - 2 - scale * (value - low):.1f}")
            pen = "M" if np.isnan(value) else "L"
        colour = _COLOURS[number % len(_COLOURS)]
        drawn.append(f'<path d="{"".join(path)}" fill="none" stroke="{colour}"/>')
    return _svg(drawn)


def bars(parts: Mapping[str, float]) -> str:
    """Return name -> [%] as bars below each other with their names; what is below 0 has none."""
    if not parts:
        return ""
    tall = _HEIGHT / len(parts)
    drawn = [f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="none" stroke="{_OPEN}"/>']
    for i, (name, part) in enumerate(parts.items()):
        wide, colour = _WIDTH / 100.0 * min(max(part, 0.0), 100.0), _COLOURS[i % len(_COLOURS)]
        drawn.append(f'<rect y="{i * tall:.1f}" width="{wide:.1f}" height="{tall - 2:.1f}" fill="{colour}"/>')
        said = html.escape(_plain(f"{name} {part:.1f} %"))
        drawn.append(f'<text x="4" y="{(i + 0.6) * tall:.1f}" font-size="11" fill="currentColor">{said}</text>')
    return _svg(drawn)


def marks(holds: Sequence[bool | None]) -> str:
    """Return what holds, fails or is open as squares in a row."""
    side = min(_WIDTH / max(len(holds), 1), 12.0)
    colours = {True: _HOLDS, False: _FAILS, None: _OPEN}
    return _svg(
        f'<rect x="{i * side:.1f}" y="0" width="{0.8 * side:.1f}" height="12" fill="{colours[one]}"/>'
        for i, one in enumerate(holds)
    )  # fmt: skip


def _svg(drawn: Iterable[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}" role="img">{"".join(drawn)}</svg>'
    )


def _pieces(curve: Vector) -> Iterable[tuple[float, float]]:
    """Yield place [px] and value of the least and the most in each piece; NaN where nothing in it is finite."""
    edges = np.unique(np.linspace(0, curve.size, _PIECES + 1).astype(int))
    for start, stop in pairwise(edges.tolist()):
        place, piece = _WIDTH * start / curve.size, curve[start:stop]
        piece = piece[np.isfinite(piece)]
        ends = (piece.min(), piece.max()) if piece.size else (np.nan,)
        yield from ((place, float(value)) for value in (ends if stop - start > 1 else ends[:1]))


def _lines(thing: Any) -> list[str]:
    """Return at most three lines on `thing`: the first of its `summary()`, or its fields."""
    title = type(thing).__name__
    if hasattr(thing, "summary"):
        said = [_plain(line) for line in f"{title}: {thing.summary()}".splitlines() if line.strip()]
        return [line if len(line) <= _COLUMNS else line[: _COLUMNS - 3] + "..." for line in said[:_LINES]]
    fields = ", ".join(f"{f.name}={_short(getattr(thing, f.name))}" for f in dataclasses.fields(thing) if f.repr)
    return textwrap.wrap(f"{title}({fields})", _COLUMNS, max_lines=_LINES, placeholder=" ...", subsequent_indent="  ")


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, Mapping):
        names = [_plain(key)[:_VALUE] for key in list(value)[:_ITEMS]]
        return "{" + ", ".join(names) + (f", ... {len(value)}" if len(value) > _ITEMS else "") + "}"
    if isinstance(value, list | tuple):
        some = ", ".join(map(_short, value[:_ITEMS]))
        return f"[{some}{f', ... {len(value)}' if len(value) > _ITEMS else ''}]"
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    text = _plain(repr(value))
    return text if len(text) <= _VALUE else text[: _VALUE - 3] + "..."


def _plain(text: Any) -> str:
    return _ODD.sub("\ufffd", " ".join(str(text).split()))


def percent(value: float | None) -> str:
    """Return a fit for a table cell; `-` where there is none: it diverged, or nothing was measured or moved."""
    if value is not None and value < -1000.0:
        return "<-1000"
    return "-" if value is None else f"{value:.1f}"
