"""Motors and outputs of a robot, and the directions in which motors move outputs."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from functools import cache

import numpy as np

from softneck.core import Matrix, SettingsError, require_one_of, to_si

MOST_MOTORS, MOST_OUTPUTS = 8, 4
_NUMBERED = re.compile(r"motor_(?P<what>setpoint|position|velocity|position_measured)_(?P<motor>[1-8])")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Names and endings of other channels in recordings, which outputs must not have.
_TAKEN = re.compile(r"(time|run|motor_.*|payload|compression|push_.*|base_tilt_.*|innovation|healthy|enabled|"
                    r"validity|.*_(rate|measured|estimate|reference|lower|upper|start|valid))")  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Motors:
    """The 1 to 8 motors, tendons or chambers of a robot; limits in `unit`, None if not given.

    Attributes:
        names: `pressure` has the channels `pressure_setpoint`, `pressure_position`, ..; `motor_1` `motor_setpoint_1`.
        unit: of set-points and positions in the robot's files, such as "rad" or "bar".
        setpoint_min: (motors,) lowest set-points.
        setpoint_max: (motors,) highest set-points.
        rate_limit: (motors,) largest changes of the set-points [`unit`/s].
        sign: (motors,) -1 if the hardware counts in the opposite direction: in softneck positive motors pull.
        nominal: (motors,) typical set-points, as in FMI, which scale the motors; if not given, their range does.
        rest: (motors,) set-points at rest; learned from data if not given.
    """

    names: tuple[str, ...]
    unit: str
    setpoint_min: tuple[float, ...] | None = None
    setpoint_max: tuple[float, ...] | None = None
    rate_limit: tuple[float, ...] | None = None
    sign: tuple[float, ...] = ()
    nominal: tuple[float, ...] | None = None
    rest: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _keep_tuples(self)
        _check_names("motors", self.names, MOST_MOTORS)
        _unit("motors.unit", self.unit)
        if not self.sign:
            object.__setattr__(self, "sign", (1.0,) * len(self.names))
        _one_each("motors", self.names, self.setpoint_min, self.setpoint_max, self.rate_limit, self.sign,
                  self.nominal, self.rest)  # fmt: skip
        _positive("motors.nominal", self.nominal, self.unit)
        check_range("motors", "setpoint_min", "setpoint_max", self.setpoint_min, self.setpoint_max)
        _positive("motors.rate_limit", self.rate_limit, f"{self.unit}/s")
        for sign in self.sign:
            if sign not in (1.0, -1.0):
                raise SettingsError(f"`motors.sign` must be 1 or -1; got {sign:g}.")

    @property
    def shown(self) -> str:
        """In which unit tools show set-points and positions: `unit`; "" of angles, which have a usual one."""
        return "" if to_si(self.unit)[1] == "rad" else self.unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Outputs:
    """The 1 to 4 measured outputs; limits in `unit`, None if not given.

    Attributes:
        names: of their channels.
        unit: of `min` and `max`, such as "rad".
        display_unit: unit in files, reports and plots, such as "deg".
        min: (outputs,) lowest values.
        max: (outputs,) highest values.
        nominal: (outputs,) typical values, as in FMI, which scale the outputs; if not given, their range does.
        rest: (outputs,) values at rest; learned from data if not given.
    """

    names: tuple[str, ...]
    unit: str
    display_unit: str = ""
    min: tuple[float, ...] | None = None
    max: tuple[float, ...] | None = None
    nominal: tuple[float, ...] | None = None
    rest: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _keep_tuples(self)
        _check_names("outputs", self.names, MOST_OUTPUTS)
        for name in self.names:
            if _TAKEN.fullmatch(name):
                raise SettingsError(
                    f"`outputs.names` holds `{name}`, the name of another channel of recordings; rename it."
                )
        quantity = _unit("outputs.unit", self.unit)
        if not self.display_unit:
            object.__setattr__(self, "display_unit", self.unit)
        if _unit("outputs.display_unit", self.display_unit) != quantity:
            raise SettingsError(f"`outputs.display_unit` cannot be {self.display_unit} where `unit` is {self.unit}.")
        _one_each("outputs", self.names, self.min, self.max, self.nominal, self.rest)
        _positive("outputs.nominal", self.nominal, self.unit)
        check_range("outputs", "min", "max", self.min, self.max)

    @property
    def shown(self) -> str:
        """In which unit tools show outputs: `display_unit`; "" for deg, which is usual for angles."""
        return "" if self.display_unit == "deg" else self.display_unit


def _keep_tuples(thing: Motors | Outputs | Directions) -> None:
    """Replace lists and arrays by tuples: what is frozen is compared and kept by its content."""
    for field in fields(thing):
        value = getattr(thing, field.name)
        if isinstance(value, list | np.ndarray):
            rows = (row.tolist() if isinstance(row, np.ndarray | np.generic) else row for row in value)
            kept = tuple(tuple(row) if isinstance(row, list) else row for row in rows)
            object.__setattr__(thing, field.name, kept)


@cache
def motor_channels(motors: tuple[str, ...], outputs: tuple[str, ...], what: str) -> tuple[str, ...]:
    """Return the channel of each motor for a quantity, such as "setpoint", "position" or "position_measured".

    `pressure` and `pressure_setpoint` have `pressure_setpoint`; `motor_1`, `setpoint`, or one whose channel would be
    another's, has `motor_setpoint_1`.
    """
    stems, found = [re.sub(r"_setpoint(?=_\d+$|$)", "", name) for name in motors], []
    for j, stem in enumerate(stems, start=1):
        other = stems.count(stem) > 1 or f"{stem}_{what.removesuffix('_measured')}" in outputs
        numbered = stem in (f"motor_{j}", "setpoint", f"setpoint_{j}") or other
        found.append(_with_number(what, j) if numbered else f"{stem}_{what}")
    return tuple(found)


def _with_number(what: str, motor: int) -> str:
    return f"motor_{what}_{motor}"


def parse_numbered(channel: str) -> tuple[str, int] | None:
    """Return quantity and motor index (from 0) of `motor_setpoint_1` and the like; None for other channels."""
    match = _NUMBERED.fullmatch(channel)
    return None if match is None else (match["what"], int(match["motor"]) - 1)


def is_set_point(channel: str) -> bool:
    """Return whether a variable has the name of a motor's set-point, of any robot."""
    return channel.startswith("motor_setpoint_") or channel.endswith("_setpoint")


