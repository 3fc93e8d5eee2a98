"""An inclinometer of one's own: 3DM-GX5 packets over a serial port, for `[sensor] kind = "python"` of a drives file.

```toml
[sensor]
kind = "python"
python = "my_sensor:make"           # this file beside the drives file
options = { port = "/dev/ttyUSB0", baud = 115200 }
```

`read` and `take` are called from the control loop, every 10 ms, and must not wait: they take what is there. What
raises, waits or returns something else is named at the end of the run; the drives go to rest meanwhile.

Unverified with a real sensor. The packets follow the manufacturer's description of its IMU data set (MIP, descriptor
set 80h, field 0Ch): roll, pitch, yaw as three big-endian 32-bit floats [rad]. Turn its streaming on first.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from softneck.drives.master import Frame, Tilt

HEADER = b"\x75\x65"
EULER_SET, EULER_FIELD = 0x80, 0x0C


class Packets:
    """Makes samples of the bytes of MIP packets: header "ue", descriptor set, length, fields, checksum (Fletcher)."""

    def __init__(self) -> None:
        """Begin anywhere in the stream."""
        self._rest = b""

    def feed(self, data: bytes) -> Tilt | None:
        """Return the newest sample that ends in `data`, None if none does."""
        stream, newest = self._rest + data, None
        while True:
            begin = stream.find(HEADER)
            if begin < 0:
                self._rest = stream[-1:]
                return newest
            packet = stream[begin:]
            if len(packet) < 4 or len(packet) < packet[3] + 6:
                self._rest = packet
                return newest
            size = packet[3] + 6
            if checksum(packet[: size - 2]) != packet[size - 2 : size]:
                # "ue" was no header: look on behind it.
                stream = packet[2:]
                continue
            newest = _tilt(packet[2], packet[4 : size - 2]) or newest
            stream = packet[size:]


def checksum(content: bytes) -> bytes:
    """Return Fletcher's two bytes of `content`."""
    first = second = 0
    for byte in content:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes((first, second))


def _tilt(descriptor: int, fields: bytes) -> Tilt | None:
    """Return the angles among the fields of one packet; a field is its length, its kind, its content."""
    while descriptor == EULER_SET and len(fields) >= 2 and 2 <= fields[0] <= len(fields):
        if fields[1] == EULER_FIELD and fields[0] == 14:
            roll, pitch, _ = struct.unpack(">fff", fields[2:14])
            return Tilt(pitch, roll)
        fields = fields[fields[0] :]
    return None


class Gx5:
    """Reads the packets from a serial port."""

    def __init__(self, port: Any) -> None:
        """Read from the open `port`."""
        self._port, self._packets = port, Packets()

    def take(self, frames: Sequence[Frame]) -> None:
        """Frames of the CAN bus are of no interest; the port keeps what comes meanwhile."""

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        """Return the newest sample since the last call; time and frames are for sensors that need them."""
        del now, frames
        return self._packets.feed(self._port.read(4096))

    def close(self) -> None:
        """Give the port back."""
        self._port.close()


def make(options: Mapping[str, Any]) -> Gx5:
    """Open the port that the drives file names; called once, before anything moves."""
    import serial

    return Gx5(serial.Serial(options["port"], options.get("baud", 115200), timeout=0.0))
