"""Faults of a loop: their kinds, start and duration, and the keys of a loop file that describe them.

They act on signals between the parts and so work on any plant; disturbances inside the neck use its inputs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

from softneck.core import (
    DataError,
    SettingsError,
    require_between,
    require_finite,
    require_one_of,
    require_positive,
    require_whole,
    to_si,
)
from softneck.robot import Robot

SENSOR_FAULTS = ("dropout", "freeze", "bias", "outlier", "delay", "noise")
MOTOR_FAULTS = ("stuck", "slow", "offset")
_NECK = Robot.preset("neck")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFault:
    """A fault of the measured outputs between plant and observer or controller; the true outputs do not change.

    Attributes:
        kind: "dropout" (no value, `measurement_valid` false), "freeze" (the last value before it), "bias"
            (plus `size`), "outlier" (plus or minus `size` in a `share` of the samples), "delay" (older by
            `delay`), "noise" (plus white noise of standard deviation `std`).
        start: [s]; duration: [s], infinity for the rest of the run.
        axis: one of the robot's outputs, such as "pitch"; "both" means all of them.
        signals: other outputs of the plant instead, such as ("pitch_rate_measured",).
        size, std: in SI.
        share: of the samples, 0 to 1.
        delay: [s], a multiple of the loop's step.
        seed: of "outlier" and "noise".
    """

    kind: str
    start: float = 0.0
    duration: float = math.inf
    axis: str = "both"
    signals: tuple[str, ...] = ()
    size: float = 0.0
    std: float = 0.0
    share: float = 0.1
    delay: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, SENSOR_FAULTS)
        _check_window(self.start, self.duration)
        require_finite("size", self.size, "rad")
        if not 0.0 < self.share <= 1.0:
            raise SettingsError(f"`share` must be above 0 and at most 1; got {self.share:g}.")
        require_whole("seed", self.seed, 0, 2**31 - 1)
        if self.kind in ("bias", "outlier") and self.size == 0.0:
            raise SettingsError(f"`size` of a sensor {self.kind} must not be zero.")
        if self.kind == "noise":
            require_positive("std", self.std, "rad")
        if self.kind == "delay":
            require_positive("delay", self.delay, "s")


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorFault:
    """A fault of a motor that changes how it follows its set-point.

    Attributes:
        kind: "stuck" (stays at its last set-point), "slow" (moves at `rate` at most), "offset" (plus `size`).
        start: [s]; duration: [s], infinity for the rest of the run.
        motor: from 1 on; 0 means all.
        rate: [rad/s].
        size: [rad].
        robot: of the motor; rate and size of other robots than the neck are in the SI unit of their motors.
    """

    kind: str
    start: float = 0.0
    duration: float = math.inf
    motor: int = 1
    rate: float = 0.0
    size: float = 0.0
    robot: Robot = _NECK

    def __post_init__(self) -> None:
        require_one_of("kind", self.kind, MOTOR_FAULTS)
        _check_window(self.start, self.duration)
        require_whole("motor", self.motor, 0, len(self.robot.motors.names))
        require_finite("size", self.size)
        motors, (factor, unit) = self.robot.motors, to_si(self.robot.motors.unit)
        if motors.setpoint_min is not None and motors.setpoint_max is not None:
            most = factor * max(map(abs, (*motors.setpoint_min, *motors.setpoint_max)))
            require_between("size", self.size, -most, most, unit)
        if self.kind == "slow":
            require_positive("rate", self.rate, "rad/s")
        if self.kind == "offset" and self.size == 0.0:
            raise SettingsError("`size` of a motor offset must not be zero.")


@dataclass(frozen=True, slots=True, kw_only=True)
class NeckFault:
    """A disturbance inside the neck: `values` are added to the plant's inputs of those names.

    Attributes:
        values: input -> added value: {"payload": 0.5} [kg], {"push_x": 5.0} [N], {"base_tilt_pitch": 0.1} [rad].
        start: [s]; duration: [s], infinity for the rest of the run.
    """

    values: Mapping[str, float]
    start: float = 0.0
    duration: float = math.inf

    def __post_init__(self) -> None:
        _check_window(self.start, self.duration)
        if not any(self.values.values()):
            raise SettingsError("a disturbance needs a value other than zero.")
        for name, value in self.values.items():
            require_finite(name, value, "SI")


#: Any fault of a loop.
Fault = SensorFault | MotorFault | NeckFault

# kind in a loop file -> (class, its `kind`, the keys that it takes without their unit).
_SENSOR_KEYS = ("axis", "signals")
_FILE_KINDS: dict[str, tuple[type, str, tuple[str, ...]]] = {
    "sensor_dropout": (SensorFault, "dropout", _SENSOR_KEYS),
    "sensor_freeze": (SensorFault, "freeze", _SENSOR_KEYS),
    "sensor_bias": (SensorFault, "bias", (*_SENSOR_KEYS, "size")),
    "sensor_outlier": (SensorFault, "outlier", (*_SENSOR_KEYS, "size", "share", "seed")),
    "sensor_delay": (SensorFault, "delay", (*_SENSOR_KEYS, "delay")),
    "measurement_noise": (SensorFault, "noise", (*_SENSOR_KEYS, "std", "seed")),
    "motor_stuck": (MotorFault, "stuck", ("motor",)),
    "motor_slow": (MotorFault, "slow", ("motor", "rate")),
    "motor_offset": (MotorFault, "offset", ("motor", "size")),
    "payload_step": (NeckFault, "", ("payload",)),
    "push": (NeckFault, "push_", ("x", "y")),
    "base_tilt": (NeckFault, "base_tilt_", ("pitch", "roll")),
}
FAULT_KINDS = tuple(_FILE_KINDS)


def make_fault(kind: str, values: Mapping[str, object], robot: Robot = _NECK) -> Fault:
    """Return a fault from the keys of a loop file, which end in their unit: `start_s`, `size_deg`, `payload_kg`."""
    if kind not in _FILE_KINDS:
        raise SettingsError(f"unknown kind of fault `{kind}`; use one of {', '.join(FAULT_KINDS)}.")
    made, what, known = _FILE_KINDS[kind]
    chosen: dict[str, object] = {}
    for key, value in values.items():
        name, factor = _split(key)
        if name not in (*known, "start", "duration"):
            raise SettingsError(f"unknown key `{key}` of a {kind}; it takes start_s, duration_s, {', '.join(known)}.")
        chosen[name] = _value(key, name, value, factor)
    window = {name: chosen.pop(name) for name in ("start", "duration") if name in chosen}
    try:
        if made is NeckFault:
            return NeckFault(values={what + name: value for name, value in chosen.items()}, **window)  # pyright: ignore[reportArgumentType]
        require_one_of("axis", chosen.get("axis", "both"), (*robot.outputs.names, "both"))
        if made is MotorFault:
            chosen["robot"] = robot
        return made(kind=what, **chosen, **window)  # pyright: ignore[reportArgumentType]
    except SettingsError as error:
        raise SettingsError(f"{kind}: {error}") from error


def fault_field(kind: str, key: str) -> str | None:
    """Return the attribute that a key such as `size_deg` sets in a fault of `kind`; None for an unknown key."""
    name = _split(key)[0]
    return name if kind in _FILE_KINDS and name in (*_FILE_KINDS[kind][2], "start", "duration") else None


def fault_keys(fault: Fault) -> dict[str, object]:
    """Return the keys of a loop file that describe `fault`, all in SI."""
    prefix = ""
    if isinstance(fault, NeckFault):
        kind = next(
            (k for k, (made, p, known) in _FILE_KINDS.items() if made is NeckFault and _covers(p, known, fault)), ""
        )
        prefix = _FILE_KINDS[kind][1] if kind else ""
        values: dict[str, object] = {name.removeprefix(prefix): value for name, value in fault.values.items()}
    else:
        kind = next(k for k, (made, what, _) in _FILE_KINDS.items() if isinstance(fault, made) and what == fault.kind)
        values = {name: getattr(fault, name) for name in _FILE_KINDS[kind][2]}
    if not kind:
        raise SettingsError(f"a loop file cannot hold the {fault_label(fault)}; split it into several faults.")
    values = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items() if value != ()}
    times = {"start": fault.start, "duration": fault.duration}
    return {"kind": kind, **values, **{name: time for name, time in times.items() if math.isfinite(time)}}


def _covers(prefix: str, known: tuple[str, ...], fault: NeckFault) -> bool:
    return all(name.startswith(prefix) and name.removeprefix(prefix) in known for name in fault.values)


def fault_label(fault: Fault) -> str:
    """Return the name of a fault for messages."""
    if isinstance(fault, NeckFault):
        return f"disturbance of {', '.join(fault.values)}"
    return f"{'sensor' if isinstance(fault, SensorFault) else 'motor'} {fault.kind}"


def _value(key: str, name: str, value: object, factor: float) -> object:
    if name == "signals":
        if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
            raise SettingsError(f"`{key}` must be a list of names; got {value!r}.")
        return tuple(value)
    if name == "axis":
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"`{key}` must be a number; got {value!r}.")
    return value if name in ("motor", "seed") else factor * float(value)


def _split(key: str) -> tuple[str, float]:
    """Return the name and the factor to SI of a key such as `size_deg` or `rate_deg_s`."""
    plain = {item.name for item in (*fields(SensorFault), *fields(MotorFault))} | {"x", "y", "pitch", "roll", "payload"}
    for parts in (2, 1):
        name, unit = "_".join(key.split("_")[:-parts]), "_".join(key.split("_")[-parts:])
        if name not in plain:
            continue
        try:
            return name, to_si("N" if unit == "n" else unit.replace("_", "/"))[0]
        except DataError:
            continue
    return key, 1.0


def _check_window(start: float, duration: float) -> None:
    require_finite("start", start, "s")
    if start < 0.0:
        raise SettingsError(f"`start` must not be negative [s]; got {start:g}.")
    if not duration > 0.0:
        raise SettingsError(f"`duration` must be positive [s]; got {duration:g}.")
