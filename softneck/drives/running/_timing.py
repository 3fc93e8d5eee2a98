"""What a process does so that its cycles come in time, and what it does when it is asked to end."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import threading
from collections.abc import Callable, Iterator
from enum import StrEnum

from softneck.core import SettingsError


class Ask(StrEnum):
    """What an operator wants of a run."""

    LEAVE = "leave"
    STOP = "stop"


Operator = Callable[[], Ask | None]


# Of 1 to 99: above ordinary work and below the kernel's own threads for interrupts, which have 50.
_PRIORITY = 40
# linux/mman.h: MCL_CURRENT, MCL_FUTURE.
_LOCK_ALL = 1 | 2


@contextlib.contextmanager
def steady(*, realtime: bool = False) -> Iterator[None]:
    """Keep the garbage collector out of a run; with `realtime` also other processes and paging.

    A run is bounded and its cycles leave next to no cyclic garbage (30 minutes: below 20 kB), so none is collected.

    Raises:
        SettingsError: real time is asked for and not permitted.
    """
    if realtime:
        _first_in_line()
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()
        if realtime:
            _in_line_again()


def _first_in_line() -> None:
    if not hasattr(os, "sched_setscheduler"):
        raise SettingsError("--realtime needs Linux.")
    advice = (
        "run as root, or allow it by `LimitRTPRIO=` and `LimitMEMLOCK=` of the service or /etc/security/limits.conf"
    )
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_LOCK_ALL) != 0:
        reason = os.strerror(ctypes.get_errno())
        raise SettingsError(f"--realtime: memory cannot be locked here ({reason}); {advice}. Nothing was sent.")
    try:
        # Children of this process are not to inherit it. Threads beside the loop (logs, view) come after it, but before
        # ordinary processes: one that is put aside while it has the interpreter's lock would hold the loop up.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
        for thread in _others():
            os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY - 1))
    except OSError as error:
        libc.munlockall()
        raise SettingsError(
            f"--realtime is not permitted here ({error.strerror}); {advice}. Nothing was sent."
        ) from error


def _others() -> list[int]:
    """Return the numbers of this process's other threads."""
    own = threading.get_native_id()
    return [thread.native_id for thread in threading.enumerate() if thread.native_id not in (None, own)]


def _in_line_again() -> None:
    # Without CAP_SYS_NICE the reset-on-fork mark stays, which then means nothing.
    for thread in (0, *_others()):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    ctypes.CDLL(None).munlockall()


class Ending:
    """Marks that SIGTERM came, for the loop to look at between two steps: to rest, and at once if it comes again."""

    def __init__(self) -> None:
        """Begin without."""
        self.asked = self._done = 0

    def ask(self) -> Ask | None:
        """Return what is to be done now, once for each signal."""
        if self._done == self.asked:
            return None
        self._done = self.asked
        return Ask.LEAVE if self.asked == 1 else Ask.STOP

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Take SIGTERM instead of ending at once; a signal reaches the main thread only."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def mark(*_: object) -> None:
            self.asked += 1

        before = signal.signal(signal.SIGTERM, mark)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before)
