"""Opening of the inclinometer of a drives file: on the bus, serial, or the user's own."""

from __future__ import annotations

import contextlib
import importlib
import math
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from softneck.core import SettingsError
from softneck.robot import Robot
from softneck.signals import NECK

from ..bus._link import Link
from ..bus._sensor_source import SENSORS, SensorSource, axes_of, to_robot_axes
from ..master import Frame, Tilt
from ..master._gate import Reading, sample_of
from ._serial import SensorError, SerialInclinometer

# 6110h and 6120h, slope of one axis or both in 32 bits, at a resolution of 0.001 deg (6000h = 1; CiA 410, 6.1).
_SLOPES = {1: struct.Struct("<i"), 2: struct.Struct("<ii")}
_RESOLUTION = math.radians(0.001)
# Sent by the sensor if it has no measurement: the most negative number.
_NO_MEASUREMENT = -(2**31)
# Time in which any active inclinometer sends a sample [s]: 10 samples at 20 Hz.
LOOK = 0.5
_READ_PERIOD_S = 0.02


class Sensor(Protocol):
    """A sensor of the outputs; it may also have an attribute `problem` with the reason of a failure."""

    def take(self, frames: Sequence[Frame]) -> None:
        """Process the frames of a cycle without a due sample; sensors that are not on the bus ignore them."""
        ...

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample since the last call, or None."""
        ...


def look_at(sensor: Sensor, link: Link, timeout: float) -> Reading | None:
    """Return the first sample of `sensor` within `timeout` [s], or None."""
    until = link.now + timeout
    while link.now < until:
        tilt = sensor.read(link.now, link.receive(_READ_PERIOD_S))
        if tilt is not None:
            return tilt
    return None


class CanInclinometer:
    """Reader of the slopes that node `node` sends in its first TPDO."""

    def __init__(self, node: int, axes: int = 2) -> None:
        """Listen for the identifier 180h + node. Raises SettingsError: neither one axis nor two."""
        if axes not in _SLOPES:
            raise SettingsError(
                f'[sensor] kind = "can" has one axis or two; the robot has {axes} outputs. Write kind = "python".'
            )
        self._identifier, self._slopes = 0x180 + node, _SLOPES[axes]
        self._newest: Reading | None = None

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample in `frames` or since the last call, or None."""
        del now
        self.take(frames)
        newest, self._newest = self._newest, None
        return newest

    def take(self, frames: Sequence[Frame]) -> None:
        """Process the frames of a cycle without a due sample."""
        for frame in frames:
            if frame.identifier != self._identifier or frame.remote or frame.error:
                continue
            if len(frame.data) == self._slopes.size:
                slopes = self._slopes.unpack(frame.data)
                self._newest = sample_of([slope * _RESOLUTION for slope in slopes], valid=_NO_MEASUREMENT not in slopes)


class _Changed:
    """A sensor with transformed samples: for other axes or signs of its mounting, or one of its two angles."""

    def __init__(self, sensor: Any, change: Callable[[Reading], Reading]) -> None:
        self._sensor, self._change, self.take = sensor, change, sensor.take

    def __getattr__(self, name: str) -> Any:
        # Optional attributes: name, problem, close.
        return getattr(self._sensor, name)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        sample = self._sensor.read(now, frames)
        return None if sample is None else self._change(sample)


@contextlib.contextmanager
def open_sensor(
    kind: str, node: int, source: SensorSource, robot: Robot = NECK, *, axes: Sequence[str] = ()
) -> Iterator[Any]:
    """Yield the inclinometer of a drives file, or another sensor of the outputs of `robot`; see `Sensor`.

    Its samples are transformed by `axes`, see `DrivesFile.sensor_axes`.

    Raises:
        SettingsError: a simulated sensor, a factory that cannot be called, or one that does not return a sensor.
        SensorError: no port, no permission, no data, or another protocol.
    """
    sensor = _open_source(kind, node, source, robot)
    if axes:
        order = axes_of(axes, robot.outputs.names)
        sensor = _Changed(sensor, lambda sample: to_robot_axes(sample, order))
    try:
        yield sensor
    finally:
        close = getattr(sensor, "close", None)
        if close is not None:
            close()


