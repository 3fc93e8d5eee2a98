"""How long work reports itself: a callable that takes the part done and a word on it."""

from __future__ import annotations

from collections.abc import Callable

#: Called with the fraction done, 0 to 1, and a word on what is being done.
Progress = Callable[[float, str], None]


def silent(done: float, what: str) -> None:
    """Report nothing."""
    del done, what
