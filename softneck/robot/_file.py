"""`robot.toml`: its tables and keys, inheritance by `extends`, and presets."""

from __future__ import annotations

import contextlib
import math
import os
import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, SoftneckError, did_you_mean, require_one_of

from ._channels import Directions, Motors, Outputs

ROBOT_PRESETS = ("neck", "arm", "antagonist", "finger", "trunk4")
#: Table -> its keys and their types; "" is the top of the file. "each" is one number for all channels, or a list of one
# for each channel.
ROBOT_KEYS: dict[str, dict[str, str]] = {
    "": {"name": "text", "extends": "text", "sample_time_s": "number", "time_constant_s": "number"},
    "motors": {"names": "texts", "unit": "text", "setpoint_min": "each", "setpoint_max": "each", "rate_limit": "each",
               "sign": "each", "nominal": "each", "rest": "each"},
    "outputs": {"names": "texts", "unit": "text", "display_unit": "text", "min": "each", "max": "each",
                "nominal": "each", "rest": "each"},
    "directions": {"kind": "text", "angles_deg": "numbers", "matrix": "rows", "names": "texts"},
    "winch": {"radius_m": "number"},
    "sensor": {"noise_std": "number", "delay_s": "number", "rate_hz": "number"},
    "plant": {"neck": "text"},
    "drives": {"file": "text"},
}  # fmt: skip
#: Attribute of `Robot` -> its key in the file.
KEY_OF = {
    "sample_time_s": "sample_time_s",
    "time_constant_s": "time_constant_s",
    "winch_radius_m": "winch.radius_m",
    "noise_std": "sensor.noise_std",
    "delay_s": "sensor.delay_s",
    "rate_hz": "sensor.rate_hz",
    "neck": "plant.neck",
    "drives": "drives.file",
}
#: Keys that may be absent: learned from data, or 1 (`sign`).
OPTIONAL_KEYS = ("time_constant_s", "nominal", "rest", "sign")
_TYPE_TEXTS = {
    "text": "a text",
    "texts": "a list of texts",
    "number": "a number",
    "numbers": "a list of numbers",
    "rows": "a list of rows of numbers",
    "each": "a number, or a list of one for each",
}
# Table -> the keys, also of other tables, whose inherited values a new `unit` there makes invalid.
_IN_UNIT = {
    "motors": tuple(("motors", key) for key in ("setpoint_min", "setpoint_max", "rate_limit", "nominal", "rest")),
    "outputs": (
        *(("outputs", key) for key in ("display_unit", "min", "max", "nominal", "rest")),
        ("sensor", "noise_std"),
    ),
}
# Keys for the size and speed of motions: a robot with directions of its own does not inherit them.
_OF_DIRECTIONS = (("", "time_constant_s"), *((table, key) for table in ("motors", "outputs")
                                             for key in ("nominal", "rest")))  # fmt: skip


def preset_text(name: str) -> str:
    """Return the text of a preset's file.

    Raises:
        SettingsError: no such preset.
    """
    require_one_of("the robot preset", name, ROBOT_PRESETS)
    return files("softneck.robot").joinpath("presets", f"{name}.toml").read_text(encoding="utf-8")


