"""Processes like those of `subprocess`, forked from one that has imported all: where imports take minutes."""

from __future__ import annotations

import multiprocessing
import os
import runpy
import subprocess
import sys
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO

IMPORTED = ["softneck.cli", "softneck.drives", "softneck.cosim", "can.interfaces.socketcan", "warmed"]


def _run(words: tuple[str, ...], environment: dict[str, str], out: Connection, error: Connection) -> None:
    """Be `python WORDS`, with -m or with the command line's -c."""
    os.environ.clear()
    os.environ.update(environment)
    os.dup2(out.fileno(), 1)
    os.dup2(error.fileno(), 2)
    if words[0] == "-m":
        sys.argv = list(words[1:])
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        return
    from softneck.cli import main

    sys.argv = ["softneck", *words[2:]]
    main()


def imports_in(project: Path) -> None:
    """Let the process that all are forked from play a run of `project` first: what is compiled is loaded then."""
    os.environ["SOFTNECK_WARM"] = str(project)
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])


class Forked:
    """What `subprocess.Popen(..., stdout=PIPE, stderr=PIPE)` offers, as far as `processes.py` uses it."""

    def __init__(self, words: tuple[str, ...]) -> None:
        """Start `python WORDS`."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(IMPORTED)
        pairs = [context.Pipe(duplex=False) for _ in range(2)]
        given = (words, dict(os.environ), pairs[0][1], pairs[1][1])
        self.process = context.Process(target=_run, args=given, daemon=True)
        self.process.start()
        for _, writer in pairs:
            writer.close()
        self.stdout: IO[bytes] = os.fdopen(os.dup(pairs[0][0].fileno()), "rb")
        self.stderr: IO[bytes] = os.fdopen(os.dup(pairs[1][0].fileno()), "rb")
        self._error: list[bytes] = []
        # Nobody else reads it, and a full pipe would hold the process up.
        threading.Thread(target=lambda: self._error.extend(self.stderr), daemon=True).start()

    @property
    def returncode(self) -> int | None:
        """Exit code, negative for a signal; None while it runs."""
        return self.process.exitcode

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        return self.process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end and return the exit code."""
        self.process.join(timeout)
        if self.process.exitcode is None:
            raise subprocess.TimeoutExpired("forked process", timeout or 0.0)
        return self.process.exitcode

    def communicate(self, timeout: float | None = None) -> tuple[bytes, bytes]:
        """Wait for the end and return what it printed, which must fit a pipe."""
        self.wait(timeout)
        return self.stdout.read(), b"".join(self._error)

    @property
    def pid(self) -> int:
        """Its number among the machine's processes."""
        return self.process.pid or 0

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()

    def terminate(self) -> None:
        """Ask it to end."""
        self.process.terminate()
