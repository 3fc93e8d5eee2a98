"""Monitoring of model against measurement: tilt, following error of the motors, and tension of the tendons."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..supervision._baseline import Baseline
from ..supervision._plausibility import Plausibility
from ._events import Event
from ._fieldbus import BusSettings
from ._gate import Reading
from ._settings import LimitSettings, WatchSettings

# Time beyond a tolerance before an event [s]; the fault table allows 200 ms, and an event acts in the same cycle.
PATIENCE = 0.15


class Patience:
    """Timer that reports a condition lasting for too long."""

    __slots__ = ("_limit", "_since")

    def __init__(self, limit: float = PATIENCE) -> None:
        """Set the time limit [s]."""
        self._limit = limit
        self._since: float | None = None

    def over(self, now: float, beyond: bool) -> bool:
        """Return whether `beyond` has been true for the time limit."""
        if not beyond:
            self._since = None
            return False
        if self._since is None:
            self._since = now
        return now - self._since >= self._limit - 1e-9


class Leaky:
    """Integrator of the time in which a condition holds, which leaks at a tenth of that rate."""

    __slots__ = ("_cycle", "_level", "_limit")

    def __init__(self, limit: float, cycle: float) -> None:
        """Set the limit [s]; `over` is called every `cycle` [s]."""
        self._limit, self._cycle, self._level = limit, cycle, 0.0

    def over(self, beyond: bool) -> bool:
        """Return whether the accumulated time has reached the limit."""
        step = self._cycle if beyond else -0.1 * self._cycle
        self._level = max(0.0, self._level + step)
        return self._level >= self._limit - 1e-9


def timing(now: float, before: float | None, bus: BusSettings) -> list[Event]:
    """Return the events for a wrong time between two steps [s]."""
    if before is None:
        return []
    gap = (now - before) / bus.cycle
    if not gap > 0.0:
        return [Event(now, "clock", 0, f"{before:.6f} s, then {now:.6f} s")]
    if gap >= bus.stalled_cycles:
        return [Event(now, "stalled", 0, f"{gap * bus.cycle * 1e3:.0f} ms")]
    return [Event(now, "late_cycle")] if gap > 1.5 else []


class Watches:
    """All monitors over one run.

    Attributes:
        angles: of the model [rad].
        led: motor positions that fit the last measured angles, without co-contraction [rad].
    """

    def __init__(
        self,
        settings: WatchSettings,
        limits: LimitSettings,
        weights: Sequence[Sequence[float]] | None = None,
        motors: int = 3,
        baseline: Baseline | None = None,
    ) -> None:
        """Start upright; `weights` (outputs, motors) are the directions, () if not identified, None for the neck's."""
        self._plausible = None if baseline is None else Plausibility(baseline)
        self._settings, self._limits = settings, limits
        self._rows = settings.weights if weights is None else weights
        self.angles = [0.0] * len(self._rows)
        self.led: tuple[float, ...] = (0.0,) * motors
        # The smallest motor motion for the angles (pseudo-inverse); None if directions are still to be identified.
        self._back = np.linalg.pinv(settings.gain * np.array(self._rows)).tolist() if self._rows else None
        self._offset = self.angles
        self._started = False
        self._tilted = Patience()
        self._behind = tuple(Patience() for _ in range(motors))
        self._pulled = tuple(Patience() for _ in range(motors))
        self._pushes = tuple(Patience() for _ in range(motors))

    def align(self, measured: Sequence[float], positions: Sequence[float]) -> None:
        """Take the offset between angles and model before the motors move as a bias of sensor or link."""
        if self._plausible is not None:
            self._plausible.begin()
        if not self._rows:
            return
        self.angles = self._static(positions)
        self._offset = [there - here for there, here in zip(measured, self.angles, strict=True)]
        self._started = True

    def motors(self, now: float, setpoints: Sequence[float], positions: Sequence[float], nodes: Sequence[int],
               tensions: Sequence[float], events: list[Event]) -> None:  # fmt: skip
        """Check following errors and tensions; each cycle while enabled."""
        for i in range(len(nodes)):
            gap = abs(setpoints[i] - positions[i])
            if self._behind[i].over(now, gap > self._settings.following):
                events.append(Event(now, "following", nodes[i], f"{gap:.2f} rad behind"))
            if self._pulled[i].over(now, abs(tensions[i]) > self._limits.tension):
                events.append(Event(now, "tension", nodes[i], f"about {tensions[i]:.1f} N"))

    def signs(self, now: float, nodes: Sequence[int], tensions: Sequence[float], events: list[Event]) -> None:
        """Check that tendons pull; each cycle of the ramp in, during which every motor tightens its tendon."""
        for i in range(len(nodes)):
            if self._pushes[i].over(now, tensions[i] < -self._settings.pushed):
                text = f"motor {i + 1}, about {tensions[i]:.1f} N: is `reversed` of its drive right?"
                events.append(
                    Event(
                        now, "pushed", nodes[i], f"{text} See `softneck drives commission --only jog --motor {i + 1}`"
                    )
                )

    def tilt(self, now: float, step: float, positions: Sequence[float], measured: Sequence[float] | None,
             events: list[Event]) -> None:  # fmt: skip
        """Advance the model by `step` [s] and compare; each sample while enabled."""
        if measured is not None and self._back is not None:
            self.led = tuple([_product(row, measured) for row in self._back])
        if not self._started:
            return
        share = 1.0 - math.exp(-self._settings.pole * step)
        ends = self._static(positions)
        self.angles = [angle + share * (end - angle) for angle, end in zip(self.angles, ends, strict=True)]
        if measured is None:
            # Missing samples are monitored by the gate.
            return
        gap = max(
            abs(there - offset - here) for there, offset, here in zip(measured, self._offset, self.angles, strict=True)
        )
        if self._tilted.over(now, gap > self._settings.tilt):
            events.append(Event(now, "diverged", 0, f"{math.degrees(gap):.0f} deg off"))

    def plausible(self, now: float, nodes: Sequence[int], setpoints: Sequence[float], positions: Sequence[float],
                  tensions: Sequence[float], events: list[Event], *, due: bool,
                  sample: Reading | None, reference: Sequence[float]) -> None:  # fmt: skip
        """Run the plausibility charts; each cycle while enabled, with the sample if one is due."""
        if self._plausible is None:
            return
        found = self._plausible.cycle(setpoints, positions, tensions)
        if due and found is None:
            values, rates = (None, ()) if sample is None else (sample.values, sample.rates)
            found = self._plausible.sample(positions, values, rates, reference)
            if self._plausible.rests:
                events.append(Event(now, "not_watched", 0, self._plausible.rests))
        if found is not None:
            events.append(Event(now, found.name, 0 if found.motor < 0 else nodes[found.motor], found.detail))

    def _static(self, P: Sequence[float]) -> list[float]:
        """Return the static tilt for motors at `P`: Eq. 9, 10 for tendons in any direction, and the gain."""
        return [self._settings.gain * _product(row, P) for row in self._rows]


def _product(row: Sequence[float], x: Sequence[float]) -> float:
    # Not `sum`, which rounds in another way from Python 3.12 on.
    total = 0.0
    for weight, value in zip(row, x, strict=True):
        total += weight * value
    return total
