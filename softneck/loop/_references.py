"""References: what pitch, roll and co-contraction are to be at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    SettingsError,
    Vector,
    require_between,
    require_finite,
    require_one_of,
    require_positive,
    to_si,
)
from softneck.core._shown import Shown

from ._reference_runtime import reference_ramp, reference_rotation, reference_row, reference_sine, reference_step

Triple = tuple[float, float, float]
# The neck bends by at most 40 deg = 0.7 rad (paper, section 5); more is a value in degrees.
_MAX_ANGLE = 0.8


class Reference(Protocol):
    """Anything that returns pitch [rad], roll [rad] and co-contraction delta_i [rad] at `time` [s].

    Of another robot all outputs, then co-contraction.
    """

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReference:
    """All three jump from zero at `at`.

    Attributes:
        pitch, roll: [rad].
        cocontraction: delta_i [rad].
        at: [s].
    """

    pitch: float = 0.0
    roll: float = 0.0
    cocontraction: float = 0.0
    at: float = 0.0

    def __post_init__(self) -> None:
        _check_angles(self.pitch, self.roll, self.cocontraction)
        require_finite("at", self.at, "s")

    def __call__(self, time: float, /) -> Triple:
        """Return the reference at `time`."""
        return reference_step(time, self.pitch, self.roll, self.cocontraction, self.at)


@dataclass(frozen=True, slots=True, kw_only=True)
class RampReference:
    """All three rise linearly from zero over `rise`, from `at` on.

    Attributes:
        pitch, roll: end values [rad].
        cocontraction: end value [rad].
        at: [s].
        rise: [s].
    """

    pitch: float = 0.0
    roll: float = 0.0
    cocontraction: float = 0.0
    at: float = 0.0
    rise: float = 1.0

    def __post_init__(self) -> None:
        _check_angles(self.pitch, self.roll, self.cocontraction)
        require_finite("at", self.at, "s")
        require_positive("rise", self.rise, "s")

    def __call__(self, time: float, /) -> Triple:
        """Return the reference at `time`."""
        return reference_ramp(time, self.pitch, self.roll, self.cocontraction, self.at, self.rise)


@dataclass(frozen=True, slots=True, kw_only=True)
class SineReference:
    """Pitch and roll swing in phase from `at` on; co-contraction is constant.

    Attributes:
        pitch, roll: amplitudes [rad].
        cocontraction: delta_i [rad].
        frequency: [Hz].
        at: [s].
    """

    pitch: float = 0.0
    roll: float = 0.0
    cocontraction: float = 0.0
    frequency: float = 0.2
    at: float = 0.0

    def __post_init__(self) -> None:
        _check_angles(self.pitch, self.roll, self.cocontraction)
        require_positive("frequency", self.frequency, "Hz")
        require_finite("at", self.at, "s")

    def __call__(self, time: float, /) -> Triple:
        """Return the reference at `time`."""
        return reference_sine(time, self.pitch, self.roll, self.cocontraction, self.frequency, self.at)


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationReference:
    """The tilt goes around: pitch = A cos(w t), roll = A sin(w t), A rising from zero over `rise`.

    Attributes:
        inclination: A [rad].
        cocontraction: delta_i [rad].
        frequency: turns a second [Hz].
        at: [s].
        rise: [s].
    """

    inclination: float = 0.0
    cocontraction: float = 0.0
    frequency: float = 0.2
    at: float = 0.0
    rise: float = 3.0

    def __post_init__(self) -> None:
        _check_angles(self.inclination, 0.0, self.cocontraction)
        require_positive("frequency", self.frequency, "Hz")
        require_finite("at", self.at, "s")
        require_positive("rise", self.rise, "s")

    def __call__(self, time: float, /) -> Triple:
        """Return the reference at `time`."""
        return reference_rotation(
            time, self.inclination, self.cocontraction, self.frequency, self.at, self.rise
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RecordingReference(Shown):
    """Recorded outputs of any robot, each row held until the next; the last one is held to the end.

    Attributes:
        table: (rows, outputs + 2) time [s], rising; outputs, of a neck pitch and roll [rad]; co-contraction.
    """

    table: Matrix

    def __post_init__(self) -> None:
        table = self.table
        if table.ndim != 2 or table.shape[1] < 3:
            raise DataError(f"a recorded reference is a table (rows, outputs + 2); got the shape {table.shape}.")
        if not len(table) or not np.isfinite(table).all() or np.any(np.diff(table[:, 0]) <= 0.0):
            raise DataError("a recorded reference must be finite with rising time; mend the recording.")

    @classmethod
    def of(cls, time: Vector, channels: Mapping[str, Vector], names: Sequence[str]) -> RecordingReference:
        """Return the reference that a recording holds: the references of the outputs `names`, or else they."""
        columns = [channels.get(f"{name}_reference", channels[name]) for name in names]
        common = channels.get("cocontraction_reference", np.zeros(time.size))
        return cls(np.column_stack([time, *columns, common]))

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time` [s]: all outputs, then co-contraction."""
        # The search only comes near, in few steps; the row itself is the runtime's to say.
        near = max(0, int(np.searchsorted(self.table[:, 0], time, side="right")) - 1)
        return tuple(self.table[reference_row(time, self.table, near), 1:].tolist())


