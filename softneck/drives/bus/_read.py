"""`drives.toml`, read strictly."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softneck.core import DataError, FileFormatError, SettingsError, read_toml, refuse_unknown
from softneck.robot import Robot
from softneck.signals import NECK

from ..master._settings import LimitSettings, RampSettings, WatchSettings, factor_of
from ..supervision._baseline import load_baseline
from ._file import PROFILES, DriveEntry, DrivesFile, Guarding, Neck, ZeroSettings
from ._robot import count_word, require_table, robot_of
from ._sensor_source import SOURCE_KEYS, make_source
from ._units import DriveScale


def load_drives(path: str | Path, robot: str | Path | Robot | None = None) -> DrivesFile:
    """Read a drives file.

    Args:
        path: of the file.
        robot: what the drives move: a preset, a robot file or a robot; None: `robot.toml` beside the drives file or
            above it, else the neck.

    Raises:
        FileFormatError: no such file or no TOML.
        SettingsError: an unknown or missing key, a value that does not fit, or a robot with other motors, signs or
            winches; the line names table and key.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        return make_drives(table, source.parent, robot_of(robot, source))
    except (SettingsError, DataError, FileFormatError) as error:
        raise type(error)(f"{source}: {error}") from error


_CLASSES: dict[str, type] = {
    "guarding": Guarding, "zero": ZeroSettings, "neck": Neck, "limits": LimitSettings,
    "watch": WatchSettings, "ramp": RampSettings,
}  # fmt: skip
_FIELDS = {"ramp": "ramps"}
# Table -> key in the file -> (field, factor to SI; 0 of what is no number that may have a fraction).
_KEYS: dict[str, dict[str, tuple[str, float]]] = {
    "sensor": {"angle_deg": ("sensor_angle", math.radians(1.0))},
    "bus": {"period_s": ("cycle", 1.0), "bit_rate": ("bit_rate", 0.0)},
    "quick": {"quick_stop_rad_s2": ("quick_stop", 1.0), "following_rad": ("following", 1.0)},
    "scale": {
        "peak_current_A": ("peak_current", 1.0), "gear": ("gear", 1.0), "encoder_counts": ("counts_per_turn", 1.0),
        "slow_loop_s": ("slow_loop", 1.0), "reversed": ("reversed", 0.0),
    },
    "drive": {
        "node": ("node", 0.0), "current_limit_A": ("current_limit", 1.0), "vendor": ("vendor", 0.0),
        "product": ("product", 0.0), "serial": ("serial", 0.0), "firmware": ("firmware", 0.0),
    },
    **{
        name: {
            item.metadata["key"]: (item.name, factor_of(item.metadata["key"]) if "range" in item.metadata else 0.0)
            for item in dataclasses.fields(kind) if "key" in item.metadata
        }
        for name, kind in _CLASSES.items()
    },
}  # fmt: skip
_TOP_KEYS = ("profile", "bus", "guarding", "drive", "limits", "stop", "sensor", "watch", "zero", "ramp", "neck",
        "supervision")  # fmt: skip
# Table -> keys that files have had and nobody set -> what they are now, always.
_GONE: dict[str, dict[str, float]] = {
    "zero": {"still_rad_s": 0.2, "still_s": 0.3, "timeout_s": 10.0},
    "limits": {"persistent_s": 0.3},
    "sensor": {"dropout_s": 0.08, "frozen_samples": 20, "bad_samples": 3, "rate_deg_s": 458.4, "margin_deg": 3.0},
    "ramp": {"enable_timeout_s": 1.0, "timeout_s": 30.0},
    "stop": {"following_s": 0.2},
}


def make_drives(table: Mapping[str, Any], folder: Path = Path(), robot: Robot | None = None) -> DrivesFile:
    """Return the drives file of a table for `robot`; `folder` holds the files that it names."""
    table = require_table(table, robot)
    refuse_unknown("the file", table, _TOP_KEYS)
    if "profile" not in table:
        raise SettingsError(f"`profile` is missing; it is one of {', '.join(PROFILES)}.")
    entries, motors = table.get("drive"), len((robot or NECK).motors.names)
    if not isinstance(entries, list) or len(entries) != motors:
        count = len(entries) if isinstance(entries, list) else 0
        whose = "" if robot is None else f" for robot {robot.label()}"
        what = "tables are needed" if motors > 1 else "table is needed"
        raise SettingsError(
            f"{count_word(motors)} [[drive]] {what}{whose}, motors 1 to {motors} in this order; there are {count}."
        )
    drives = tuple(_drive(number, entry) for number, entry in enumerate(entries, start=1))
    values: dict[str, Any] = {"profile": table["profile"], "drives": drives, "robot": robot}
    for name, setting in _CLASSES.items():
        if name not in table:
            continue
        values[_FIELDS.get(name, name)] = _build(f"[{name}]", setting, name, _table(name, table[name]))
    if "sensor" in table:
        values |= _sensor(dict(_table("sensor", table["sensor"])), folder)
    values |= _values("[bus]", "bus", _table("bus", table.get("bus", {})))
    values |= _values("[stop]", "quick", _table("stop", table.get("stop", {})))
    if "supervision" in table:
        content = _table("supervision", table["supervision"])
        refuse_unknown("[supervision]", content, ("baseline",))
        if not isinstance(content.get("baseline"), str):
            raise SettingsError(
                "[supervision] `baseline` must name the file that `softneck.drives.baseline(...).save` wrote."
            )
        values["baseline"] = load_baseline(folder / content["baseline"])
    return DrivesFile(**values)


