"""The end of a command that moved drives: recording, result and exit code, which no signal interrupts."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import click
import platformdirs

from softneck import drives
from softneck.core import OutputFileError

from ..shared._console import note

_T = TypeVar("_T")
# Exit code of a process that SIGTERM ended: 128 + 15.
_SIGTERM_EXIT = 143
# Descriptors held during a run and released at its end: a process that has used up all its own can still write.
_SPARE_DESCRIPTORS = 8


def log_folder() -> Path:
    """Return the folder of automatic logs: systemd's LogsDirectory=, otherwise the user's own."""
    given = os.environ.get("LOGS_DIRECTORY", "").partition(":")[0]
    return Path(given) if given else platformdirs.user_log_path("softneck", appauthor=False)


def new_path(command: str, suffix: str) -> Path:
    """Return a path in `log_folder` that is free; names sort by time."""
    stem = f"{command}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    folder, number = log_folder(), 1
    path = folder / f"{stem}{suffix}"
    while path.exists() or drives.partial(path).exists():
        number += 1
        path = folder / f"{stem}_{number}{suffix}"
    return path


class Closing:
    """Writes the recording, and ends the command by what happened.

    `keyboard`: which takes keys and signals until the command has ended. `problem`: why a file is not where it was
    wanted; "" if it is.
    """

    def __init__(self, keyboard: drives.Keyboard, command: str, log: drives.RunLogger | None) -> None:
        """Hold some descriptors; `command` and `log` are named where a recording cannot be written."""
        self.keyboard, self.problem = keyboard, ""
        self._command, self._log = command, log
        self._spare = [os.open(os.devnull, os.O_RDONLY) for _ in range(_SPARE_DESCRIPTORS)]

    def release(self) -> None:
        """Give the held descriptors back."""
        while self._spare:
            os.close(self._spare.pop())

    def attempt(self, write: Callable[[], _T]) -> _T | None:
        """Return `write()`; where a file cannot be written, None, and its error ends the command later."""
        self.release()
        try:
            return write()
        except OSError as error:
            self.problem = str(error)
            return None

    def write(self, path: Path, write: Callable[[Path], None]) -> Path | None:
        """Call `write(path)`, or where that fails write into `log_folder`; return the path, None if both fail."""

        def to(where: Path) -> Path:
            write(where)
            return where

        written = self.attempt(lambda: to(path))
        if written is not None:
            return written
        problem, other = self.problem.rstrip("."), new_path(self._command, path.suffix)
        if self.attempt(lambda: to(other)) is not None:
            self.problem = f"{problem}. The recording is {other}."
            return other
        log = "" if self._log is None else f" The log has the data: softneck import {self._log.path} -o {path.name}"
        self.problem = f"{problem}; nor can {other}.{log}"
        return None

    def conclude(self, fault: Any, require: Callable[[], None]) -> None:
        """End the command when its results are printed: by a fault, by Ctrl-C or SIGTERM, by what was not written.

        `fault`: what stopped the drives. `require`: raises where something did not hold.
        """
        if self.problem:
            note(self.problem)
        if fault is not None and fault.name != "operator":
            require()
        self.leave_if_asked()
        require()
        if self.problem:
            raise OutputFileError(self.problem)

    def leave_if_asked(self) -> None:
        """End the command after Ctrl-C or SIGTERM."""
        if self.keyboard.interrupted:
            raise KeyboardInterrupt
        if self.keyboard.terminated:
            note("ended by SIGTERM; the drives are off.")
            click.get_current_context().exit(_SIGTERM_EXIT)


@contextlib.contextmanager
def closing(last: contextlib.ExitStack, command: str, log: drives.RunLogger | None) -> Iterator[Closing]:
    """Yield the end of `command`; from here on signals only set a mark, until `last` is closed."""
    made = Closing(last.enter_context(drives.Keyboard()), command, log)
    try:
        yield made
    finally:
        made.release()
