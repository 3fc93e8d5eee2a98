"""The robot of recordings, models and controllers, and its redefined inputs."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, Vector, read_toml, require_positive, to_si

from . import _file
from ._channels import Directions, Motors, Outputs, motor_channels, parse_numbered

# Below this share of the largest singular value the motors cannot move a direction.
_MIN_SINGULAR_RATIO = 1e-6
# Tolerance for the part of (1, .., 1) in the null space.
_NULL_SPACE_TOLERANCE = 1e-9


def redefinition_of(weights: Matrix, names: tuple[str, ...]) -> tuple[Matrix, Matrix]:
    """Return T (outputs + 1, motors) to the redefined inputs and co-contraction, and T^-1 (motors, outputs + 1).

    For the neck these are Eq. 9 to 11. In general v = W P with the weights W of the robot's directions, and the motors
    for v are those of smallest norm, W^+ v. Co-contraction moves no output: it is along the vector of W's null space
    nearest to (1, .., 1), scaled to mean 1, so that it is the mean that it adds to the motors. The other directions of
    the null space are held at zero. Without a null space the last row and column are zero.

    Args:
        weights: (outputs, motors) of the motors in each output's direction.
        names: of the outputs, for the message.

    Raises SettingsError: the motors cannot move all outputs independently.
    """
    _, s, Vh = np.linalg.svd(weights / np.linalg.norm(weights, axis=1, keepdims=True))
    outputs, motors = weights.shape
    if motors < outputs or s[outputs - 1] < _MIN_SINGULAR_RATIO * s[0]:
        raise SettingsError(
            f"{motors} motor(s) cannot move {', '.join(names)} independently; a controller needs directions that span "
            "all outputs."
        )
    ones = np.ones(motors)
    shared = Vh[outputs:].T @ (Vh[outputs:] @ ones)
    if np.linalg.norm(shared) > _NULL_SPACE_TOLERANCE * np.linalg.norm(ones):
        shared *= motors / shared.sum()
        back = shared / (shared @ shared)
    else:
        shared, back = np.zeros(motors), np.zeros(motors)
    if motors == outputs + 1 and np.abs(shared - 1.0).max() < _NULL_SPACE_TOLERANCE:
        # As in the paper, Eq. 9 to 11: exact means, and an inverse without the rounding of a decomposition.
        T = np.vstack([weights, np.full(motors, 1.0 / motors)])
        return T, np.linalg.inv(T)
    inverse = np.column_stack([np.linalg.pinv(weights), shared])
    # Rounding errors of motors that do not contribute.
    inverse[np.abs(inverse) < 1e-14 * np.abs(inverse).max(axis=0, initial=0.0)] = 0.0
    return np.vstack([weights, back]), inverse


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Robot(ReprMixin):
    """A robot with its motors, outputs, directions and properties; None if not given.

    Attributes:
        name: in messages and reports.
        motors: the 1 to 8 motors.
        outputs: the 1 to 4 measured outputs.
        directions: which motors move which outputs.
        sample_time_s: [s].
        time_constant_s: [s] of the outputs after a step of the motors, which scales time; learned from data if None.
        winch_radius_m: [m], of tendons on winches.
        noise_std: standard deviation of the sensor's noise, in the unit of the outputs.
        delay_s: of the sensor [s].
        rate_hz: samples of the sensor per second [1/s].
        neck: the virtual plant of the robot: "paper", "lab" or a neck file.
        drives: file of the drives.
        file: that it was read from; None for a preset.

    Example:
        >>> import softneck
        >>> finger = softneck.Robot.preset("finger")
        >>> finger.set_points, finger.outputs.names
        (('motor_setpoint_1',), ('pitch',))
        >>> finger.motors.unit
        'rad'
        >>> softneck.Robot.from_dict(finger.as_dict()) == finger
        True
    """

    name: str
    motors: Motors
    outputs: Outputs
    directions: Directions
    sample_time_s: float | None = None
    time_constant_s: float | None = None
    winch_radius_m: float | None = None
    noise_std: float | None = None
    delay_s: float | None = None
    rate_hz: float | None = None
    neck: str | None = None
    drives: str | None = None
    file: Path | None = field(default=None, metadata={"content": False})

    def __post_init__(self) -> None:
        if not self.name.strip() or not self.name.isprintable():
            raise SettingsError(f"`name` must be one line of text; got {self.name!r}.")
        self.directions.check(len(self.motors.names), self.outputs.names)
        units = {"sample_time_s": "s", "time_constant_s": "s", "winch_radius_m": "m", "rate_hz": "1/s"}
        for key, unit in units.items():
            if (value := getattr(self, key)) is not None:
                require_positive(key, value, unit)
        for key in ("noise_std", "delay_s"):
            if (value := getattr(self, key)) is not None and not 0.0 <= value < np.inf:
                raise SettingsError(f"`sensor.{key}` must not be negative; got {value:g}.")
        self._complete()

    def _complete(self) -> None:
        """Complete missing values from the preset `neck` if channels and directions are those of the preset."""
        if self.time_constant_s is None and self.is_neck:
            neck = Robot.preset("neck")
            object.__setattr__(self, "time_constant_s", neck.time_constant_s)
            object.__setattr__(self, "directions", neck.directions)
            object.__setattr__(self, "noise_std", neck.noise_std if self.noise_std is None else self.noise_std)
            for name in ("motors", "outputs"):
                part, own = getattr(self, name), getattr(neck, name)
                given = {key: getattr(own, key) for key in ("nominal", "rest") if getattr(part, key) is None}
                object.__setattr__(self, name, replace(part, **given))

    @classmethod
    def preset(cls, name: str = "neck") -> Robot:
        """Return a built-in robot: `neck` (the paper's), `arm`, `antagonist`, `finger` or `trunk4`.

        Raises:
            SettingsError: no such preset.
        """
        return _preset(name)

    @classmethod
    def read(cls, path: str | Path) -> Robot:
        """Read a `robot.toml`.

        Raises:
            FileFormatError: no such file, or not TOML.
            SettingsError: a wrong key or value; the message names it.
        """
        table = read_toml(path, f"`softneck robot new {path}` writes one")
        with _file.prefix_errors(path):
            return cls(**_file.fields(table), file=Path(path))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Robot:
        """Return the robot that `as_dict` wrote, or the tables of a `robot.toml`.

        Raises:
            SettingsError: a wrong key or value.
        """
        return cls(**_file.fields(content))

    def as_dict(self) -> dict[str, Any]:
        """Return the tables of its `robot.toml`, without `extends` and without values that are not given."""
        table: dict[str, Any] = {"name": self.name}
        for name in ("motors", "outputs", "directions"):
            part = getattr(self, name)
            values = {key: getattr(part, key) for key in _file.ROBOT_KEYS[name]}
            table[name] = {key: _shorten(key, value) for key, value in values.items() if value not in (None, ())}
        if set(self.motors.sign) == {1.0}:
            del table["motors"]["sign"]
        for attribute, key in _file.KEY_OF.items():
            where, _, last = key.rpartition(".")
            if (value := getattr(self, attribute)) is not None:
                (table.setdefault(where, {}) if where else table)[last] = value
        return {key: table[key] for key in ("name", "sample_time_s", *_file.ROBOT_KEYS) if key in table}

    @property
    def folder(self) -> Path | None:
        """The folder of the files that it names; None for a preset."""
        return None if self.file is None else self.file.parent

    @property
    def set_points(self) -> tuple[str, ...]:
        """The channels of the motors' set-points."""
        return self._motor_channels("setpoint")

    @property
    def motor_positions(self) -> tuple[str, ...]:
        """The channels of the motors' measured positions."""
        return self._motor_channels("position")

    @property
    def motor_velocities(self) -> tuple[str, ...]:
        """The channels of the motors' measured speeds."""
        return self._motor_channels("velocity")

    @property
    def measured_positions(self) -> tuple[str, ...]:
        """The names of a model's inputs for the motors' measured positions."""
        return self._motor_channels("position_measured")

    def own(self, channel: str) -> str:
        """Return the robot's own name of a channel: `motor_setpoint_1` is always the first motor's set-point."""
        what, motor = parse_numbered(channel) or ("", 0)
        return self._motor_channels(what)[motor] if what and motor < len(self.motors.names) else channel

    def _motor_channels(self, what: str) -> tuple[str, ...]:
        return motor_channels(self.motors.names, self.outputs.names, what)

    @property
    def hash(self) -> str:
        """SHA-256 of channels, units and directions, which give the numbers in files their meaning.

        Names of motors, limits, rates, sensor, drives and virtual plant may change without making files incompatible.
        """
        return _hash(self)

    @property
    def is_neck(self) -> bool:
        """Whether its channels and directions are those of the paper's neck."""
        return self.hash == Robot.preset("neck").hash

    def weights(self) -> Matrix | None:
        """Return the weights (outputs, motors) of the motors in each output's direction; None: to be identified."""
        return self.directions.weights(self.outputs.names)

    @property
    def input_names(self) -> tuple[str, ...]:
        """The redefined inputs, one for each output: of the neck theta_i and phi_i (Eq. 9, 10)."""
        return self.directions.names[:-1] or tuple(f"{name}_input" for name in self.outputs.names)

    @property
    def cocontraction_name(self) -> str:
        """The name of the co-contraction, which moves no output: of the neck delta_i (Eq. 11)."""
        return self.directions.names[-1] if self.directions.names else "cocontraction"

    @property
    def tendon_angles(self) -> Vector | None:
        """(motors,) angles of the tendons from the first output [rad]; None without tendons at known angles."""
        angles = self.directions.angles_for(self.outputs.names)
        return np.radians(angles) if self.directions.kind == "tendons" else None

    @property
    def shown_gain(self) -> tuple[float, str]:
        """Factor from a gain in SI to the one that people see, and its unit, such as `deg/rad`."""
        shown, motor = self.outputs.display_unit, self.motors.unit
        return to_si(motor)[0] / to_si(shown)[0], shown if motor == "1" else f"{shown}/{motor}"

    @property
    def angle_limit(self) -> float:
        """Largest angle of an output [rad]: half a turn where tendons bend the robot; what rotates has no limit."""
        return np.pi if self.tendon_angles is not None and to_si(self.outputs.unit)[1] == "rad" else np.inf

    def redefinition(self, weights: Matrix | None = None) -> tuple[Matrix, Matrix]:
        """Return T (outputs + 1, motors) to redefined inputs and co-contraction, and its inverse (motors, outputs + 1).

        Args:
            weights: (outputs, motors), if the robot does not give its own.

        Raises:
            SettingsError: directions still to be identified, or that do not span the outputs.
        """
        own = self.weights() if weights is None else weights
        if own is None:
            raise SettingsError(f"the directions of {self.label()} are to be identified; use a model of it.")
        return redefinition_of(own, self.outputs.names)

    def with_rest(self, motors: Sequence[float] | None, outputs: Sequence[float] | None) -> Robot:
        """Return the robot with `rest` of motors and outputs, each in its unit, where it gives none."""
        given = {"motors": motors, "outputs": outputs}
        new = {name: replace(getattr(self, name), rest=tuple(rest)) for name, rest in given.items()
               if rest is not None and getattr(self, name).rest is None}  # fmt: skip
        return replace(self, **new) if new else self

    def in_header(self) -> dict[str, Any]:
        """Return the robot's entry in the header of a model's file; empty for the preset `neck`."""
        table = self.as_dict()
        return {} if table == Robot.preset("neck").as_dict() else {"robot": table}

    def require(self, key: str, what: str) -> Any:
        """Return the value of an attribute; the error names the caller, such as "softneck record".

        Raises:
            SettingsError: the robot does not give it.
        """
        value = getattr(self, key)
        if value is None:
            raise self.error_without([f"`{_file.KEY_OF[key]}`"], f"{what} needs")
        return value

    def error_without(self, keys: Sequence[str], why: str) -> SettingsError:
        """Return the error about keys that the robot does not give; `why` says what needs them."""
        them = "it" if len(keys) == 1 and " and " not in keys[0] else "them"
        where = "" if self.file is not None else " to its robot file, and name that by `--robot FILE`"
        return SettingsError(f"robot {self.label()} gives no {', and no '.join(keys)}, which {why}; add {them}{where}.")

    def label(self) -> str:
        """Return name, short hash and file, to identify a robot in messages."""
        origin = "" if self.file is None else f", from {_file.shortest_path(self.file)}"
        return f"`{self.name}` ({self.hash[:8]}{origin})"

    def summary(self) -> str:
        """Return a few lines on the robot."""
        motors, outputs, angles = self.motors, self.outputs, self.directions.angles_deg
        set_points = _range_text(motors.setpoint_min, motors.setpoint_max, motors.unit)
        lines = [
            f"{self.name}: {len(motors.names)} motor(s) [{motors.unit}], {len(outputs.names)} output(s)",
            f"motors: {', '.join(motors.names)}; set-points {set_points}",
            f"outputs: {', '.join(outputs.names)} [{outputs.display_unit}]; "
            + _range_text(outputs.min, outputs.max, outputs.unit),
            f"directions: {self.directions.kind}"
            + (f" at {', '.join(f'{a:g}' for a in angles)} deg" if angles else ""),
        ]
        values = {key: getattr(self, name) for name, key in _file.KEY_OF.items()}
        given = [f"{key} = {value}" for key, value in values.items() if value is not None]
        absent = [key for key, value in values.items() if value is None and key not in _file.OPTIONAL_KEYS]
        lines += [f"given: {', '.join(given)}"] if given else []
        lines += [f"not given: {', '.join(absent)}"] if absent else []
        return "\n".join(lines)


@cache
def _hash(robot: Robot) -> str:
    table = robot.as_dict()
    outputs = {key: table["outputs"][key] for key in ("names", "unit", "display_unit")}
    directions = {key: value for key, value in table["directions"].items() if key != "names"}
    content = [len(robot.motors.names), robot.motors.unit, outputs, directions]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@cache
def _preset(name: str) -> Robot:
    return Robot(**_file.fields(tomllib.loads(_file.preset_text(name))))


def _shorten(key: str, value: Any) -> Any:
    """Return a value as in a file: one number if all are equal."""
    if isinstance(value, tuple):
        if key in ("names", "angles_deg", "matrix"):
            return [list(item) if isinstance(item, tuple) else item for item in value]
        return value[0] if len(set(value)) == 1 else list(value)
    return value


def _range_text(low: tuple[float, ...] | None, high: tuple[float, ...] | None, unit: str) -> str:
    if low is None and high is None:
        return "no range given"
    a = "-inf" if low is None else f"{min(low):g}"
    b = "inf" if high is None else f"{max(high):g}"
    return f"{a} to {b} {unit}"
