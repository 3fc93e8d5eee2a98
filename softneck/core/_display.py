"""Text for terminals: short `repr` of softneck's objects, table cells, and a progress bar."""

from __future__ import annotations

import dataclasses
import re
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from ._checks import Progress, silent

# Lines of a `repr` and characters of each.
_LINES, _COLUMNS = 3, 120
# Characters of one value, and entries of one list.
_VALUE, _ITEMS = 40, 4
# Characters that pages and terminals cannot show.
_NOT_PRINTABLE = re.compile(r"[^\x20-\x7e\u00a0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


class ReprMixin:
    """Mixin that gives a dataclass made with `repr=False` a short `repr`."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "\n".join(_lines(self))


def _lines(thing: Any) -> list[str]:
    """Return at most three lines on `thing`: the first of its `summary()`, or its fields."""
    title = type(thing).__name__
    if hasattr(thing, "summary"):
        lines = [_plain(line) for line in f"{title}: {thing.summary()}".splitlines() if line.strip()]
        return [line if len(line) <= _COLUMNS else line[: _COLUMNS - 3] + "..." for line in lines[:_LINES]]
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
    return _NOT_PRINTABLE.sub("\ufffd", " ".join(str(text).split()))


def percent(value: float | None) -> str:
    """Return a fit [%] as a table cell; `-` if it diverged or the output was not measured or is constant."""
    if value is not None and value < -1000.0:
        return "<-1000"
    return "-" if value is None else f"{value:.1f}"


# Time after which the bar appears [s].
_DELAY_S = 2.0


@contextmanager
def shown_progress(what: str, given: Progress | None) -> Iterator[Progress]:
    """Yield the callback that was `given`, or one that draws a bar after two seconds.

    No bar is drawn where stderr is no terminal; `softneck.core.silent` given as callback turns one bar off.
    """
    if given is not None or not sys.stderr.isatty():
        yield given or silent
        return
    bars: list[Any] = []
    since = time.monotonic()

    def tell(done: float, word: str) -> None:
        if not bars and time.monotonic() - since > _DELAY_S:
            bars.append(_bar())
            bars[0].add_task(what, total=1.0)
        if bars:
            bars[0].update(bars[0].task_ids[0], completed=done, description=f"{what}: {word}" if word else what)

    try:
        yield tell
    finally:
        for bar in bars:
            bar.stop()


def bar_columns() -> tuple[Any, ...]:
    """Return the columns of a bar: what is done, how much of it, the time so far and the time left."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    # The time left is by the speed of the last 30 s; what is done before the first part, as compiling, does not count.
    left = TimeRemainingColumn(), TextColumn("left")
    # No markup: a word may name a file, and `run[1].csv` is one.
    return TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn(), *left


def _bar() -> Any:
    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(*bar_columns(), console=Console(stderr=True), transient=True)
    bar.start()
    return bar