def fields(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `Robot` for the tables of a file, with the values of the preset that it extends.

    Raises SettingsError: an unknown key, or a value of the wrong type.
    """
    _check(table)
    whole = _extend(table)
    hint = f"write it, or `extends` one of {', '.join(ROBOT_PRESETS)}."
    for name in ("motors", "outputs", "directions"):
        if name not in whole:
            raise SettingsError(f"there is no table `[{name}]`; {hint}")
    motors, outputs = dict(whole["motors"]), dict(whole["outputs"])
    for name, part in (("motors", motors), ("outputs", outputs)):
        for key in ("names", "unit"):
            if key not in part:
                raise SettingsError(f"`{name}.{key}` is missing; {hint}")
    directions = {key: _tuple(value) for key, value in whole["directions"].items()}
    if "kind" not in directions:
        raise SettingsError('`directions.kind` is missing; it is "tendons", "identified" or "matrix".')
    return {
        "name": whole.get("name", ""),
        "motors": Motors(**_for_each(motors)),
        "outputs": Outputs(**_for_each(outputs)),
        "directions": Directions(**directions),
        **{name: _look_up(whole, key) for name, key in KEY_OF.items()},
    }


@contextlib.contextmanager
def prefix_errors(path: str | Path) -> Iterator[None]:
    """Prefix the errors inside the context with the path of the file."""
    try:
        yield
    except SoftneckError as error:
        raise SettingsError(f"{path}: {error}") from error


def shortest_path(path: Path) -> str:
    """Return the shorter of the relative and the absolute path, for messages."""
    return min(os.path.relpath(path), str(path.resolve()), key=len)


def _check(table: Mapping[str, Any]) -> None:
    if not isinstance(table, Mapping):
        raise SettingsError("a robot is made of tables.")
    for key, value in table.items():
        if key in ROBOT_KEYS[""]:
            _check_value(key, value, ROBOT_KEYS[""][key])
        elif key in ROBOT_KEYS and isinstance(value, Mapping):
            for inner, item in value.items():
                if inner not in ROBOT_KEYS[key]:
                    raise _unknown(f"{key}.{inner}", inner, list(ROBOT_KEYS[key]), f"{key}.")
                _check_value(f"{key}.{inner}", item, ROBOT_KEYS[key][inner])
        elif key in ROBOT_KEYS and key:
            raise SettingsError(f"`{key}` must be a table; write `[{key}]` and its keys below.")
        else:
            raise _unknown(key, key, [*ROBOT_KEYS[""], *(name for name in ROBOT_KEYS if name)], "")


def _unknown(shown: str, key: str, known: list[str], prefix: str) -> SettingsError:
    hint = did_you_mean(key, known, prefix) or f"known: {', '.join(known)}."
    return SettingsError(f"unknown key `{shown}`; {hint.rstrip()}")


def _check_value(key: str, value: Any, what: str) -> None:
    def number(item: Any) -> bool:
        return isinstance(item, int | float) and not isinstance(item, bool) and math.isfinite(item)

    def all_of(items: Any, holds: Any) -> bool:
        return isinstance(items, list | tuple) and len(items) > 0 and all(holds(item) for item in items)

    fits = {
        "text": isinstance(value, str) and value != "",
        "texts": all_of(value, lambda item: isinstance(item, str)),
        "number": number(value),
        "numbers": all_of(value, number),
        "rows": all_of(value, lambda row: all_of(row, number)),
        "each": number(value) or all_of(value, number),
    }
    if not fits[what]:
        raise SettingsError(f"`{key}` must be {_TYPE_TEXTS[what]}; got {value!r}.")


def _extend(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables merged key by key with those of the preset that they extend."""
    if "extends" not in table:
        return dict(table)
    base = _extend(tomllib.loads(preset_text(table["extends"])))
    for name, others in _IN_UNIT.items():
        new = table.get(name, {})
        if new.get("unit", base[name]["unit"]) != base[name]["unit"]:
            for where, key in others:
                base.get(where, {}).pop(key, None)
    if "directions" in table:
        for where, key in _OF_DIRECTIONS:
            (base[where] if where else base).pop(key, None)
    found = {key: value for key, value in {**base, **table}.items() if key != "extends"}
    for name in ROBOT_KEYS:
        # Directions are replaced as a whole: angles of one and a matrix of the other would not fit.
        if isinstance(base.get(name), Mapping) and isinstance(table.get(name), Mapping) and name != "directions":
            found[name] = {**base[name], **table[name]}
    return found


def _for_each(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of motors or outputs for their class: one number for all becomes one for each."""
    count = len(part["names"])
    found = {}
    for key, value in part.items():
        one = isinstance(value, int | float)
        found[key] = (float(value),) * count if one else _tuple(value)
    return found


def _tuple(value: Any) -> Any:
    """Return lists as tuples, and their numbers as floats."""
    if isinstance(value, list | tuple):
        return tuple(_tuple(item) for item in value)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _look_up(table: Mapping[str, Any], key: str) -> Any:
    where, _, last = key.rpartition(".")
    value = (table.get(where, {}) if where else table).get(last)
    return float(value) if isinstance(value, int | float) else value
