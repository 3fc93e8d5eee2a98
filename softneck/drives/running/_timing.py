"""What a process does so that its cycles come in time, and what it tells a service manager (sd_notify(3))."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from types import TracebackType

from softneck.core import SettingsError

from ..master import Master


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


# A sign of life for each quarter of the manager's time-out: two may be lost.
_SHARE = 0.25


class Notifier:
    """Sends datagrams to `NOTIFY_SOCKET`; does nothing where there is none.

    A hung loop sends nothing: the manager then ends the process, and the drives have stopped by themselves long before.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        """Read `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID` of `environment`, by default the process' own."""
        values = os.environ if environment is None else environment
        address = values.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")) and hasattr(socket, "AF_UNIX"):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            # A leading @ is the abstract name space: a zero byte on the wire.
            self._address = "\0" + address[1:] if address[0] == "@" else address
        mine = values.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        text = values.get("WATCHDOG_USEC", "") if mine else ""
        self._every = _SHARE * int(text) * 1e-6 if text.isdigit() else 0.0
        self._fed_at: float | None = None
        self._phase = ""

    def __enter__(self) -> Notifier:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Say that it stops."""
        self.tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """Say that the pre-flight holds and the loop begins."""
        self.tell("READY=1")

    def cycle(self, now: float, master: Master) -> None:
        """Give a sign of life when it is due, and tell a new phase; to be called by the loop after each step."""
        phase = str(master.supervisor.phase)
        if phase != self._phase:
            self._phase = phase
            self.tell(f"STATUS={phase}")
        if self._every and (self._fed_at is None or now - self._fed_at >= self._every):
            self._fed_at = now
            self.tell("WATCHDOG=1")

    def tell(self, text: str) -> None:
        """Send one line; a manager that does not listen is no reason to stop."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode("utf-8"), self._address)
