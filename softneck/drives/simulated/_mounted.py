"""A sensor that is mounted otherwise than somebody believes, or late: around whatever the simulated drives turn."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from softneck.core import SettingsError

from ._drives import OutputSample, TiltSample, sample_at
from ._neck import SimulatedNeck
from ._springs import SimulatedSprings


class MountedOtherwise:
    """A neck, or springs, whose sensor has other axes and signs, and tells what was `late` [s] before.

    All else is that of what it stands around.
    """

    def __init__(
        self, neck: SimulatedNeck | SimulatedSprings, axes: Sequence[tuple[int, float]], *, late: float = 0.0
    ) -> None:
        """Let output k of the sensor be `sign` times the true output `number`: (number, sign) is `axes[k]`."""
        count = len(neck.newest.values)
        if sorted(number for number, _ in axes) != list(range(count)):
            raise SettingsError(f"`axes` must name each of the {count} outputs once.")
        self._neck, self._axes = neck, tuple(axes)
        samples = round(late / neck.settings.sample_time)
        self._past: deque[TiltSample | OutputSample] = deque([neck.newest] * (samples + 1), samples + 1)
        self.newest: TiltSample | OutputSample = self._turned(neck.newest)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._neck, name)

    def sample(self, now: float) -> TiltSample | OutputSample:
        """Take one sample, and tell the one that is due."""
        self._past.append(self._neck.sample(now))
        self.newest = self._turned(self._past[0]._replace(time=now))
        return self.newest

    def _turned(self, sample: TiltSample | OutputSample) -> TiltSample | OutputSample:
        values, rates = (
            tuple(sign * given[number] for number, sign in self._axes) for given in (sample.values, sample.rates)
        )
        return sample_at(sample.time, values, rates, valid=sample.valid)
