"""Values of a loop's table, each checked as it is read; a wrong one is a line that names its key."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, SettingsError
from softneck.core._budget import settings_text
from softneck.core._files import require_file
from softneck.loop._wiring import Link


def read_toml(source: Path) -> dict[str, Any]:
    """Return the content of a TOML file; raise FileFormatError if there is none."""
    require_file(source)
    try:
        return tomllib.loads(settings_text(source))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: is not valid TOML ({error}).") from error
    except OSError as error:
        raise FileFormatError(f"{source}: cannot be read: {error.strerror}.") from error


def refuse_unknown(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    """Raise SettingsError if `table` has a key that is not `known`."""
    unknown = [key for key in table if key not in known]
    if unknown:
        raise SettingsError(f"unknown key `{unknown[0]}` of {where}; it takes {', '.join(known)}.")


def number(name: str, value: Any) -> float:
    """Return a number of the table."""
    if not isinstance(value, bool | int | float):
        raise SettingsError(f"`{name}` must be a number; got {value!r}.")
    return float(value)


def numbers(where: str, table: Any) -> dict[str, float]:
    """Return a table of numbers."""
    if not isinstance(table, dict):
        raise SettingsError(f"{where} must be a table of numbers; got {table!r}.")
    return {name: number(f"{where} {name}", value) for name, value in table.items()}


def texts(where: str, table: Any) -> dict[str, str]:
    """Return a table of names."""
    if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
        raise SettingsError(f"{where} must be a table of names; got {table!r}.")
    return dict(table)


def links(table: Any) -> dict[str, str | Link]:
    """Return [connections]: each a name, or {from = name, factor, offset}, which stands for any conversion of units."""
    if not isinstance(table, dict):
        raise SettingsError(f"[connections] must be a table; got {table!r}.")
    made: dict[str, str | Link] = {}
    for target, origin in table.items():
        where = f'[connections] "{target}"'
        if isinstance(origin, Mapping):
            refuse_unknown(where, origin, ("from", "factor", "offset"))
            name, factor, offset = origin.get("from"), origin.get("factor", 1.0), origin.get("offset", 0.0)
            if not isinstance(name, str):
                raise SettingsError(f"{where} needs `from`, the name of an output; got {name!r}.")
            made[target] = Link(name, number(f"{where} factor", factor), number(f"{where} offset", offset))
        elif isinstance(origin, str):
            made[target] = origin
        else:
            raise SettingsError(f"{where} must be a name or a table with `from`; got {origin!r}.")
    return made


def tables(key: str, listed: Any) -> list[Mapping[str, Any]]:
    """Return a list of tables."""
    if not isinstance(listed, list) or not all(isinstance(table, dict) for table in listed):
        raise SettingsError(f"`{key}` must be a list of tables: [[{key}]].")
    return listed
