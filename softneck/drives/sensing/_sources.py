"""How the inclinometer that a drives file names is opened: on the bus, serial, or one's own."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from softneck.core import SettingsError
from softneck.robot import Robot
from softneck.signals.recording._channels import NECK

from ..bus._axes import Axes, axes_of, turned
from ..bus._sensor_source import SENSORS, SensorSource
from ..master import Frame
from ..master._gate import Reading, sample_of
from ._python_sensor import make_python_sensor
from ._sensor import CanInclinometer
from ._serial import SerialInclinometer


class _FirstAngle:
    """Of a two-axis inclinometer the first angle, for a robot with one output; it sits with that axis in its plane."""

    def __init__(self, sensor: SerialInclinometer) -> None:
        self._sensor, self.name, self.close = sensor, sensor.name, sensor.close

    @property
    def problem(self) -> str:
        return self._sensor.problem

    def take(self, frames: Sequence[Frame]) -> None:
        self._sensor.take(frames)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        tilt = self._sensor.read(now, frames)
        return None if tilt is None else sample_of(tilt.values[:1], tilt.rates[:1], valid=tilt.valid)


class _Turned:
    """A sensor that is mounted with other axes, or signs, than the robot's outputs."""

    def __init__(self, sensor: Any, axes: Axes) -> None:
        self._sensor, self._axes, self.take = sensor, axes, sensor.take

    def __getattr__(self, name: str) -> Any:
        # What not every sensor has: name, problem, close.
        return getattr(self._sensor, name)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        sample = self._sensor.read(now, frames)
        return None if sample is None else turned(sample, self._axes)


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
        sensor = _Turned(sensor, axes_of(axes, robot.outputs.names))
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
            return sensor if count == 2 else _FirstAngle(sensor)
        case "python":
            return make_python_sensor(source.python, source.options, source.folder, outputs=count)
        case _:
            raise SettingsError(f'[sensor] kind is "{kind}"; on a bus it must be one of {", ".join(SENSORS[1:])}.')
