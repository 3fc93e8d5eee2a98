"""Somebody at the keyboard: Escape and space stop at once; Ctrl-C ramps to rest, and stops at once the second time."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from ._timing import Ask

_CTRL_C = b"\x03"
# The terminal is closed, a service is ended: as Ctrl-C. Ctrl-Z would hang the loop that feeds the drives: it stops.
_INTERRUPT_SIGNALS = ("SIGINT", "SIGHUP", "SIGBREAK")
_TERMINATE_SIGNALS = ("SIGTERM",)
_STOP_SIGNALS = ("SIGTSTP",)


class Keyboard:
    """Reads keys without waiting and takes signals, while it is entered; the terminal is as before afterwards.

    Keys are read only where stdin is a terminal and this process has it in the foreground; signals only in the main
    thread, and not where they were ignored before (`nohup`).
    `interrupted`: whether Ctrl-C or Ctrl-Z was pressed, or the terminal was closed. `terminated`: whether SIGTERM came.
    """

    def __init__(self) -> None:
        """Create the keyboard; it does not listen yet."""
        self.interrupted = self.terminated = False
        self._asks: list[Ask] = []
        self._read: Callable[[], bytes] = lambda: b""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Keyboard:
        """Take signals and the terminal."""
        with contextlib.ExitStack() as stack:
            self._take_signals(stack)
            self._take_terminal(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Give both back."""
        self._stack.close()

    def __call__(self) -> Ask | None:
        """Return the request since the last call; a stop precedes a ramp out."""
        for key in self._read():
            if bytes([key]) in (b"\x1b", b" "):
                self._asks.append(Ask.STOP)
            elif bytes([key]) == _CTRL_C:
                self._interrupt()
        if not self._asks:
            return None
        asks, self._asks = self._asks, []
        return Ask.STOP if Ask.STOP in asks else asks[0]

    def _interrupt(self) -> None:
        self._leave()
        self.interrupted = True

    def _leave(self) -> None:
        self._asks.append(Ask.STOP if self.interrupted or self.terminated else Ask.LEAVE)

    def _take_signals(self, stack: contextlib.ExitStack) -> None:
        if threading.current_thread() is not threading.main_thread():
            return

        def leave(number: int, _frame: FrameType | None) -> None:
            self._interrupt()
            if number == getattr(signal, "SIGHUP", None):
                _leave_dead_terminal()

        def end(_number: int, _frame: FrameType | None) -> None:
            self._leave()
            self.terminated = True

        def halt(_number: int, _frame: FrameType | None) -> None:
            self.interrupted = True
            self._asks.append(Ask.STOP)

        for names, handler in ((_INTERRUPT_SIGNALS, leave), (_TERMINATE_SIGNALS, end), (_STOP_SIGNALS, halt)):
            for name in names:
                number = getattr(signal, name, None)
                if number is None or signal.getsignal(number) is signal.SIG_IGN:
                    continue
                before = signal.signal(number, handler)
                stack.callback(signal.signal, number, before)

    def _take_terminal(self, stack: contextlib.ExitStack) -> None:
        if not sys.stdin or not sys.stdin.isatty():
            return
        if sys.platform == "win32":
            self._read = _windows_keys
            return
        import termios
        import tty

        file = sys.stdin.fileno()
        if not _in_front(file):
            return
        before = termios.tcgetattr(file)
        stack.callback(_restore, file, before)
        tty.setcbreak(file, termios.TCSANOW)
        self._read = lambda: _unix_keys(file)


def _in_front(file: int) -> bool:
    """Whether this process has the terminal: one in the background would be stopped by the kernel for reading it."""
    try:
        return os.tcgetpgrp(file) == os.getpgrp()
    except OSError:
        return False


def _unix_keys(file: int) -> bytes:
    import select

    try:
        if not select.select([file], [], [], 0.0)[0] or not _in_front(file):
            return b""
        return os.read(file, 64)
    except OSError:
        # The terminal is gone; SIGHUP says so too.
        return b""


def _leave_dead_terminal() -> None:
    """Discard further output if the terminal is closed: an error would lose the recording."""
    import termios

    for file in (1, 2):
        try:
            if os.isatty(file):
                continue
            termios.tcgetattr(file)
        except (OSError, termios.error) as error:
            if error.args[0] == errno.EIO:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, file)
                os.close(nowhere)


def _restore(file: int, before: Any) -> None:
    import termios

    # From the background the kernel would stop us for this.
    kept = signal.getsignal(signal.SIGTTOU)
    main = threading.current_thread() is threading.main_thread()
    if main:
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    try:
        with contextlib.suppress(termios.error, OSError):
            termios.tcsetattr(file, termios.TCSADRAIN, before)
    finally:
        if main:
            signal.signal(signal.SIGTTOU, kept)


def _windows_keys() -> bytes:
    import msvcrt

    keys = b""
    while msvcrt.kbhit():  # pyright: ignore[reportAttributeAccessIssue]
        keys += msvcrt.getch()  # pyright: ignore[reportAttributeAccessIssue]
    return keys