def motor_positions_among(names: Collection[str]) -> tuple[str, ...]:
    """Return the names of the positions of the motors with set-points among `names`, of any robot."""
    found = []
    for j, name in enumerate(filter(is_set_point, dict.fromkeys(names)), start=1):
        with_number = _with_number("position", j)
        own = not name.startswith("motor_setpoint_") and with_number not in names
        found.append(f"{name.removesuffix('_setpoint')}_position" if own else with_number)
    return tuple(found)


def check_range(
    table: str, low: str, high: str, lowest: Sequence[float] | None, highest: Sequence[float] | None
) -> None:
    """Raise SettingsError if a lowest value is not below its highest value."""
    for a, b in zip(lowest or (), highest or (), strict=False):
        if a >= b:
            raise SettingsError(f"`{table}.{low}` must be below `{table}.{high}`; got {a:g} and {b:g}.")


def _check_names(table: str, names: Sequence[str], most: int) -> None:
    if not 1 <= len(names) <= most:
        raise SettingsError(f"`{table}.names` must hold 1 to {most} names; got {len(names)}.")
    for name in names:
        if not _NAME.fullmatch(name):
            raise SettingsError(f"`{table}.names` holds `{name}`; a name has letters, digits and _, a letter first.")
        if list(names).count(name) > 1:
            raise SettingsError(f"`{table}.names` holds `{name}` twice; names must differ.")


def _unit(key: str, unit: str) -> str:
    try:
        return to_si(unit)[1]
    except ValueError as error:
        raise SettingsError(f"`{key}`: {error}") from error


def _one_each(table: str, names: Sequence[str], *values: Sequence[float] | None) -> None:
    for value in values:
        if value is not None and len(value) != len(names):
            raise SettingsError(
                f"`{table}` gives {len(value)} values for its {len(names)} names; give one for all or one for each."
            )


