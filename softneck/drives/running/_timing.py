"""Real-time settings of the process, and messages to a service manager (sd_notify(3))."""

from __future__ import annotations

import contextlib
import gc
import os
import socket
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from types import TracebackType

from ..master import Master


class Ask(StrEnum):
    """Requests of an operator during a run."""

    LEAVE = "leave"
    STOP = "stop"


Operator = Callable[[], Ask | None]


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Keep the garbage collector out of a run.

    A run is bounded and its cycles leave next to no cyclic garbage (30 minutes: below 20 kB), so none is collected.
    """
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


# A sign of life for each quarter of the manager's time-out: two may be lost.
_WATCHDOG_SHARE = 0.25


class Notifier:
    """Sends datagrams to `NOTIFY_SOCKET`, if there is one.

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
        self._every = _WATCHDOG_SHARE * int(text) * 1e-6 if text.isdigit() else 0.0
        self._fed_at: float | None = None
        self._phase = ""

    def __enter__(self) -> Notifier:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Notify that the service stops."""
        self.tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ready(self) -> None:
        """Notify that the pre-flight holds and the loop begins."""
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
