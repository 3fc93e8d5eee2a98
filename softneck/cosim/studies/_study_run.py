"""One run of a study, in whatever process: a loop out of its table, simulated, judged, as one row."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from softneck.core import SoftneckError

from ..loops._loop_file import make_loop
from ..loops._loop_table import with_values
from ..loops._simulate import run_setup
from ._vary import Point

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Some runs of a study: all that a worker needs to know.

    Attributes:
        digest: of the study; runs of one study share opened files.
        loop: its table.
        folder: where relative paths start.
        points: what to run.
        metrics: the names of all that a run is judged by.
    """

    digest: str
    loop: Mapping[str, Any]
    folder: Path
    points: Sequence[Point]
    metrics: Sequence[str]


def run_chunk(chunk: Chunk) -> list[Row]:
    """Return a row for each run, failed ones with their error."""
    return [run_point(chunk, point) for point in chunk.points]


def run_point(chunk: Chunk, point: Point) -> Row:
    """Return the row of one run: number, sample, seed, labels, metrics, whether limits hold, error, seconds."""
    begin = time.perf_counter()
    row: Row = {"run": point.run, "sample": point.sample, "seed": point.seed, **point.labels}
    row |= dict.fromkeys(chunk.metrics)
    row |= {"holds": None, "error": ""}
    try:
        row |= _judged(chunk, point)
    except SoftneckError as error:
        row["error"] = " ".join(str(error).split())
    except Exception as error:  # whatever a part of the user's raises costs its run, not the study
        row["error"] = " ".join(f"{type(error).__name__}: {error}".split())
    row["seconds"] = time.perf_counter() - begin
    return row


def release(digest: str) -> None:
    """Close what this thread has opened for a study; worker processes end with all that they hold."""
    opened = _opened(digest, threading.get_ident())
    for part in opened.values():
        if hasattr(part, "advance"):
            part.close()
    opened.clear()


def failed_row(point: Point, error: str, metrics: Sequence[str]) -> Row:
    """Return the row of a run that no process could finish."""
    row: Row = {"run": point.run, "sample": point.sample, "seed": point.seed, **point.labels}
    return row | dict.fromkeys(metrics) | {"holds": False, "error": error, "seconds": None}


def _judged(chunk: Chunk, point: Point) -> Row:
    opened = _opened(chunk.digest, threading.get_ident())
    setup = make_loop(with_values(chunk.loop, point.values), chunk.folder, opened=opened)
    try:
        result = run_setup(setup, compiled=True, keep=True)
    finally:
        # FMUs stay loaded for the next run; what this run alone holds is released.
        kept = [id(part) for part in opened.values()]
        for part in setup.loop.parts.values():
            if id(part) not in kept:
                part.close()
    table = result.metrics
    values = {f"{group}.{name}": value for group, metrics in table.items() for name, value in metrics.items()}
    return {**{name: values[name] for name in chunk.metrics}, "holds": result.holds if setup.limits else None}


@lru_cache(maxsize=64)
def _opened(digest: str, thread: int) -> dict[Any, Any]:
    """Return what this thread has opened for a study: a Dask worker may have several, and an FMU serves one."""
    del digest, thread
    return {}
