"""The lab's inclinometer on a serial port: an Arduino that sends a line `i12.34,o120.00` for each sample.

i is the inclination, o the orientation of the tilt vector, both in degrees with two decimals, as `Serial.print` writes
a float. One firmware sends by itself, another one line for each "i" that it gets. After its start, which opening the
port causes, it measures its offsets for some seconds and sends "123". Source: the lab's public sketches,
HUMASoft/ArduinoSensors_Archived; read, not copied.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Sequence
from typing import Any

from softneck.core import SoftneckError
from softneck.signals import pitch_roll

from ..bus._link import reason
from ..master import Frame, Tilt

# Two decimals or more: a number cut within its decimals is invalid.
_LINE = re.compile(rb"i(\d{1,3}\.\d{2,}),\s?o(\d{1,3}\.\d{2,}|nan)")
_MAX_LINE_BYTES = 64
_REQUEST_BYTE = b"i"


class SensorError(SoftneckError):
    """An inclinometer cannot be opened, or uses another protocol."""


def tilt_of_line(line: bytes) -> Tilt | None:
    """Return the tilt in one line (without its end); None for other lines.

    At exactly no inclination the sensor's orientation is 0/0 and reads `nan`: the neck is upright then.
    """
    found = _LINE.fullmatch(line.strip(b"\r "))
    if found is None:
        return None
    inclination, text = float(found[1]), found[2]
    if text == b"nan" and inclination != 0.0:
        return None
    orientation = 0.0 if text == b"nan" else float(text)
    if inclination > 180.0 or orientation > 360.0:
        return None
    pitch, roll = pitch_roll(*(math.radians(angle) for angle in (inclination, orientation)))  # pyright: ignore[reportArgumentType]
    return Tilt(float(pitch), float(roll))


class TiltLines:
    """Parser of samples in a stream of bytes; damaged data only affects its own line.

    `good`, `bad`: numbers of lines so far. `strange`: the last bytes that were not a line of this protocol.
    """

    def __init__(self) -> None:
        """Start in the middle of a line: bytes before the first line end are not counted."""
        self._rest = b""
        self._whole = False
        self.good = self.bad = 0
        self.strange = b""

    def feed(self, data: bytes) -> list[Tilt]:
        """Return the samples of the lines that end in `data`."""
        *lines, rest = (self._rest + data).split(b"\n")
        samples = []
        for line in lines:
            sample = tilt_of_line(line) if len(line) <= _MAX_LINE_BYTES else None
            if sample is not None and self._whole:
                self.good += 1
                samples.append(sample)
            elif self._whole and line.strip():
                self.bad += 1
                self.strange = line[:_MAX_LINE_BYTES]
            self._whole = True
        if len(rest) > _MAX_LINE_BYTES:
            # No line end in so many bytes: binary data, up to the next line end.
            self.strange = rest[:_MAX_LINE_BYTES]
            self.bad += 1
            rest, self._whole = b"", False
        self._rest = rest
        return samples


class SerialInclinometer:
    """Reader of the lab's lines from a serial port; it never blocks.

    Attributes:
        lines: numbers of good and bad lines.
        problem: reason why reading ended; "" while it goes on.
    """

    def __init__(self, port: str, *, baud: int = 9600, request: bool = False, start: float = 10.0) -> None:
        """Open `port` and wait for the first sample.

        Args:
            port: such as /dev/ttyACM0.
            baud: bit/s.
            request: the firmware sends a line for each "i" only.
            start: time-out for the first sample [s].

        Raises SensorError: no such port, no permission, silent, or another protocol; one line.
        """
        import serial

        self.name, self._request = port, request
        self.lines, self.problem = TiltLines(), ""
        self._newest: Tilt | None = None
        try:
            self._port: Any = serial.Serial(port, baud, timeout=0.0, write_timeout=0.0, exclusive=True)
        except (OSError, ValueError) as error:
            raise SensorError(f"inclinometer {port}: cannot be opened: {reason(error)} Nothing moved.") from error
        try:
            self._begin(baud, start)
        except BaseException:
            self.close()
            raise

    def take(self, frames: Sequence[Frame]) -> None:
        """Read the available bytes and keep the newest sample."""
        del frames
        self._read()

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        """Return the newest sample since the last call, or None; request the next one if need be."""
        del now, frames
        self._read()
        self._ask()
        newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(OSError):
            self._port.close()

    def _begin(self, baud: int, start: float) -> None:
        until = time.monotonic() + start
        while self._newest is None:
            self._ask()
            time.sleep(0.02)
            self._read()
            if self.problem:
                raise SensorError(f"inclinometer {self.name}: {self.problem}")
            lines = self.lines
            # "123" and a torn line may come first; 20 lines without a sample are another sensor.
            if lines.bad >= 20 or (time.monotonic() > until and lines.strange):
                raise SensorError(
                    f"inclinometer {self.name}: sends no lines such as i12.34,o120.00 at {baud} baud, but "
                    f"{lines.strange!r}: another sensor, or another baud rate?"
                )
            if time.monotonic() > until:
                hint = "" if self._request else " Some firmware must be asked: `request = true` of [sensor]."
                raise SensorError(f"inclinometer {self.name}: silent for {start:g} s at {baud} baud.{hint}")

    def _read(self) -> None:
        if self.problem:
            return
        try:
            data = self._port.read(4096)
        except (OSError, TypeError) as error:
            self.problem = reason(error)
            return
        if data:
            samples = self.lines.feed(data)
            if samples:
                self._newest = samples[-1]

    def _ask(self) -> None:
        if self._request and not self.problem:
            try:
                self._port.write(_REQUEST_BYTE)
            except OSError as error:
                # A full buffer is not an error: the sensor is late, which the gate detects.
                if not type(error).__name__.endswith("TimeoutException"):
                    self.problem = reason(error)
