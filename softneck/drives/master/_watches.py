"""Model against measurement: does the neck tilt as its motors turn, do motors follow, do tendons bear it, and pull."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ._events import Event
from ._settings import LimitSettings, WatchSettings

# Both watches speak after this time beyond their tolerance [s]; the fault table allows 200 ms, and what is told
# in one cycle acts in the same.
PATIENCE = 0.15


class Patience:
    """Says once that something lasted too long."""

    __slots__ = ("_limit", "_since")

    def __init__(self, limit: float = PATIENCE) -> None:
        """Wait `limit` [s]."""
        self._limit = limit
        self._since: float | None = None

    def over(self, now: float, beyond: bool) -> bool:
        """Return whether `beyond` has held for the limit."""
        if not beyond:
            self._since = None
            return False
        if self._since is None:
            self._since = now
        return now - self._since >= self._limit - 1e-9


class Leaky:
    """Adds up the time in which something holds and forgets it ten times as slowly."""

    __slots__ = ("_cycle", "_level", "_limit")

    def __init__(self, limit: float, cycle: float) -> None:
        """Be full at `limit` [s]; asked each `cycle` [s]."""
        self._limit, self._cycle, self._level = limit, cycle, 0.0

    def over(self, beyond: bool) -> bool:
        """Return whether it is full."""
        step = self._cycle if beyond else -0.1 * self._cycle
        self._level = max(0.0, self._level + step)
        return self._level >= self._limit - 1e-9


class Watches:
    """All of them, over one run.

    Attributes:
        pitch, roll: that the model gives [rad].
    """

    def __init__(self, settings: WatchSettings, limits: LimitSettings) -> None:
        """Begin with the neck upright."""
        self._settings, self._limits = settings, limits
        first, second, third = settings.tendon_angles
        self._rows = (
            (math.cos(first), math.cos(second), math.cos(third)),
            (math.sin(first), math.sin(second), math.sin(third)),
        )
        self.pitch = self.roll = 0.0
        self._offset = (0.0, 0.0)
        self._started = False
        self._tilted = Patience()
        self._behind = tuple(Patience() for _ in range(3))
        self._pulled = tuple(Patience() for _ in range(3))
        self._pushes = tuple(Patience() for _ in range(3))

    def align(self, pitch: float, roll: float, positions: Sequence[float]) -> None:
        """Take the angles before the motors move as those that belong to `positions`: a bias of sensor or link."""
        pitch_gain, roll_gain = self._static(positions)
        self.pitch, self.roll = pitch_gain, roll_gain
        self._offset = (pitch - pitch_gain, roll - roll_gain)
        self._started = True

    def motors(self, now: float, setpoints: Sequence[float], positions: Sequence[float], nodes: Sequence[int],
               tensions: Sequence[float], events: list[Event]) -> None:  # fmt: skip
        """Compare motors with their set-points, tendons with what they bear; each cycle while enabled."""
        for i in range(3):
            gap = abs(setpoints[i] - positions[i])
            if self._behind[i].over(now, gap > self._settings.following):
                events.append(Event(now, "following", nodes[i], f"{gap:.2f} rad behind"))
            if self._pulled[i].over(now, abs(tensions[i]) > self._limits.tension):
                events.append(Event(now, "tension", nodes[i], f"about {tensions[i]:.1f} N"))

    def signs(self, now: float, nodes: Sequence[int], tensions: Sequence[float], events: list[Event]) -> None:
        """Look whether tendons pull; each cycle of the ramp in, in which every motor tightens its own."""
        for i in range(3):
            if self._pushes[i].over(now, tensions[i] < -self._settings.pushed):
                text = f"motor {i + 1}, about {tensions[i]:.1f} N: is `reversed` of its drive right?"
                events.append(Event(now, "pushed", nodes[i], f"{text} See `softneck drives jog {i + 1}`"))

    def tilt(self, now: float, step: float, positions: Sequence[float], measured: tuple[float, float] | None,
             events: list[Event]) -> None:  # fmt: skip
        """Advance the model by `step` [s] and compare; each sample while enabled."""
        if not self._started:
            return
        pitch, roll = self._static(positions)
        share = 1.0 - math.exp(-self._settings.pole * step)
        self.pitch += share * (pitch - self.pitch)
        self.roll += share * (roll - self.roll)
        if measured is None:
            # What was not measured cannot diverge; the gate watches missing samples.
            return
        gap = max(abs(measured[0] - self._offset[0] - self.pitch), abs(measured[1] - self._offset[1] - self.roll))
        if self._tilted.over(now, gap > self._settings.tilt):
            events.append(Event(now, "diverged", 0, f"{math.degrees(gap):.0f} deg off"))

    def _static(self, P: Sequence[float]) -> tuple[float, float]:
        """Return the tilt that motors at `P` end at: Eq. 9, 10 for tendons in any direction, and the gain."""
        gain, (c, s) = self._settings.gain, self._rows
        return (
            gain * (c[0] * P[0] + c[1] * P[1] + c[2] * P[2]),
            gain * (s[0] * P[0] + s[1] * P[1] + s[2] * P[2]),
        )
