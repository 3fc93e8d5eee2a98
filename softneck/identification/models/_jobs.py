"""Training of several models at once, in processes of their own."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from softneck.core import Progress

# One thread for each matrix product: the processes share the cores already.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A function of a module and what to call it with; `name` is for people."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def done(jobs: Sequence[Job], workers: int, progress: Progress) -> list[Any]:
    """Return what each job returns; in so many processes, or here for 1.

    Raises whatever a job raises; the others are ended then, as they are by Ctrl-C.
    """
    if workers < 2:
        found = []
        for number, job in enumerate(jobs):
            progress(number / len(jobs), job.name)
            found.append(job.function(*job.arguments))
        return found
    from loky import ProcessPoolExecutor, as_completed

    pool = ProcessPoolExecutor(workers, timeout=None, initializer=_begin_worker, env=_ENVIRONMENT)
    try:
        futures = [pool.submit(job.function, *job.arguments) for job in jobs]
        progress(0.0, f"{len(jobs)} models in {workers} processes")
        for number, future in enumerate(as_completed(futures), start=1):
            future.result()
            progress(number / len(jobs), f"{number} of {len(jobs)} models")
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)
    return [future.result() for future in futures]


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
