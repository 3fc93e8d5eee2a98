"""How the inclinometer that a drives file names is opened: on the bus, serial, from a recording, or one's own."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

from softneck.core import SettingsError, Vector
from softneck.signals import read_recording

from ..bus._sensor_source import SENSORS, SensorSource
from ..logs._log_file import read_run_log
from ..master import Frame, Tilt
from ._python_sensor import make_python_sensor
from ._sensor import CanInclinometer
from ._serial import SerialInclinometer


class ReplaySensor:
    """Plays a recording as inclinometer: the sample that is due since the first reading, each once."""

    def __init__(self, time: Vector, pitch: Vector, roll: Vector) -> None:
        """Play `pitch` and `roll` [rad] at `time` [s], all of shape (N,)."""
        self._time, self._pitch, self._roll = time - time[0], pitch, roll
        self._begin: float | None = None
        self._told = -1

    def take(self, frames: Sequence[Frame]) -> None:
        """Nothing on the bus is of interest."""
        del frames

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        """Return the newest sample that is due, None if it was told already or the recording is over."""
        del frames
        self._begin = now if self._begin is None else self._begin
        # A cycle's rounding must not move a sample into the next one.
        k = int(self._time.searchsorted(now - self._begin + 1e-6, side="right")) - 1
        if k == self._told or k < 0:
            return None
        self._told = k
        pitch, roll = float(self._pitch[k]), float(self._roll[k])
        return Tilt(pitch, roll, valid=math.isfinite(pitch) and math.isfinite(roll))


@contextlib.contextmanager
def open_sensor(kind: str, node: int, source: SensorSource) -> Iterator[Any]:
    """Yield the inclinometer of a drives file; see the protocol `Sensor`.

    Raises:
        SettingsError: a simulated one, a factory that cannot be called, or that returns no sensor.
        SensorError: no port, no permission, silent, or another protocol.
        FileFormatError: no such recording.
    """
    sensor = _opened(kind, node, source)
    try:
        yield sensor
    finally:
        close = getattr(sensor, "close", None)
        if close is not None:
            close()


def _opened(kind: str, node: int, source: SensorSource) -> Any:
    match kind:
        case "can":
            return CanInclinometer(node)
        case "serial":
            return SerialInclinometer(source.port, baud=source.baud, request=source.request, start=source.start)
        case "replay":
            path = source.folder / source.file
            log = path.suffix.lower() == ".mcap"
            recording = read_run_log(path).recording() if log else read_recording(path)
            recording.robot.require_neck(f"{path}: a replay")
            return ReplaySensor(recording.time, recording.channels["pitch"], recording.channels["roll"])
        case "python":
            return make_python_sensor(source.python, source.options, source.folder)
        case _:
            raise SettingsError(f'[sensor] kind is "{kind}"; on a bus it must be one of {", ".join(SENSORS[1:])}.')
