"""Time on a bus: what its cycles took, and what a process can do so that they come in time."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import threading
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import SettingsError

# Of 1 to 99: above ordinary work and below the kernel's own threads for interrupts, which have 50.
_PRIORITY = 40
# linux/mman.h: MCL_CURRENT, MCL_FUTURE.
_LOCK_ALL = 1 | 2


@dataclass(frozen=True, slots=True)
class CycleTimes:
    """Times between the beginnings of two steps of the master.

    Attributes:
        period: as set [s].
        count: number of cycles.
        median, p99, longest: [s].
        late: cycles longer than 1.5 periods.
        missed: periods in which no step began: a cycle of n periods misses n - 1.
    """

    period: float
    count: int
    median: float
    p99: float
    longest: float
    late: int
    missed: int

    @property
    def missed_share(self) -> float:
        """Missed periods over all periods."""
        return self.missed / max(1, self.count + self.missed)

    def table(self) -> dict[str, Any]:
        """Return the JSON of it."""
        return {
            "period_s": self.period, "count": self.count, "median_s": self.median, "p99_s": self.p99,
            "longest_s": self.longest, "late": self.late, "missed": self.missed, "missed_share": self.missed_share,
        }  # fmt: skip


class CycleClock:
    """Collects when steps began."""

    def __init__(self, period: float) -> None:
        """Begin with none."""
        self._period, self._begins = period, array("d")

    def took(self, now: float) -> None:
        """Take the beginning of a step."""
        self._begins.append(now)

    def result(self) -> CycleTimes | None:
        """Return what was seen; None of fewer than two steps."""
        if len(self._begins) < 2:
            return None
        gaps = np.diff(np.array(self._begins))
        median, p99 = np.percentile(gaps, [50.0, 99.0])
        missed = np.maximum(np.round(gaps / self._period) - 1.0, 0.0).sum()
        late = int((gaps > 1.5 * self._period).sum())
        return CycleTimes(
            self._period, len(gaps), float(median), float(p99), float(gaps.max()), late, int(missed)
        )  # fmt: skip


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
        # Children of this process are not to inherit it.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except OSError as error:
        libc.munlockall()
        raise SettingsError(
            f"--realtime is not permitted here ({error.strerror}); {advice}. Nothing was sent."
        ) from error


def _in_line_again() -> None:
    # Without CAP_SYS_NICE the reset-on-fork mark stays, which then means nothing.
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    ctypes.CDLL(None).munlockall()


@contextlib.contextmanager
def on_termination(act: Callable[[], None]) -> Iterator[None]:
    """Let SIGTERM call `act` instead of ending the process at once; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: act())
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
