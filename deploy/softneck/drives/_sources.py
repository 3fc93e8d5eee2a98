"""Which inclinometer a drives file names, and how it is opened: on the bus, serial, from a recording, or one's own."""

from __future__ import annotations

import contextlib
import importlib
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, Vector, require_between, require_whole
from softneck.signals import read_recording

from ._log_file import read_run_log
from ._sensor import CanInclinometer
from ._serial import SensorError, SerialInclinometer
from .master import Frame, Tilt

SENSORS = ("simulated", "can", "serial", "replay", "python")
_METHODS = ("take", "read")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSource:
    """Where the inclinometer's samples come from, beside its kind.

    Attributes:
        port, baud, request, start: of kind "serial", see `SerialInclinometer`.
        file: of kind "replay": a recording, or the log of a run.
        python: of kind "python": `package.module:factory`, called with `options`.
        options: for the factory.
        folder: of the drives file, where files and modules are looked for.
    """

    port: str = ""
    baud: int = 9600
    request: bool = False
    start: float = 10.0
    file: str = ""
    python: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        require_whole("baud", self.baud, 300, 4_000_000)
        require_between("start_s", self.start, 0.1, 120.0, "s")


# Key of [sensor] in the drives file -> (field, type).
SOURCE_KEYS: dict[str, tuple[str, type]] = {
    "port": ("port", str),
    "baud": ("baud", int),
    "request": ("request", bool),
    "start_s": ("start", float),
    "file": ("file", str),
    "python": ("python", str),
    "options": ("options", dict),
}
_NEEDS = {"serial": "port", "replay": "file", "python": "python"}


def make_source(kind: str, table: Mapping[str, Any], folder: Path) -> SensorSource:
    """Return the source that the keys `SOURCE_KEYS` of a table [sensor] describe.

    Raises:
        SettingsError: a key of another type, or one that the kind needs is missing.
    """
    values: dict[str, Any] = {}
    for key, value in table.items():
        name, wanted = SOURCE_KEYS[key]
        number = wanted is float and isinstance(value, int) and not isinstance(value, bool)
        if not (number or isinstance(value, wanted)) or (wanted is int and isinstance(value, bool)):
            raise SettingsError(f"[sensor] {key} must be of type {wanted.__name__}; got {value!r}.")
        values[name] = value
    needed = _NEEDS.get(kind)
    if needed is not None and not values.get(needed):
        raise SettingsError(f'[sensor] kind = "{kind}" needs `{needed}`.')
    return SensorSource(**values, folder=folder)


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
            return ReplaySensor(recording.time, recording.channels["pitch"], recording.channels["roll"])
        case "python":
            return _made(source)
        case _:
            raise SettingsError(f'[sensor] kind is "{kind}"; on a bus it must be one of {", ".join(SENSORS[1:])}.')


def _made(source: SensorSource) -> Any:
    module, _, name = source.python.partition(":")
    folder = str(source.folder.resolve())
    sys.path.insert(0, folder)
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingsError(
            f"[sensor] python = `{source.python}` cannot be found ({error}); write package.module:factory."
        ) from error
    finally:
        sys.path.remove(folder)
    try:
        sensor = factory(dict(source.options))
    except Exception as error:
        raise SensorError(f"inclinometer `{source.python}`: {type(error).__name__}: {error}") from error
    missing = [method for method in _METHODS if not callable(getattr(sensor, method, None))]
    if missing:
        raise SettingsError(f"[sensor] python = `{source.python}` returned a sensor without `{missing[0]}`.")
    return sensor
