"""Simulated drives on a bus of python-can, in real time: for tries of the whole path without hardware."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Callable
from typing import Any

from ._frame import CanFrame
from ._neck import SimulatedNeck

_SLOPES = struct.Struct("<ii")
_NOTHING = -(2**31)
_RESOLUTION = math.radians(0.001)


def serve(bus: Any, neck: SimulatedNeck, *, sensor_node: int = 10, stopped: Callable[[], bool] | None = None) -> None:
    """Answer frames on `bus` and let the neck move, until `stopped` returns True.

    The inclinometer sends its slopes as node `sensor_node` in a TPDO of its own (CiA 410, 0.001 deg).
    """
    import can

    cycle, sample_time = neck.settings.cycle, neck.settings.sample_time
    begin = time.monotonic()
    moved = sampled = 0
    while stopped is None or not stopped():
        now = time.monotonic() - begin
        while moved * cycle <= now:
            neck.move()
            moved += 1
            if moved * cycle >= sampled * sample_time:
                sampled += 1
                _send(bus, [_slopes(neck, now, sensor_node)])
            _send(bus, neck.run((), moved * cycle))
        rest = max(0.0, moved * cycle - (time.monotonic() - begin))
        try:
            message = bus.recv(rest)
        except (can.CanError, OSError):
            continue
        if message is not None and not message.is_error_frame and not message.is_extended_id:
            data = b"" if message.is_remote_frame else bytes(message.data)
            frame = CanFrame(message.arbitration_id, data, message.is_remote_frame)
            _send(bus, neck.run([frame], time.monotonic() - begin))


def _slopes(neck: SimulatedNeck, now: float, node: int) -> CanFrame:
    sample = neck.sample(now)
    pair = (sample.pitch, sample.roll) if sample.valid else (math.nan, math.nan)
    values = [_NOTHING if math.isnan(value) else round(value / _RESOLUTION) for value in pair]
    return CanFrame(0x180 + node, _SLOPES.pack(*values))


def _send(bus: Any, frames: list[CanFrame]) -> None:
    import can

    for frame in frames:
        # A bus that is down loses frames; drives do not care.
        with contextlib.suppress(can.CanError, OSError):
            bus.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False))
