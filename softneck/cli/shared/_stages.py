"""Long commands in stages: one progress bar after the other, and a line on stderr with the time of each."""

from __future__ import annotations

import time
from contextlib import ExitStack

from softneck.core import Progress

from ._console import note, progress


class Stages:
    """Announces stages; each ends when the next begins."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._stack = ExitStack()
        self._name = ""
        self._since = 0.0

    def __enter__(self) -> Stages:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def begin(self, name: str) -> Progress:
        """End the stage before and start the next."""
        self._end()
        self._name, self._since = name, time.monotonic()
        return self._stack.enter_context(progress(name, quiet=self._quiet))

    def _end(self) -> None:
        self._stack.close()
        if self._name and not self._quiet:
            note(f"{self._name}: {time.monotonic() - self._since:.1f} s")
        self._name = ""
