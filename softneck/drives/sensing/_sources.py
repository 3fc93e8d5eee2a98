"""How the inclinometer that a drives file names is opened: on the bus, serial, or one's own."""

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
from softneck.signals.recording._channels import NECK

from ..bus._link import Link
from ..bus._sensor_source import SENSORS, SensorSource, axes_of, turned
from ..master import Frame, Tilt
from ..master._gate import Reading, sample_of
from ._serial import SensorError, SerialInclinometer

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


class _Changed:
    """A sensor whose samples are changed: it is mounted with other axes or signs, or one angle of its two is meant."""

    def __init__(self, sensor: Any, change: Callable[[Reading], Reading]) -> None:
        self._sensor, self._change, self.take = sensor, change, sensor.take

    def __getattr__(self, name: str) -> Any:
        # What not every sensor has: name, problem, close.
        return getattr(self._sensor, name)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        sample = self._sensor.read(now, frames)
        return None if sample is None else self._change(sample)


@contextlib.contextmanager
def open_sensor(
    kind: str, node: int, source: SensorSource, robot: Robot = NECK, *, axes: Sequence[str] = ()
) -> Iterator[Any]:
    """Yield the inclinometer of a drives file, or what else measures the outputs of `robot`; see `Sensor`.

    Its samples are turned by `axes`, see `DrivesFile.sensor_axes`.

    Raises:
        SettingsError: a simulated one, a factory that cannot be called, or that returns no sensor.
        SensorError: no port, no permission, silent, or another protocol.
    """
    sensor = _opened(kind, node, source, robot)
    if axes:
        order = axes_of(axes, robot.outputs.names)
        sensor = _Changed(sensor, lambda sample: turned(sample, order))
    try:
        yield sensor
    finally:
        close = getattr(sensor, "close", None)
        if close is not None:
            close()


def _opened(kind: str, node: int, source: SensorSource, robot: Robot) -> Any:
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
            # Of a robot with one output the sensor sits with its first axis in that plane.
            first = lambda tilt: sample_of(tilt.values[:1], tilt.rates[:1], valid=tilt.valid)  # noqa: E731
            return sensor if count == 2 else _Changed(sensor, first)
        case "python":
            return make_python_sensor(source.python, source.options, source.folder, outputs=count)
        case _:
            raise SettingsError(f'[sensor] kind is "{kind}"; on a bus it must be one of {", ".join(SENSORS[1:])}.')


_METHODS = ("take", "read")
# A call that takes longer than this has cost bus cycles [s]; the loop itself stops after five of them.
_LONG = 0.02


class PythonInclinometer:
    """Asks a sensor of the user's own; after its first mistake it is asked no more, and the loop goes to rest.

    Attributes:
        problem: why it is asked no more, or which call took long; "" if all is well.
    """

    def __init__(self, sensor: Any, name: str, outputs: int = 2) -> None:
        """Ask `sensor` for so many outputs; it is called `name` where something is said about it."""
        self._sensor, self.name, self._outputs = sensor, name, outputs
        self.problem = ""
        self._ended = False

    def take(self, frames: Sequence[Frame]) -> None:
        """Hand over frames of a cycle without a sample."""
        self._call("take", frames)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample; None if none came, or where it returned something else."""
        answer = self._call("read", now, frames)
        if answer is None:
            return None
        try:
            return self._sample(answer)
        except (TypeError, ValueError) as error:
            self._end(f"`read` returned no sample: {error}")
            return None

    def _sample(self, answer: Any) -> Reading:
        """Return a `Tilt`, or one number for each output of another robot, as a sample."""
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
        """Close it if it can be closed."""
        close = getattr(self._sensor, "close", None)
        if close is not None:
            # What fails now can no longer move or stop anything.
            with contextlib.suppress(Exception):
                close()

    def _call(self, method: str, *arguments: Any) -> Any:
        if self._ended:
            return None
        begin = time.monotonic()
        try:
            answer = getattr(self._sensor, method)(*arguments)
        except Exception as error:  # whatever it is, the drives must be led to rest rather than dropped
            self._end(f"`{method}` raised {type(error).__name__}: {' '.join(str(error).split())}")
            return None
        took = time.monotonic() - begin
        if took > _LONG and not self.problem:
            self.problem = f"`{method}` took {1e3 * took:.0f} ms; it must not wait."
        return answer

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, f"{problem}. It was not asked again."


def make_python_sensor(
    python: str, options: Mapping[str, Any], folder: Path, *, outputs: int = 2
) -> PythonInclinometer:
    """Call the factory `package.module:factory` with `options`; `folder` is looked into for the module too.

    Its sensor says `Tilt`s, or for a robot of other than two outputs a sequence with one number for each [rad].

    Raises:
        SettingsError: there is no such factory, or it returns no sensor.
        SensorError: it raises something.
    """
    module, _, name = python.partition(":")
    place = str(folder.resolve())
    sys.path.insert(0, place)
    try:
        factory = getattr(importlib.import_module(module), name)
    except Exception as error:  # a module of the user's own raises what it likes while it is imported
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
    missing = [method for method in _METHODS if not callable(getattr(sensor, method, None))]
    if missing:
        raise SettingsError(f"[sensor] python = `{python}` returned a sensor without `{missing[0]}`.")
    return PythonInclinometer(sensor, python, outputs)
