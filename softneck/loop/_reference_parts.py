"""References as parts of a loop: one known ahead for controllers with preview, and the block of an SSP file's FMU."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from softneck.core import SettingsError, Vector, require_positive, require_steps, to_si
from softneck.robot import Robot
from softneck.runtime import Block, Port

from ._references import SHAPES, RecordingReference, Reference, RobotReference, reference_range
from ._wiring import reference_ports


class AheadReference:
    """A reference as a part that also tells what it will be `ahead` later; a `softneck.loop.Part`."""

    role = "reference"

    def __init__(
        self, reference: Reference, ahead: float, *, sample_time: float = 0.02, robot: Robot | None = None
    ) -> None:
        """Adapt `reference`, a function of time; `ahead` [s] is the controller's `preview`, `robot` None a neck."""
        require_positive("ahead", ahead, "s")
        require_positive("sample_time", sample_time, "s")
        self.reference, self.ahead, self.sample_time = reference, ahead, sample_time
        self.inputs: tuple[Port, ...] = ()
        whose = Robot.preset() if robot is None else robot
        unit, self._count = to_si(whose.outputs.unit)[1], len(whose.outputs.names)
        self.outputs: tuple[Port, ...] = (
            *reference_ports(whose),
            *(Port(name=f"{name}_reference_ahead", unit=unit, description=f"wanted {name}, `ahead` from now")
              for name in whose.outputs.names),
        )  # fmt: skip

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return what holds at `time` [s]; it has no parameters."""
        if parameters:
            raise SettingsError(f"`{next(iter(parameters))}` is not a parameter of a reference ahead; it has none.")
        return self._at(time)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002 - it has none
        """Return what holds one sample after `time` [s]."""
        return self._at(time + self.sample_time)

    def close(self) -> None:
        """Do nothing: it holds nothing."""

    def _at(self, time: float) -> Vector:
        return np.array([*self.reference(time), 1.0, *self.reference(time + self.ahead)[: self._count]])


_RECORDED = 4


def _parameters(robot: Robot) -> tuple[Port, ...]:
    """Return the parameters, in the runtime's order; the starts of those that a kind does not have are never read."""
    outputs = to_si(robot.outputs.unit)[1]

    def port(name: str, unit: str, description: str, shown: str) -> Port:
        low, high, of = reference_range(name, robot)
        low, high = (to_si(of)[0] * end if math.isfinite(end) else None for end in (low, high))
        return Port(name=name, unit=unit, description=description, minimum=low, maximum=high, display_unit=shown)

    common = f"{robot.cocontraction_name} (Eq. 11)" if robot.directions.names else "mean of the motors"
    turned = port("inclination", outputs, "of a rotation", robot.outputs.shown)
    return (
        *(port(name, outputs, "end value or amplitude", robot.outputs.shown) for name in robot.outputs.names),
        port("cocontraction", to_si(robot.motors.unit)[1], common, robot.motors.shown),
        replace(turned, minimum=0.0),
        Port(name="frequency", unit="1", minimum=0.0, start=0.2, description="of a sine or rotation [Hz]"),
        Port(name="at", unit="s", description="time at which it begins"),
        Port(name="rise", unit="s", minimum=1e-9, start=1.0, description="time over which it rises"),
        Port(name="enabled_start", boolean=True, start=1.0, description="value of `enabled`"),
    )


class ReferenceBlock:
    """A reference that an FMU can be built of (`softneck.fmu.describe._describe.Buildable`)."""

    def __init__(
        self,
        reference: Reference,
        *,
        sample_time: float = 0.02,
        duration: float | None = None,
        robot: Robot | None = None,
    ) -> None:
        """Describe `reference` as a block.

        Args:
            reference: one of softneck's own, or any function of time if `duration` is given.
            sample_time: [s].
            duration: for how long a function of your own is written down, sample by sample [s].
            robot: whose; None: the neck's.
        """
        require_positive("sample_time", sample_time, "s")
        self.reference, self.sample_time = reference, sample_time
        self._duration, self._robot = duration, Robot.preset() if robot is None else robot

    def block(self) -> Block:
        """Return the block; its outputs are those of the reference, one sample after each step.

        Raises:
            SettingsError: a function of the user's own without a duration.
        """
        kind, starts, table = self._described()
        parameters = tuple(replace(port, start=starts.get(port.name, port.start)) for port in _parameters(self._robot))
        return Block(
            kind="reference", role="reference", runtime="softneck.loop._reference_runtime",
            sample_time=self.sample_time, arrays=(np.array([float(kind), self.sample_time]), table), inputs=(),
            outputs=reference_ports(self._robot), parameters=parameters,
        )  # fmt: skip

    def summary(self) -> str:
        """Return a line for people."""
        name = type(self.reference).__name__
        values = ", ".join(f"{key} = {value:g}" for key, value in self._described()[1].items())
        return f"{name}{f' ({values}; SI)' if values else ''} at {1e3 * self.sample_time:g} ms"

    def _described(self) -> tuple[int, dict[str, float], np.ndarray]:
        made, columns = self.reference, len(self._robot.outputs.names) + 2
        if isinstance(made, RobotReference):
            names = ("inclination",) if made.kind == "rotation" else self._robot.outputs.names
            starts = dict(zip(names, made.values, strict=True)) | {"cocontraction": made.cocontraction}
            starts |= {name: getattr(made, name) for name in SHAPES[made.kind]}
            return list(SHAPES).index(made.kind), starts, np.zeros((1, columns))
        return _RECORDED, {}, made.table if isinstance(made, RecordingReference) else self._table()

    def _table(self) -> np.ndarray:
        """Return (rows, 1 + values): the reference's values, sample by sample."""
        if self._duration is None:
            raise SettingsError("a reference of your own needs the duration over which it is written down.")
        require_steps("duration_s", self._duration, self.sample_time, 4)
        times = np.arange(math.ceil(self._duration / self.sample_time) + 1) * self.sample_time
        return np.array([[time, *self.reference(time)] for time in times.tolist()])