def _positive(key: str, values: Sequence[float] | None, unit: str) -> None:
    if values is not None and min(values) <= 0.0:
        raise SettingsError(f"`{key}` must be positive [{unit}]; got {min(values):g}.")


KINDS = ("tendons", "identified", "matrix")
# Below this two tendons nearly coincide, and moving along the axis would need huge motor angles.
_MIN_SINGULAR_VALUE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Directions:
    """Directions in which motors move outputs: each output follows a weighted sum of the motors.

    Attributes:
        kind: "tendons" (by their angles around the axis), "matrix" (as given), "identified" (learned from data).
        angles_deg: (motors,) angles of the tendons [deg]; 0 bends pitch and 90 roll, of other names the first output
            and the second.
        matrix: (outputs, motors) weights.
        names: of the redefined inputs, one for each output and one for co-contraction; `{output}_input` if not given.
    """

    kind: str
    angles_deg: tuple[float, ...] = ()
    matrix: tuple[tuple[float, ...], ...] = ()
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _keep_tuples(self)
        require_one_of("directions.kind", self.kind, KINDS)
        for key, needed in (("angles_deg", "tendons"), ("matrix", "matrix")):
            given = bool(getattr(self, key))
            if given != (self.kind == needed):
                rule = "needs" if self.kind == needed else "takes no"
                raise SettingsError(f'`directions` of kind = "{self.kind}" {rule} `{key}`.')

    def angles_for(self, outputs: Sequence[str]) -> tuple[float, ...]:
        """Return (motors,) angles of the tendons [deg] from the direction of the first of `outputs` to the second."""
        # Files have those of pitch and roll from pitch to roll, whichever is there or first.
        turned = outputs[0] == "roll" and set(outputs) <= {"pitch", "roll"}
        return tuple(90.0 - angle for angle in self.angles_deg) if turned else self.angles_deg

    def weights(self, outputs: Sequence[str]) -> Matrix | None:
        """Return the weights (outputs, motors) of the outputs with these names; None where they are to be identified.

        Tendons: cos and sin of their angles, the paper's theta_i and phi_i (Eq. 4, 5).
        """
        if self.kind == "identified":
            return None
        if self.kind == "matrix":
            return np.array(self.matrix, dtype=np.float64)
        gamma = np.radians(self.angles_for(outputs))
        rows = np.array([np.cos(gamma), np.sin(gamma)])
        rows[np.abs(rows) < 1e-15] = 0.0
        return rows[: len(outputs)]

    def check(self, motors: int, names: Sequence[str]) -> None:
        """Raise SettingsError unless the directions have so many motors and these outputs, and span the outputs."""
        self._check_weights(motors, names)
        if self.names and len(self.names) != len(names) + 1:
            raise SettingsError(
                f"`directions.names` must name {len(names)} redefined input(s) and co-contraction; got "
                f"{len(self.names)}."
            )

    def _check_weights(self, motors: int, names: Sequence[str]) -> None:
        outputs = len(names)
        if self.kind == "identified":
            return
        if self.kind == "tendons":
            self._check_angles(motors, outputs)
        elif len(self.matrix) != outputs or any(len(row) != motors for row in self.matrix):
            got = f"{len(self.matrix)} x {'/'.join(str(n) for n in sorted({len(row) for row in self.matrix}))}"
            raise SettingsError(f"`directions.matrix` must be outputs x motors, {outputs} x {motors}; got {got}.")
        weights = self.weights(names)
        if weights is None:
            return
        if np.linalg.svd(weights, compute_uv=False)[min(outputs, motors) - 1] < _MIN_SINGULAR_VALUE or motors < outputs:
            what = f"tendons at {', '.join(f'{a:g}' for a in self.angles_deg)} deg" if self.angles_deg else "the matrix"
            raise SettingsError(
                f'`directions`: {what} cannot span {outputs} output(s); fix them, or write kind = "identified".'
            )

    def _check_angles(self, motors: int, outputs: int) -> None:
        if len(self.angles_deg) != motors:
            raise SettingsError(f"`directions.angles_deg` holds {len(self.angles_deg)} angles for {motors} motor(s).")
        if outputs > 2:
            raise SettingsError(
                f'`directions`: tendons bend 2 outputs at most, and there are {outputs}; use "identified" or "matrix".'
            )
