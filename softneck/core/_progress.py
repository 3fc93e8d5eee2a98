"""A bar on stderr for what takes more than two seconds in Python; commands have their own."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ._checks import Progress, silent

# Nobody waits for what ends sooner [s].
_PATIENCE = 2.0
_OFF = "SOFTNECK_PROGRESS"


@contextmanager
def shown_progress(what: str, given: Progress | None) -> Iterator[Progress]:
    """Yield the callback that was `given`, or one that draws a bar once two seconds have passed.

    Nothing is drawn where stderr is no terminal or the variable SOFTNECK_PROGRESS is 0; `softneck.core.silent` given
    as callback turns one bar off.
    """
    if given is not None or not sys.stderr.isatty() or os.environ.get(_OFF) == "0":
        yield given or silent
        return
    bars: list[Any] = []
    since = time.monotonic()

    def tell(done: float, word: str) -> None:
        if not bars and time.monotonic() - since > _PATIENCE:
            bars.append(_bar())
            bars[0].add_task(what, total=1.0)
        if bars:
            bars[0].update(bars[0].task_ids[0], completed=done, description=f"{what}: {word}" if word else what)

    try:
        yield tell
    finally:
        for bar in bars:
            bar.stop()


def _bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    # No markup: a word may name a file, and `run[1].csv` is one.
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.start()
    return bar
