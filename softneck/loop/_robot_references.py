"""References of other robots than the neck: one value for each output, and co-contraction behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import (
    SettingsError,
    SoftneckError,
    require_finite,
    require_one_of,
    require_positive,
    to_si,
)
from softneck.robot import Robot

from ._reference_runtime import reference_ramp, reference_rotation, reference_sine, reference_step

# Kind -> what else than values it takes, with where it begins without being told.
_TIMES: dict[str, dict[str, float]] = {
    "step": {"at": 0.0},
    "ramp": {"at": 0.0, "rise": 1.0},
    "sine": {"at": 0.0, "frequency": 0.2},
    "rotation": {"at": 0.0, "rise": 3.0, "frequency": 0.2},
}
_SECONDS = {"at_s": ("at", 1.0), "at_ms": ("at", 1e-3), "rise_s": ("rise", 1.0), "rise_ms": ("rise", 1e-3)}


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotReference:
    """A step, ramp, sine or rotation; shapes and times as of the neck's references.

    Attributes:
        kind: "step", "ramp", "sine" or "rotation".
        values: (outputs,) end values or amplitudes; of a rotation its inclination, for both outputs.
        cocontraction: wanted mean of the motors.
        at, rise: [s].
        frequency: [Hz].
    """

    kind: str
    values: tuple[float, ...]
    cocontraction: float = 0.0
    at: float = 0.0
    rise: float = 1.0
    frequency: float = 0.2

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, tuple(_TIMES))
        require_finite("at", self.at, "s")
        require_positive("rise", self.rise, "s")
        require_positive("frequency", self.frequency, "Hz")

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time` [s]: all outputs, then co-contraction."""
        if self.kind == "rotation":
            return reference_rotation(
                time, self.values[0], self.cocontraction, self.frequency, self.at, self.rise
            )  # fmt: skip
        if self.kind == "sine":
            share = reference_sine(time, 1.0, 0.0, 0.0, self.frequency, self.at)[0]
            return (*(value * share for value in self.values), self.cocontraction)
        if self.kind == "ramp":
            share = reference_ramp(time, 1.0, 0.0, 0.0, self.at, self.rise)[0]
        else:
            share = reference_step(time, 1.0, 0.0, 0.0, self.at)[0]
        return tuple(value * share for value in (*self.values, self.cocontraction))


def robot_reference(kind: str, values: Mapping[str, object], robot: Robot) -> RobotReference:
    """Return a reference from the keys of a loop file: `x = 10` in the display unit, `x_mm = 10`, `at_s`.

    Raises:
        SettingsError: unknown kind or key, a value beyond what the output may be, or a rotation of no two angles.
    """
    require_one_of("kind", kind, tuple(_TIMES))
    names, times = robot.outputs.names, dict(_TIMES[kind])
    wanted = dict.fromkeys((*names, "cocontraction"), 0.0)
    if kind == "rotation":
        if len(names) != 2 or to_si(robot.outputs.unit)[1] != "rad":
            raise SettingsError(f'kind = "rotation" is for two angles; {robot.label()} has {", ".join(names)}.')
        wanted = {"inclination": 0.0, "cocontraction": 0.0}
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SettingsError(f"`{key}` must be a number; got {value!r}.")
        name, factor = reference_key(kind, key, robot)
        if name in times:
            times[name] = factor * value
        else:
            wanted[name] = _within(key, name, factor * value, robot)
    common = wanted.pop("cocontraction")
    return RobotReference(kind=kind, values=tuple(wanted.values()), cocontraction=common, **times)


def reference_key(kind: str, key: str, robot: Robot) -> tuple[str, float]:
    """Return what a key such as `x_mm` or `at_s` sets in a reference of `kind`, and its factor to SI.

    Raises:
        SettingsError: nothing.
    """
    outputs = ("inclination",) if kind == "rotation" else robot.outputs.names
    units = {**dict.fromkeys(outputs, robot.outputs.display_unit), "cocontraction": robot.motors.unit}
    if key in units:
        return key, to_si(units[key])[0]
    name, _, unit = key.rpartition("_")
    if name in units:
        try:
            factor, si = to_si(unit)
        except SoftneckError:
            factor, si = 1.0, ""
        if si == to_si(units[name])[1]:
            return name, factor
    found, factor = _SECONDS.get(key, ("frequency" if key == "frequency_hz" else "", 1.0))
    if found in _TIMES[kind]:
        return found, factor
    raise SettingsError(
        f"unknown key `{key}` of a {kind} reference; it takes {', '.join((*units, *_TIMES[kind]))} with a unit."
    )


def _within(key: str, name: str, value: float, robot: Robot) -> float:
    """Return `value` (SI) if the output may be so far; raise SettingsError with its range if not."""
    require_finite(key, value, "SI")
    outputs, factor = robot.outputs, to_si(robot.outputs.unit)[0]
    low, high = -np.inf, np.inf
    if name in outputs.names:
        at = outputs.names.index(name)
        low = -np.inf if outputs.min is None else outputs.min[at]
        high = np.inf if outputs.max is None else outputs.max[at]
    elif name == "inclination":
        high = min(outputs.max or (np.inf,))
    if not low * factor <= value <= high * factor:
        raise SettingsError(
            f"`{key}` is beyond what {robot.label()} may do: {low:g} to {high:g} {outputs.unit}; "
            f"got {value / factor:g}."
        )
    return value
