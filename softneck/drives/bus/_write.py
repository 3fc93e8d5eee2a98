"""The table that a drives file is: the way back from `make_drives`."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from ._file import DrivesFile
from ._read import _CLASSES, _FIELDS, _KEYS
from ._sensor_source import SOURCE_KEYS


def drives_table(file: DrivesFile) -> dict[str, Any]:
    """Return the keys and values that `make_drives` reads `file` from; all of them, with paths made absolute."""
    table: dict[str, Any] = {"profile": file.profile}
    table["bus"] = _values(file, "bus")
    table["stop"] = _values(file, "quick")
    table["drive"] = [_values(entry, "drive") | _values(entry.scale, "scale") for entry in file.drives]
    for name in _CLASSES:
        table[name] = _values(getattr(file, _FIELDS.get(name, name)), name)
    table["sensor"] = {"kind": file.sensor_kind, "node": file.sensor_node, **_source(file), **table["sensor"]}
    if file.sensor_axes:
        table["sensor"]["axes"] = list(file.sensor_axes)
    return table


def _values(settings: Any, name: str) -> dict[str, Any]:
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