def _open_source(kind: str, node: int, source: SensorSource, robot: Robot) -> Any:
    count = len(robot.outputs.names)
    match kind:
        case "can":
            return CanInclinometer(node, count)
        case "serial":
            if count > 2:
                raise SettingsError(
                    f'[sensor] kind = "serial" has two angles; robot {robot.label()} has {count} outputs. Write kind = '
                    '"python".'
                )
            sensor = SerialInclinometer(source.port, baud=source.baud, request=source.request, start=source.start)
            # For a robot with one output the first axis of the sensor is in its plane.
            first = lambda tilt: sample_of(tilt.values[:1], tilt.rates[:1], valid=tilt.valid)  # noqa: E731
            return sensor if count == 2 else _Changed(sensor, first)
        case "python":
            return make_python_sensor(source.python, source.options, source.folder, outputs=count)
        case _:
            raise SettingsError(f'[sensor] kind is "{kind}"; on a bus it must be one of {", ".join(SENSORS[1:])}.')


_SOURCE_METHODS = ("take", "read")
# A longer call delays bus cycles [s]; the loop stops after five of them.
_MAX_CALL_S = 0.02


class PythonInclinometer:
    """Adapter of a user's own sensor; after its first error it is not called again, and the loop goes to rest.

    Attributes:
        problem: reason why it is not called again, or the call that took long; "" if there is none.
    """

    def __init__(self, sensor: Any, name: str, outputs: int = 2) -> None:
        """Wrap `sensor` with this number of outputs; messages call it `name`."""
        self._sensor, self.name, self._outputs = sensor, name, outputs
        self.problem = ""
        self._ended = False

    def take(self, frames: Sequence[Frame]) -> None:
        """Pass on the frames of a cycle without a sample."""
        self._call("take", frames)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample; None if there is none or the sensor returned another type."""
        answer = self._call("read", now, frames)
        if answer is None:
            return None
        try:
            return self._sample(answer)
        except (TypeError, ValueError) as error:
            self._end(f"`read` returned no sample: {error}")
            return None

    def _sample(self, answer: Any) -> Reading:
        """Convert a `Tilt`, or for other robots one number for each output, to a sample."""
        if isinstance(answer, Tilt) and self._outputs == 2:
            values, rates = ([float(value) for value in told] for told in (answer.values, answer.rates))
            return sample_of(values, rates, valid=bool(answer.valid))
        if self._outputs == 2:
            raise TypeError(f"{type(answer).__name__} {answer!r:.60} is not a softneck.drives.master.Tilt")
        values = [float(value) for value in list[Any](answer)]
        if len(values) != self._outputs:
            raise TypeError(f"{len(values)} numbers for {self._outputs} outputs")
        return sample_of(values)

    def close(self) -> None:
        """Close the sensor if it has `close`."""
        close = getattr(self._sensor, "close", None)
        if close is not None:
            # An error here no longer affects the drives.
            with contextlib.suppress(Exception):
                close()

    def _call(self, method: str, *arguments: Any) -> Any:
        if self._ended:
            return None
        begin = time.monotonic()
        try:
            answer = getattr(self._sensor, method)(*arguments)
        except Exception as error:  # after any error the drives must go to rest and not lose their set-points
            self._end(f"`{method}` raised {type(error).__name__}: {' '.join(str(error).split())}")
            return None
        took = time.monotonic() - begin
        if took > _MAX_CALL_S and not self.problem:
            self.problem = f"`{method}` took {1e3 * took:.0f} ms; it must not wait."
        return answer

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, f"{problem}. It was not asked again."


def make_python_sensor(
    python: str, options: Mapping[str, Any], folder: Path, *, outputs: int = 2
) -> PythonInclinometer:
    """Call the factory `package.module:factory` with `options`; the module is also searched in `folder`.

    Its sensor returns `Tilt`s, or for robots without two outputs a sequence with one number for each output [rad].
    Raises SettingsError: there is no such factory, or it does not return a sensor; SensorError: the factory raises an
    error.
    """
    module, _, name = python.partition(":")
    place = str(folder.resolve())
    sys.path.insert(0, place)
    try:
        factory = getattr(importlib.import_module(module), name)
    except Exception as error:  # importing a user's module may raise any error
        raise SettingsError(
            f"[sensor] python = `{python}` cannot be found ({type(error).__name__}: {' '.join(str(error).split())}); "
            "write package.module:factory."
        ) from error
    finally:
        sys.path.remove(place)
    try:
        sensor = factory(dict(options))
    except Exception as error:
        text = " ".join(str(error).split())
        raise SensorError(f"inclinometer `{python}`: {type(error).__name__}: {text}. Nothing moved.") from error
    missing = [method for method in _SOURCE_METHODS if not callable(getattr(sensor, method, None))]
    if missing:
        raise SettingsError(f"[sensor] python = `{python}` returned a sensor without `{missing[0]}`.")
    return PythonInclinometer(sensor, python, outputs)
