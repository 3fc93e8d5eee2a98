"""What an inclinometer is, and one on the CAN bus: slopes in a TPDO of its own, as CiA 410 devices send them."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Protocol

from softneck.core import SettingsError

from ..bus._link import Link
from ..master import Frame
from ..master._gate import Reading, sample_of

# 6110h and 6120h, slope of one axis or both in 32 bits, at a resolution of 0.001 deg (6000h = 1; CiA 410, 6.1).
_SLOPES = {1: struct.Struct("<i"), 2: struct.Struct("<ii")}
_RESOLUTION = math.radians(0.001)
# What the sensor sends where it has nothing: the most negative number.
_NOTHING = -(2**31)
# Within this time any inclinometer that sends has sent [s]: 10 samples at 20 Hz.
LOOK = 0.5
_PIECE = 0.02


class Sensor(Protocol):
    """What measures the outputs; one that can say why it ended has an attribute `problem` as well."""

    def take(self, frames: Sequence[Frame]) -> None:
        """Look at frames of a cycle in which no sample is due; a sensor that is not on the bus ignores them."""
        ...

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample, None if none came since the last call."""
        ...


def look_at(sensor: Sensor, link: Link, timeout: float) -> Reading | None:
    """Return the first sample of `sensor` that comes within `timeout` [s], None if none does."""
    until = link.now + timeout
    while link.now < until:
        tilt = sensor.read(link.now, link.receive(_PIECE))
        if tilt is not None:
            return tilt
    return None


class CanInclinometer:
    """Reads the slopes that node `node` sends in its first TPDO."""

    def __init__(self, node: int, axes: int = 2) -> None:
        """Listen for the identifier 180h + node.

        Raises:
            SettingsError: neither one axis nor two.
        """
        if axes not in _SLOPES:
            raise SettingsError(
                f'[sensor] kind = "can" has one axis or two; the robot has {axes} outputs. Write kind = "python".'
            )
        self._identifier, self._slopes = 0x180 + node, _SLOPES[axes]
        self._newest: Reading | None = None

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample among `frames`, and those since the last call; None if none came."""
        del now
        self.take(frames)
        newest, self._newest = self._newest, None
        return newest

    def take(self, frames: Sequence[Frame]) -> None:
        """Look at frames of a cycle in which no sample is due."""
        for frame in frames:
            if frame.identifier != self._identifier or frame.remote or frame.error:
                continue
            if len(frame.data) == self._slopes.size:
                slopes = self._slopes.unpack(frame.data)
                self._newest = sample_of([slope * _RESOLUTION for slope in slopes], valid=_NOTHING not in slopes)
