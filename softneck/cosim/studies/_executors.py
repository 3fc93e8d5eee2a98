"""Where the runs of a study run: this process, local processes of loky, or a Dask cluster; all are executors."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from softneck.core import SettingsError, SoftneckError, require_package

# One thread each: the processes share the cores already.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_CONNECT_S = 10


@dataclass(slots=True, eq=False)
class Crew:
    """Workers.

    Attributes:
        size: how many there are.
        pool: gives them work, as futures.
        start: makes a pool of so many new ones; None where a dead one is replaced by others.
    """

    size: int
    pool: Executor
    start: Callable[[int], Executor] | None = None

    def renew(self, *, alone: bool) -> None:
        """Take new workers after one broke and took its pool along; a single one if `alone`."""
        if self.start is not None:
            _end(self.pool, kill=True)
            self.pool = self.start(1 if alone else self.size)


class Here(Executor):
    """This process: no second one, nothing to send; a part that crashes takes all along."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Do the work now."""
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextlib.contextmanager
def crew(workers: int | None, dask: str | None) -> Iterator[Crew]:
    """Yield the workers: a cluster's, so many local processes (as many as cores by default), or this process for 0.

    Raises:
        SettingsError: an impossible number of workers, both at once, or a scheduler that cannot be reached.
    """
    if dask is not None:
        if workers is not None:
            raise SettingsError("give workers or a Dask scheduler, not both: a cluster has its own workers.")
        with contextlib.closing(_client(dask)) as client:
            there = client.scheduler_info(n_workers=-1)["workers"].values()
            pool = client.get_executor(pure=False)
            try:
                yield Crew(max(1, sum(int(worker["nthreads"]) for worker in there)), pool)
            finally:
                pool.shutdown(wait=False)
        return
    number = _cores() if workers is None else workers
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise SettingsError(f"`workers` must be a whole number of at least 1 (0: this process); got {number!r}.")
    if number == 0:
        yield Crew(1, Here())
        return
    with tempfile.TemporaryDirectory(prefix="softneck-study-", ignore_cleanup_errors=True) as folder:
        start = partial(_processes, folder)
        found = Crew(number, start(number), start)
        try:
            yield found
        except BaseException:
            _end(found.pool, kill=True)
            raise
        _end(found.pool, kill=False)


def _client(address: str) -> Any:
    """Return the client of a Dask scheduler."""
    require_package("distributed")
    from distributed import Client

    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise SettingsError(
            f"no Dask scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`."
        ) from error


def _processes(folder: str, size: int) -> Executor:
    """Return a pool of loky: started anew (no forked threads), without a second import of the user's script."""
    from loky import ProcessPoolExecutor

    return ProcessPoolExecutor(size, timeout=None, initializer=_begin_worker, initargs=(folder,), env=_ENVIRONMENT)


def _end(pool: Any, *, kill: bool) -> None:
    pool.shutdown(wait=True, kill_workers=kill)


def check_sendable(what: Any) -> None:
    """Raise SettingsError if `what` cannot go to another process."""
    import cloudpickle

    try:
        cloudpickle.dumps(what)
    except SoftneckError:
        raise
    except Exception as error:  # whatever a user's object raises when it is taken apart
        raise SettingsError(
            f"the loop holds a part that cannot be sent to another process ({error}); use workers = 0, "
            'or python = "package.module:factory".'
        ) from error


def _begin_worker(folder: str) -> None:
    # Ctrl-C is the parent's to handle; what FMUs unpack goes where the parent removes it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tempfile.tempdir = folder


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