_Setting = type[StepReference] | type[RampReference] | type[SineReference] | type[RotationReference]
_KINDS: dict[str, _Setting] = {
    "step": StepReference,
    "ramp": RampReference,
    "sine": SineReference,
    "rotation": RotationReference,
}

_ENDINGS = {
    "pitch": "_rad", "roll": "_rad", "inclination": "_rad", "cocontraction": "_rad", "frequency": "_hz", "at": "_s",
    "rise": "_s",
}  # fmt: skip


def make_reference(kind: str, values: Mapping[str, float]) -> Reference:
    """Return a reference from the keys of a loop file, which end in their unit: `pitch_deg`, `at_s`.

    The kinds are step, ramp, sine and rotation; a recorded one is made of its arrays by `RecordingReference`.

    Raises:
        SettingsError: unknown kind or key, or a value out of range.
    """
    require_one_of("kind", kind, tuple(_KINDS))
    setting = _KINDS[kind]
    names = [item.name for item in fields(setting)]
    chosen: dict[str, float] = {}
    for key, value in values.items():
        name, factor = _split(key)
        if name not in names:
            raise SettingsError(f"unknown key `{key}` of a {kind} reference; it takes {', '.join(names)} with a unit.")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingsError(f"`{key}` must be a number; got {value!r}.")
        chosen[name] = factor * value
    return setting(**chosen)


def reference_field(kind: str, key: str) -> str | None:
    """Return the field that a key of a loop file such as `pitch_deg` sets in a reference of `kind`, if there is one."""
    setting = _KINDS.get(kind)
    name = _split(key)[0]
    return name if setting is not None and name in {item.name for item in fields(setting)} else None


def reference_keys(reference: Reference) -> dict[str, float | str] | None:
    """Return the keys of a loop file that describe `reference`; None if it is not a step, ramp, sine or rotation."""
    for kind, setting in _KINDS.items():
        if isinstance(reference, setting):
            named = {f"{item.name}{_ENDINGS[item.name]}": getattr(reference, item.name) for item in fields(setting)}
            return {"kind": kind, **named}
    return None


def _split(key: str) -> tuple[str, float]:
    """Return the field's name and the factor to SI of `key`, such as `pitch_deg`."""
    name, _, unit = key.rpartition("_")
    if unit == "hz":
        return name, 1.0
    if unit in ("deg", "rad", "s", "ms"):
        return name, to_si(unit)[0]
    return key, 1.0


def _check_angles(pitch: float, roll: float, cocontraction: float) -> None:
    for name, value in (("pitch", pitch), ("roll", roll)):
        require_finite(name, value, "rad")
        if abs(value) > _MAX_ANGLE:
            raise SettingsError(f"`{name}` must be within +-{_MAX_ANGLE} rad; got {value:g}: degrees?")
    require_between("cocontraction", cocontraction, -6.0, 6.0, "rad")
