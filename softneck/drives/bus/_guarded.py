"""A link on which the drives hear that we live while its owner waits for answers."""

from __future__ import annotations

from collections.abc import Sequence

from ..master import Frame
from ._link import Link


class GuardedLink:
    """Sends signs of life whenever somebody waits on it for longer than their period.

    It has no thread: an owner that hangs waits on nothing, and the drives notice.
    """

    def __init__(self, link: Link, signs: Sequence[Frame], period: float) -> None:
        """Send `signs` over `link` every `period` [s], beginning with the first wait."""
        self._link, self._signs, self._period = link, signs, period
        self._due = link.now

    @property
    def now(self) -> float:
        """Time [s] of the link."""
        return self._link.now

    @property
    def problem(self) -> str:
        """Why frames no longer pass, "" while they do."""
        return self._link.problem

    def send(self, frames: Sequence[Frame]) -> None:
        """Send `frames` now."""
        self._link.send(frames)

    def receive(self, timeout: float) -> list[Frame]:
        """Return what came, waiting for at most `timeout` [s] where nothing is there."""
        until = self.now + timeout
        while True:
            now = self.now
            if now >= self._due - 1e-9:
                self._link.send(self._signs)
                self._due = max(self._due, now) + self._period
            frames = self._link.receive(max(0.0, min(until, self._due) - now))
            if frames or self.now >= until:
                return frames