def _sensor(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    values = {f"sensor_{key}": content.pop(key) for key in ("kind", "node") if key in content}
    if "axes" in content:
        values["sensor_axes"] = _texts("[sensor] axes", content.pop("axes"))
    kind, own = values.get("sensor_kind", "simulated"), [key for key in content if key in SOURCE_KEYS]
    values["sensor_source"] = make_source(kind, {key: content.pop(key) for key in own}, folder)
    return values | _values("[sensor]", "sensor", content)


def _drive(number: int, entry: Any) -> DriveEntry:
    where = f"[[drive]] {number}"
    content = dict(_table(where, entry))
    known = {**_KEYS["scale"], **_KEYS["drive"]}
    refuse_unknown(where, content, tuple(known))
    for key in ("node", "peak_current_A"):
        if key not in content:
            raise SettingsError(f"{where}: `{key}` is missing.")
    scale = {key: value for key, value in content.items() if key in _KEYS["scale"]}
    rest = {key: value for key, value in content.items() if key in _KEYS["drive"]}
    try:
        made = _build(where, DriveScale, "scale", scale)
        return DriveEntry(scale=made, **_values(where, "drive", rest))
    except (SettingsError, DataError) as error:
        text = str(error)
        raise SettingsError(text if text.startswith(where) else f"{where}: {text}") from error


def _build(where: str, setting: type, name: str, content: Mapping[str, Any]) -> Any:
    try:
        return setting(**_values(where, name, content))
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def _values(where: str, name: str, content: Mapping[str, Any]) -> dict[str, Any]:
    keys = _KEYS[name]
    refuse_unknown(where, content, tuple(keys))
    return {keys[key][0]: _value(f"{where} {key}", value, keys[key][1]) for key, value in content.items()}


_INTEGER_KEYS = ("node", "vendor", "product", "serial", "bit_rate")


def _value(where: str, value: Any, factor: float) -> Any:
    key = where.rpartition(" ")[2]
    if factor == 0.0:
        wanted: type = bool if key == "reversed" else int if key in _INTEGER_KEYS else str
        if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
            words = {bool: "true or false", int: "a whole number", str: "a text"}
            raise SettingsError(f"{where} must be {words[wanted]}; got {value!r}.")
        return value
    # Whole numbers may be larger than any float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise SettingsError(f"{where} must be a number; got {str(value)[:20]}.")
    return factor * value


def _texts(where: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise SettingsError(f"{where} must be a list of texts; got {value!r}.")
    return tuple(value)


def _table(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise SettingsError(f"`{name}` must be a table.")
    for key, constant in _GONE.get(name, {}).items():
        if key in value and not (
            isinstance(value[key], int | float) and math.isclose(value[key], constant, rel_tol=1e-3)
        ):
            raise SettingsError(f"[{name}] {key} is no setting any more, but always {constant:g}; leave it out.")
    return {key: setting for key, setting in value.items() if key not in _GONE.get(name, {})}


def drives_table(file: DrivesFile) -> dict[str, Any]:
    """Return the keys and values that `make_drives` reads `file` from; all of them, with paths made absolute."""
    table: dict[str, Any] = {"profile": file.profile}
    table["bus"] = _said_values(file, "bus")
    table["stop"] = _said_values(file, "quick")
    table["drive"] = [_said_values(entry, "drive") | _said_values(entry.scale, "scale") for entry in file.drives]
    for name in _CLASSES:
        table[name] = _said_values(getattr(file, _FIELDS.get(name, name)), name)
    own = _said_values(file, "sensor")
    table["sensor"] = {"kind": file.sensor_kind, "node": file.sensor_node, **_source(file), **own}
    if file.sensor_axes:
        table["sensor"]["axes"] = list(file.sensor_axes)
    return table


def _said_values(settings: Any, name: str) -> dict[str, Any]:
    found = {key: getattr(settings, field) for key, (field, _) in _KEYS[name].items()}
    factors = {key: factor for key, (_, factor) in _KEYS[name].items()}
    return {key: _plain(value, factors[key]) for key, value in found.items() if value is not None}


def _plain(value: Any, factor: float) -> Any:
    """Return a value in the file's unit, with as few digits as read back as the same."""
    if factor in (0.0, 1.0) or not math.isfinite(value):
        return value
    shorter = (float(f"{value / factor:.{digits}g}") for digits in range(3, 17))
    return next((short for short in shorter if factor * short == value), value / factor)


def _source(file: DrivesFile) -> dict[str, Any]:
    source, nothing = file.sensor_source, type(file.sensor_source)()
    known = {field.name for field in dataclasses.fields(source)}
    values = {key: getattr(source, name) for key, (name, _) in SOURCE_KEYS.items() if name in known}
    told = {key: value for key, value in values.items() if value != getattr(nothing, SOURCE_KEYS[key][0])}
    return {key: dict(value) if key == "options" else value for key, value in told.items()}
