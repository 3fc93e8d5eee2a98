"""Output of the commands: tables for people, one JSON object for programs, progress on stderr."""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import click

from softneck import identification
from softneck.core import Progress, bar_columns, silent, to_json
from softneck.core import Progress as ProgressCallback
from softneck.core import percent as percent


def print_json(value: Any) -> None:
    """Print one JSON object; numbers that JSON does not have become null."""
    click.echo(json.dumps(to_json(value, str), indent=2, allow_nan=False))


# A pipe or a log has no width: no table is cut there.
_NO_EDGE = 1_000_000


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on stdout, the first column to the left and the others to the right.

    All of it is printed as it is: rich would take `[rad]` in a string for markup, `:key:` for a picture.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(header_style="bold", pad_edge=False)
    for index, (name, *cells) in enumerate(itertools.zip_longest(head, *rows, fillvalue="")):
        # A narrow terminal folds cells between words; no column disappears.
        longest = max(map(len, " ".join((name, *cells)).split()), default=0)
        table.add_column(Text(name), justify="left" if index == 0 else "right", min_width=longest)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console(width=None if sys.stdout.isatty() else _NO_EDGE)
    # A line of its own: as the table's title a path would be folded to the table's width.
    console.print(Text(title, style="table.title"), soft_wrap=True)
    console.print(table, crop=False)


def note(message: str) -> None:
    """Print a remark for people on stderr."""
    click.echo(message, err=True)


@contextlib.contextmanager
def progress(what: str, *, quiet: bool = False) -> Iterator[ProgressCallback]:
    """Yield a callback (part done, word) that draws a bar on stderr; a line where stderr is not a terminal."""
    if quiet:
        yield silent
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        note(f"{what} ...")
        yield silent
        return
    with Progress(SpinnerColumn(), *bar_columns(), console=console, transient=True) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda done, word: bar.update(task, completed=done, description=f"{what}: {word}")


@contextlib.contextmanager
def stages(*, quiet: bool) -> Iterator[Callable[[str], Progress]]:
    """Yield a function that starts a stage; each ends when the next begins, and its time is printed."""
    with contextlib.ExitStack() as stack:

        def begin(name: str) -> Progress:
            stack.close()
            since = time.monotonic()
            if not quiet:
                stack.callback(lambda: note(f"{name}: {time.monotonic() - since:.1f} s"))
            return stack.enter_context(progress(name, quiet=quiet))

        yield begin


# [%] The fit of the constant mean; a model below it is useless.
_MIN_FIT_PCT = 0.0
# [%] The least fit that `design` accepts.
_MIN_DESIGN_FIT_PCT = 30.0


def useless(r: identification.Validation) -> str | None:
    """Return why a model is no model of the rows that it was judged on, or None."""
    if r.diverged is not None:
        return f"its simulation diverges at {r.diverged:.2f} s"
    fits = [(fit, "in simulation" if h == "inf" else f"{h} sample(s) ahead", axis)
            for h, table in r.fits.items() for axis, fit in table.items() if fit is not None]  # fmt: skip
    worst, horizon, axis = min(fits, default=(0.0, "", ""))
    return f"its fit {horizon} is {percent(worst)} % in {axis}" if worst < _MIN_FIT_PCT else None


def left_out(r: identification.Validation) -> str:
    """Return the advice to go on without the outputs that spoil a model of the others; "" where that is no way out."""
    fits = {axis: fit for axis, fit in r.fits.get("inf", {}).items() if fit is not None}
    poor = [axis for axis, fit in fits.items() if fit < _MIN_FIT_PCT]
    good = [axis for axis in fits if axis not in poor]
    if r.diverged is not None or not poor or not good or min(fits[axis] for axis in good) < _MIN_DESIGN_FIT_PCT:
        return ""
    said = "/".join(percent(fits[axis]) for axis in good)
    without = ", ".join(poor)
    return f"Leave {without} out of `outputs.names` in a robot.toml: without it {', '.join(good)} fits {said} %."
