"""Simulated drives on a bus of python-can, in real time, to test the whole path without hardware."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Callable
from typing import Any

from ._drives import SimulatedDrives
from ._node import CanFrame

_NO_MEASUREMENT = -(2**31)
_RESOLUTION = math.radians(0.001)
_SENSOR_NODE = 10


def serve(
    bus: Any,
    neck: SimulatedDrives,
    *,
    stopped: Callable[[], bool] | None = None,
    report: Callable[[float, SimulatedDrives, int], None] | None = None,
) -> None:
    """Answer frames on `bus` and advance the plant, until `stopped` returns True.

    Args:
        bus: an open bus of python-can.
        neck: drives and plant; of more than two outputs the first two are sent.
        stopped: called in each cycle.
        report: called with (monotonic time, neck, row) whenever the drive in that row changes its power state.
    """
    import can

    cycle, sample_time = neck.settings.cycle, neck.settings.sample_time
    begin = time.monotonic()
    moved = sampled = 0
    states = [-1] * len(neck.drives)

    def tell() -> None:
        for row, drive in enumerate(neck.drives):
            if drive.axis.state != states[row]:
                states[row] = drive.axis.state
                if report is not None:
                    report(time.monotonic(), neck, row)

    while stopped is None or not stopped():
        now = time.monotonic() - begin
        while moved * cycle <= now:
            neck.move()
            moved += 1
            if moved * cycle >= sampled * sample_time:
                sampled += 1
                slopes = _slopes(neck, now)
                _send(bus, [slopes] if neck.sensor != "silent" else [])
            _send(bus, neck.run((), moved * cycle))
            tell()
        rest = max(0.0, moved * cycle - (time.monotonic() - begin))
        try:
            message = bus.recv(rest)
        except (can.CanError, OSError):
            # A bus that is down returns at once: do not spin.
            time.sleep(min(rest, 1e-3))
            continue
        if message is not None and not message.is_error_frame and not message.is_extended_id:
            data = b"" if message.is_remote_frame else bytes(message.data)
            frame = CanFrame(message.arbitration_id, data, message.is_remote_frame)
            _send(bus, neck.run([frame], time.monotonic() - begin))
            tell()


def _slopes(neck: SimulatedDrives, now: float) -> CanFrame:
    """Return a TPDO of the inclinometer (CiA 410, 0.001 deg)."""
    sample = neck.sample(now)
    # An inclinometer has one axis or two.
    angles = sample.values[:2]
    values = [
        round(angle / _RESOLUTION) if sample.valid and not math.isnan(angle) else _NO_MEASUREMENT for angle in angles
    ]
    return CanFrame(0x180 + _SENSOR_NODE, struct.pack(f"<{len(values)}i", *values))


def _send(bus: Any, frames: list[CanFrame]) -> None:
    import can

    for frame in frames:
        # A bus that is down loses frames, which does not affect the drives.
        with contextlib.suppress(can.CanError, OSError):
            bus.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False))
