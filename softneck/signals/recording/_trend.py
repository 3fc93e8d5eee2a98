"""Straight lines through the channels of each run: taken out, stored, and put back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, FileFormatError, Vector
from softneck.core._shown import Shown

from ._recording import Recording


@dataclass(frozen=True, slots=True, repr=False)
class Trend(Shown):
    """`x - (level + slope (t - origin))` for each run, t in [s].

    Attributes:
        origin: (runs,) first time of each run [s].
        level: channel -> (runs,) value of the line at the origin, in the channel's SI unit.
        slope: channel -> (runs,) its rise, in that unit per second.
    """

    origin: tuple[float, ...]
    level: Mapping[str, tuple[float, ...]]
    slope: Mapping[str, tuple[float, ...]]

    def __post_init__(self) -> None:
        numbers = [*self.origin]
        for lines in (*self.level.values(), *self.slope.values()):
            numbers.extend(lines)
            if len(lines) != len(self.origin):
                raise DataError(f"a trend needs one line for each of its {len(self.origin)} runs; got {len(lines)}.")
        if not self.origin or set(self.level) != set(self.slope) or not all(map(math.isfinite, numbers)):
            raise DataError("a trend needs finite levels and slopes of the same channels, for one run at least.")

    @classmethod
    def of(cls, recording: Recording, channels: Sequence[str] | None = None) -> Trend:
        """Return the least-squares lines of `channels` (None: the outputs); missed samples count for nothing.

        Raises:
            DataError: the recording has no such channel.
        """
        channels = recording.robot.outputs.names if channels is None else channels
        absent = [name for name in channels if name not in recording.channels]
        if absent:
            raise DataError(f"the recording has no channel `{absent[0]}` to take a trend from.")
        runs = recording.runs()
        lines = {name: [_line(run.time - run.time[0], run.channels[name]) for run in runs] for name in channels}
        return cls(
            tuple(float(run.time[0]) for run in runs),
            {name: tuple(level for level, _ in found) for name, found in lines.items()},
            {name: tuple(slope for _, slope in found) for name, found in lines.items()},
        )

    def apply(self, recording: Recording) -> Recording:
        """Return the recording without its trend; a part of each run will do, as times tell where it lies."""
        return self._moved(recording, -1.0)

    def invert(self, recording: Recording) -> Recording:
        """Return the recording with its trend put back."""
        return self._moved(recording, 1.0)

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON header holds."""
        return {
            "origin": list(self.origin),
            "level": {name: list(lines) for name, lines in self.level.items()},
            "slope": {name: list(lines) for name, lines in self.slope.items()},
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Trend:
        """Return the trend that `as_dict` wrote; raise FileFormatError for anything else."""
        try:
            level, slope = (
                {str(name): tuple(map(float, lines)) for name, lines in content[what].items()}
                for what in ("level", "slope")
            )
            return cls(tuple(map(float, content["origin"])), level, slope)
        except (KeyError, TypeError, ValueError, AttributeError, DataError) as error:
            raise FileFormatError(f"holds no trend ({error}).") from error

    def _moved(self, recording: Recording, sign: float) -> Recording:
        runs = recording.runs()
        if len(runs) != len(self.origin):
            raise DataError(f"the trend is one of {len(self.origin)} run(s); this recording has {len(runs)}.")
        absent = [name for name in self.level if name not in recording.channels]
        if absent:
            raise DataError(f"the trend has a line for `{absent[0]}`, which this recording does not have.")
        since = np.concatenate([run.time - origin for run, origin in zip(runs, self.origin, strict=True)])
        number = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        moved = {
            name: recording.channels[name]
            + sign * (np.array(self.level[name])[number] + np.array(self.slope[name])[number] * since)
            for name in self.level
        }
        return recording.with_channels(**moved)


def _line(t: Vector, x: Vector) -> tuple[float, float]:
    """Return level at t = 0 and slope of the least-squares line through x (time,)."""
    seen = np.isfinite(x)
    if not seen.any():
        return 0.0, 0.0
    middle, mean = float(t[seen].mean()), float(x[seen].mean())
    spread = t[seen] - middle
    power = float(spread @ spread)
    slope = float(spread @ (x[seen] - mean)) / power if power > 0 else 0.0
    return mean - slope * middle, slope
