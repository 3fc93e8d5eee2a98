"""One BLAS thread while a fit, a search or a verification runs, and functions side by side on the free cores."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class _Limit:
    """The number of BLAS threads. It holds for the whole process, and fits may run in several Python threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running = 0
        self._limits: Any = None

    def __enter__(self) -> None:
        """Limit BLAS to one thread, unless another call has already done so."""
        # Only libraries that are loaded can be with_one_thread: NumPy and SciPy bring one each.
        import numpy  # noqa: F401
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_limits

        with self._lock:
            if not self._running:
                _release_control()
                self._limits = threadpool_limits(limits=1, user_api="blas")
            self._running += 1

    def __exit__(self, *_: object) -> None:
        """Restore the number of threads when the last call ends; restoring it earlier would restore it for all."""
        with self._lock:
            self._running -= 1
            if not self._running:
                _release_control()
                self._limits.restore_original_limits()
                _release_control()


def _release_control() -> None:
    """Let the next thread set the number: from 3.8 on, threadpoolctl silently ignores all threads but the first."""
    from threadpoolctl import OpenBLASController

    clear = getattr(OpenBLASController, "clear_controlling_thread", None)
    if clear is not None:
        clear(force=True)


_LIMIT = _Limit()


def one_blas_thread(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Run `function` with one BLAS thread.

    Products of matrices as small as ours finish before a second thread has started. On a busy machine each product
    waits for that thread, many times as long as the product itself takes (issue 48 has numbers).
    """

    @wraps(function)
    def with_one_thread(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with _LIMIT:
            return function(*args, **kwargs)

    return with_one_thread


def core_count() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# Cores beside that of the caller: calls within calls share them, so that threads never outnumber cores.
_FREE_CORES = threading.Semaphore(core_count() - 1)


def take_cores(count: int) -> int:
    """Take up to `count` free cores from `side_by_side`; return how many."""
    return sum(_FREE_CORES.acquire(blocking=False) for _ in range(count))


@contextmanager
def cores_taken(count: int) -> Iterator[None]:
    """Take up to `count` free cores from `side_by_side` while other processes work on them."""
    taken = take_cores(count)
    try:
        yield
    finally:
        for _ in range(taken):
            _FREE_CORES.release()


def take_core_until(ended: Callable[[], object]) -> None:
    """Take a free core from `side_by_side`, if there is one, until `ended`, which waits for a process, returns."""

    def wait_for_it() -> None:
        ended()
        _FREE_CORES.release()

    if take_cores(1):
        threading.Thread(target=wait_for_it, daemon=True).start()


def side_by_side(calls: Sequence[Callable[[], _Result]]) -> list[_Result]:
    """Return the results of `calls`, which begin in their order, in this thread and in one more for each free core.

    It pays where they are compiled or in BLAS most of the time, which let go of Python's lock. The first error ends it.
    """
    found: dict[int, _Result] = {}
    left = iter(enumerate(calls))

    def work() -> None:
        for number, call in left:
            try:
                found[number] = call()
            except BaseException:
                list(left)  # nobody begins another
                raise

    def help_out() -> None:
        try:
            work()
        finally:
            _FREE_CORES.release()

    more = 0
    while more < len(calls) - 1 and _FREE_CORES.acquire(blocking=False):
        more += 1
    if not more:
        return [call() for call in calls]
    with ThreadPoolExecutor(more) as pool:
        helpers = [pool.submit(help_out) for _ in range(more)]
        work()
        _FREE_CORES.release()  # while this thread waits, a helper's calls may use its core
        try:
            wait(helpers)
        finally:
            _FREE_CORES.acquire()
    for helper in helpers:
        helper.result()
    return [found[number] for number in range(len(calls))]
