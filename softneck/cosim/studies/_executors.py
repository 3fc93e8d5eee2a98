"""Where the runs of a study run: this process, local processes, or a Dask cluster; one interface, that of futures."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import Any, Protocol

from softneck.core import SettingsError, SoftneckError
from softneck.core._errors import require_package

# One thread each: the processes share the cores already.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_CONNECT_S = 10


class Crew(Protocol):
    """Workers that take work as futures.

    Attributes:
        size: how many there are.
    """

    size: int

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Give out some work."""
        ...

    def renew(self, *, alone: bool) -> None:
        """Take new workers after one broke and took its pool along; a single one if `alone`."""
        ...


class Here:
    """This process: no second one, nothing to send; a part that crashes takes all along."""

    size = 1

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Do the work now."""
        future: Future = Future()
        future.set_result(function(*arguments))
        return future

    def renew(self, *, alone: bool) -> None:
        """Do nothing."""


class Processes:
    """Local processes of loky: started anew (no forked threads), without a second import of the user's script."""

    def __init__(self, size: int) -> None:
        """Start `size` workers."""
        self.size = size
        self._folder = tempfile.mkdtemp(prefix="softneck-study-")
        self._pool = self._start(size)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Give work to a worker."""
        return self._pool.submit(function, *arguments)

    def renew(self, *, alone: bool) -> None:
        """Start new workers; those that are left of the old ones end."""
        self._pool.shutdown(wait=True, kill_workers=True)
        self._pool = self._start(1 if alone else self.size)

    def close(self, *, kill: bool = False) -> None:
        """End the workers, at once with `kill`."""
        self._pool.shutdown(wait=True, kill_workers=kill)
        shutil.rmtree(self._folder, ignore_errors=True)

    def _start(self, size: int) -> Any:
        from loky import ProcessPoolExecutor

        return ProcessPoolExecutor(
            size, timeout=None, initializer=_begin_worker, initargs=(self._folder,), env=_ENVIRONMENT
        )


class Cluster:
    """The workers of a Dask scheduler, through its futures."""

    def __init__(self, address: str) -> None:
        """Connect.

        Raises:
            SettingsError: no such scheduler, or Dask is not installed.
        """
        require_package("distributed")
        from distributed import Client

        try:
            self._client: Any = Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError) as error:
            raise SettingsError(
                f"no Dask scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`."
            ) from error
        self._pool: Executor = self._client.get_executor(pure=False)
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        self.size = max(1, sum(int(worker["nthreads"]) for worker in workers))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Give work to the cluster; it runs it again elsewhere if a worker dies."""
        return self._pool.submit(function, *arguments)

    def renew(self, *, alone: bool) -> None:
        """Do nothing: the scheduler replaces its workers."""

    def close(self) -> None:
        """Disconnect."""
        self._pool.shutdown(wait=False)
        self._client.close()


@contextlib.contextmanager
def crew(workers: int | None, dask: str | None) -> Iterator[Crew]:
    """Yield the workers: a cluster's, so many local processes (as many as cores by default), or this process for 0.

    Raises:
        SettingsError: an impossible number of workers, both at once, or a scheduler that cannot be reached.
    """
    if dask is not None:
        if workers is not None:
            raise SettingsError("give workers or a Dask scheduler, not both: a cluster has its own workers.")
        cluster = Cluster(dask)
        with contextlib.closing(cluster):
            yield cluster
        return
    number = _cores() if workers is None else workers
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise SettingsError(f"`workers` must be a whole number of at least 1 (0: this process); got {number!r}.")
    if number == 0:
        yield Here()
        return
    pool = Processes(number)
    try:
        yield pool
    except BaseException:
        pool.close(kill=True)
        raise
    pool.close()


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
