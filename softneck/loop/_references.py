"""References of the outputs of a robot and its co-contraction over time, and parts that return them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    ReprMixin,
    SettingsError,
    SoftneckError,
    Vector,
    require_finite,
    require_one_of,
    require_positive,
    require_steps,
    to_si,
)
from softneck.robot import Robot
from softneck.runtime import Block, Port

from ._reference_runtime import reference_rotation, reference_row, reference_value

_NECK = Robot.preset("neck")
#: Kind, in the order of the runtime -> its parameters besides values, with their defaults.
SHAPES: dict[str, dict[str, float]] = {
    "step": {"at": 0.0},
    "ramp": {"at": 0.0, "rise": 1.0},
    "sine": {"at": 0.0, "frequency": 0.2},
    "rotation": {"at": 0.0, "rise": 3.0, "frequency": 0.2},
}
_ENDINGS = {"at": "s", "rise": "s", "frequency": "hz"}
_TIMES = {"": 1.0, "s": 1.0, "ms": 1e-3, "hz": 1.0}


class Reference(Protocol):
    """A function of `time` [s] that returns all outputs and co-contraction in SI: pitch, roll and delta_i of a neck."""

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotReference:
    """A step (from zero at `at`), ramp (over `rise`), sine (with phase zero at `at`) or rotation of two angles.

    A rotation is A cos(w t) and A sin(w t), where A rises from zero over `rise`. `kind`: "step", "ramp", "sine" or
    "rotation". `values`: (outputs,) end values or amplitudes [SI]; for a rotation the inclination A. `cocontraction`:
    mean of the motors, delta_i of a neck [SI]; constant for sine and rotation. `at`, `rise`: [s]. `frequency`: [Hz].
    """

    kind: str
    values: tuple[float, ...]
    cocontraction: float = 0.0
    at: float = 0.0
    rise: float = 1.0
    frequency: float = 0.2
    repeats: ClassVar[bool] = True  # equal ones have equal samples: `run_loop` keeps them

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, tuple(SHAPES))
        require_finite("at", self.at, "s")
        require_positive("rise", self.rise, "s")
        require_positive("frequency", self.frequency, "Hz")

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time` [s]: all outputs, then co-contraction."""
        kind, times = tuple(SHAPES).index(self.kind), (self.frequency, self.at, self.rise)
        if self.kind == "rotation":
            return (*reference_rotation(time, self.values[0], *times), self.cocontraction)
        values = tuple(reference_value(kind, time, value, *times) for value in self.values)
        common = self.cocontraction
        return (*values, common if self.kind == "sine" else reference_value(kind, time, common, *times))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RecordingReference(ReprMixin):
    """Recorded outputs of any robot; each row holds until the next one, and the last one to the end.

    Attributes:
        table: (rows, outputs + 2) increasing time [s], outputs (of a neck pitch and roll [rad]), co-contraction.
    """

    table: Matrix

    def __post_init__(self) -> None:
        table = self.table
        if table.ndim != 2 or table.shape[1] < 3:
            raise DataError(f"a recorded reference is a table (rows, outputs + 2); got the shape {table.shape}.")
        if not len(table) or not np.isfinite(table).all() or np.any(np.diff(table[:, 0]) <= 0.0):
            raise DataError("a recorded reference must be finite with rising time; fix the recording.")

    @classmethod
    def of(cls, time: Vector, channels: Mapping[str, Vector], names: Sequence[str]) -> RecordingReference:
        """Return the recorded references of the outputs `names`, or the outputs themselves if there are none."""
        columns = [channels.get(f"{name}_reference", channels[name]) for name in names]
        common = channels.get("cocontraction_reference", np.zeros(time.size))
        return cls(np.column_stack([time, *columns, common]))

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time` [s]: all outputs, then co-contraction."""
        # The search finds the neighbourhood fast; the runtime then determines the row.
        near = max(0, int(np.searchsorted(self.table[:, 0], time, side="right")) - 1)
        return tuple(self.table[reference_row(time, self.table, near), 1:].tolist())


def reference(kind: str, values: Mapping[str, float], robot: Robot = _NECK) -> RobotReference:
    """Return a reference from outputs, `inclination`, `cocontraction`, `at`, `rise` and `frequency`, all in SI."""
    if kind == "rotation" and (len(robot.outputs.names) != 2 or to_si(robot.outputs.unit)[1] != "rad"):
        names = ", ".join(robot.outputs.names)
        raise SettingsError(f'kind = "rotation" needs two angles; {robot.label()} has {names}.')
    wanted = {**dict.fromkeys(_units(kind, robot), 0.0), **SHAPES[kind]}
    for name, value in values.items():
        if name not in wanted:
            raise SettingsError(
                f"unknown key `{name}` of a {kind} reference; it takes {', '.join(wanted)} with a unit."
            )
        require_finite(name, value, "SI")
        _check_range(name, value, robot)
    wanted |= values
    times = {name: wanted.pop(name) for name in SHAPES[kind]}
    common = wanted.pop("cocontraction")
    return RobotReference(kind=kind, values=tuple(wanted.values()), cocontraction=common, **times)


def make_reference(kind: str, values: Mapping[str, object], robot: Robot = _NECK) -> RobotReference:
    """Return a reference from the keys of a loop file: `x_mm = 10`, or `x = 10` in its display unit; `at_s`.

    The kinds are step, ramp, sine and rotation; `RecordingReference` makes a recorded one. Raises SettingsError: as for
    `reference`.
    """
    require_one_of("kind", kind, tuple(SHAPES))
    chosen = {}
    for key, value in values.items():
        name, factor = reference_key(kind, key, robot)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingsError(f"`{key}` must be a number; got {value!r}.")
        chosen[name] = factor * value
    return reference(kind, chosen, robot)


def reference_key(kind: str, key: str, robot: Robot) -> tuple[str, float]:
    """Return the value that a key such as `x_mm` or `at_s` sets in a reference of `kind`, and its factor to SI."""
    units, times = _units(kind, robot), SHAPES.get(kind, {})
    name, _, unit = (key, "", "") if key in units or key in times else key.rpartition("_")
    if name in times and unit in _TIMES:
        return name, _TIMES[unit]
    if name in units:
        at = robot.outputs
        if not unit and name != "cocontraction" and at.unit != at.display_unit and to_si(at.unit)[1] == "rad":
            raise SettingsError(f"`{key}` may be in rad or deg; write `{key}_rad` or `{key}_deg`.")
        try:
            factor, si = to_si(unit or units[name])
        except SoftneckError:
            factor, si = 1.0, ""
        if si == to_si(units[name])[1]:
            return name, factor
    raise SettingsError(
        f"unknown key `{key}` of a {kind} reference; it takes {', '.join((*units, *times))} with a unit."
    )


def reference_field(kind: str, key: str, robot: Robot) -> str | None:
    """Return the value that a key sets in a reference of `kind`; None for an unknown key."""
    try:
        return reference_key(kind, key, robot)[0]
    except SettingsError:
        return None


def reference_keys(made: object, robot: Robot = _NECK) -> dict[str, float | str] | None:
    """Return the keys of a loop file that describe a reference; None if it is not a step, ramp, sine or rotation."""
    if not isinstance(made, RobotReference):
        return None
    values = (*made.values, made.cocontraction)
    keys = {f"{name}_{to_si(unit)[1]}": value
            for (name, unit), value in zip(_units(made.kind, robot).items(), values, strict=True)}  # fmt: skip
    return {
        "kind": made.kind,
        **keys,
        **{f"{name}_{_ENDINGS[name]}": getattr(made, name) for name in SHAPES[made.kind]},
    }


def same_quantity(one: str, other: str) -> bool:
    """Return whether two keys set the same quantity, also in different units, such as `x_mm` and `x`."""
    return _without_unit(one) == _without_unit(other)


def _without_unit(key: str) -> str:
    name, _, unit = key.rpartition("_")
    try:
        return name if unit in _TIMES or to_si(unit) else key
    except SoftneckError:
        return key


def _units(kind: str, robot: Robot) -> dict[str, str]:
    outputs = ("inclination",) if kind == "rotation" else robot.outputs.names
    return {**dict.fromkeys(outputs, robot.outputs.display_unit), "cocontraction": robot.motors.unit}


def reference_range(name: str, robot: Robot) -> tuple[float, float, str]:
    """Return lowest and highest value of an output, the inclination or co-contraction, and their unit."""
    outputs, motors = robot.outputs, robot.motors
    if name == "cocontraction":
        return min(motors.setpoint_min or (-np.inf,)), max(motors.setpoint_max or (np.inf,)), motors.unit
    half = robot.angle_limit / to_si(outputs.unit)[0]
    if name == "inclination":
        most = min(outputs.max or (half,))
        return -most, most, outputs.unit
    at = outputs.names.index(name)
    low = -half if outputs.min is None else outputs.min[at]
    return low, half if outputs.max is None else outputs.max[at], outputs.unit


def _check_range(name: str, value: float, robot: Robot) -> None:
    if name in _ENDINGS or (name == "cocontraction" and value == 0.0):
        return
    low, high, unit = reference_range(name, robot)
    factor, si = to_si(unit)
    if not low * factor <= value <= high * factor:
        hint = ": degrees?" if si == "rad" and name != "cocontraction" else "."
        raise SettingsError(
            f"`{name}` must be within {low:g} to {high:g} {unit}, the range of robot {robot.label()}; "
            f"got {value / factor:g}{hint}"
        )


def reference_ports(robot: Robot = _NECK) -> tuple[Port, ...]:
    """Return the output ports of a reference of `robot`."""
    outputs, motors = robot.outputs, robot.motors
    unit, motor = to_si(outputs.unit)[1], to_si(motors.unit)[1]
    common = f"co-contraction {robot.cocontraction_name} (Eq. 11)" if robot.directions.names else "mean of the motors"
    return (
        *(Port(name=f"{name}_reference", unit=unit, description=f"wanted {name}", display_unit=outputs.shown)
          for name in outputs.names),
        Port(name="cocontraction_reference", unit=motor, description=f"wanted {common}", display_unit=motors.shown),
        Port(name="enabled", description="whether the controller may move the motors", start=1.0, boolean=True),
    )  # fmt: skip


class AheadReference:
    """A reference as a part with outputs for now and for `ahead` later; a `softneck.loop.Part`."""

    role = "reference"

    def __init__(
        self, reference: Reference, ahead: float, *, sample_time: float = 0.02, robot: Robot | None = None
    ) -> None:
        """Adapt `reference`, a function of time; `ahead` [s] is the controller's `preview`, `robot` None the neck."""
        require_positive("ahead", ahead, "s")
        require_positive("sample_time", sample_time, "s")
        self.reference, self.ahead, self.sample_time = reference, ahead, sample_time
        self.inputs: tuple[Port, ...] = ()
        own = Robot.preset() if robot is None else robot
        unit, self._count = to_si(own.outputs.unit)[1], len(own.outputs.names)
        self.outputs: tuple[Port, ...] = (
            *reference_ports(own),
            *(Port(name=f"{name}_reference_ahead", unit=unit, description=f"wanted {name}, `ahead` from now")
              for name in own.outputs.names),
        )  # fmt: skip

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the reference at `time` [s]; it has no parameters."""
        if parameters:
            raise SettingsError(f"`{next(iter(parameters))}` is not a parameter of a reference ahead; it has none.")
        return self._at(time)

    def advance(self, time: float, inputs: Vector) -> Vector:  # noqa: ARG002 - it has none
        """Return the reference one sample after `time` [s]."""
        return self._at(time + self.sample_time)

    def close(self) -> None:
        """Release no resources: it has none."""

    def _at(self, time: float) -> Vector:
        return np.array([*self.reference(time), 1.0, *self.reference(time + self.ahead)[: self._count]])


# Kind of a recorded reference in the runtime.
_RECORDING_KIND = 4


def _parameters(robot: Robot) -> tuple[Port, ...]:
    """Return the parameters in the order of the runtime; each kind reads only its own."""
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
    """A reference from which an FMU can be built (a `softneck.fmu.Buildable`)."""

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
            reference: one of softneck's, or any function of time if `duration` is given.
            sample_time: [s].
            duration: for which a function of the user is tabulated, sample by sample [s].
            robot: None for the neck.
        """
        require_positive("sample_time", sample_time, "s")
        self.reference, self.sample_time = reference, sample_time
        self._duration, self._robot = duration, Robot.preset() if robot is None else robot

    def block(self) -> Block:
        """Return the block; its outputs are the reference one sample after each step.

        Raises:
            SettingsError: a function of the user without a duration.
        """
        kind, starts, table = self._describe()
        parameters = tuple(replace(port, start=starts.get(port.name, port.start)) for port in _parameters(self._robot))
        return Block(
            kind="reference", role="reference", runtime="softneck.loop._reference_runtime",
            sample_time=self.sample_time, arrays=(np.array([float(kind), self.sample_time]), table), inputs=(),
            outputs=reference_ports(self._robot), parameters=parameters,
        )  # fmt: skip

    def summary(self) -> str:
        """Return one line on the reference."""
        name = type(self.reference).__name__
        values = ", ".join(f"{key} = {value:g}" for key, value in self._describe()[1].items())
        return f"{name}{f' ({values}; SI)' if values else ''} at {1e3 * self.sample_time:g} ms"

    def _describe(self) -> tuple[int, dict[str, float], np.ndarray]:
        made, columns = self.reference, len(self._robot.outputs.names) + 2
        if isinstance(made, RobotReference):
            names = ("inclination",) if made.kind == "rotation" else self._robot.outputs.names
            starts = dict(zip(names, made.values, strict=True)) | {"cocontraction": made.cocontraction}
            starts |= {name: getattr(made, name) for name in SHAPES[made.kind]}
            return list(SHAPES).index(made.kind), starts, np.zeros((1, columns))
        return _RECORDING_KIND, {}, made.table if isinstance(made, RecordingReference) else self._table()

    def _table(self) -> np.ndarray:
        """Return the reference as a table (rows, 1 + values), sample by sample."""
        if self._duration is None:
            raise SettingsError("a reference that is a function needs `duration`, over which it is tabulated.")
        require_steps("duration_s", self._duration, self.sample_time, 4)
        times = np.arange(math.ceil(self._duration / self.sample_time) + 1) * self.sample_time
        return np.array([[time, *self.reference(time)] for time in times.tolist()])
