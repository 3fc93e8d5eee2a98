"""One BLAS thread while a fit, a search or a verification runs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class _Limit:
    """BLAS's number of threads, which is one for the whole process: fits may run in several threads of Python."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running = 0
        self._limits: Any = None

    def __enter__(self) -> None:
        """Limit BLAS to one thread, where no other call has done so."""
        # Only libraries that are loaded can be limited: NumPy and SciPy bring one each.
        import numpy  # noqa: F401
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_limits

        with self._lock:
            if not self._running:
                _release_control()
                self._limits = threadpool_limits(limits=1, user_api="blas")
            self._running += 1

    def __exit__(self, *_: object) -> None:
        """Restore the number of threads when the last call ends; the first to end would restore it for all."""
        with self._lock:
            self._running -= 1
            if not self._running:
                _release_control()
                self._limits.restore_original_limits()
                _release_control()


def _release_control() -> None:
    """Let whichever thread comes next set the number: from 3.8 on, threadpoolctl ignores all but the first silently."""
    from threadpoolctl import OpenBLASController

    clear = getattr(OpenBLASController, "clear_controlling_thread", None)
    if clear is not None:
        clear(force=True)


_LIMIT = _Limit()


def one_blas_thread(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Run `function` with one BLAS thread.

    Products of our matrices end before a second thread has woken up. Where the processors are busy, each
    product waits for it, many times as long as it takes by itself (issue 48 has numbers).
    """

    @wraps(function)
    def limited(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with _LIMIT:
            return function(*args, **kwargs)

    return limited
