"""A progress bar on stderr for Python calls that take more than two seconds; commands draw their own."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ._checks import Progress, silent

# Time after which the bar appears [s].
_DELAY_S = 2.0
_SWITCH_VARIABLE = "SOFTNECK_PROGRESS"


@contextmanager
def shown_progress(what: str, given: Progress | None) -> Iterator[Progress]:
    """Yield the callback that was `given`, or one that draws a bar after two seconds.

    No bar is drawn where stderr is no terminal or the variable SOFTNECK_PROGRESS is 0; `softneck.core.silent` given
    as callback turns one bar off.
    """
    if given is not None or not sys.stderr.isatty() or os.environ.get(_SWITCH_VARIABLE) == "0":
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


def _bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    # No markup: a word may name a file, and `run[1].csv` is one.
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.start()
    return bar
