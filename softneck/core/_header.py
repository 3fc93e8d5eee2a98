"""Types of the values in a file's JSON header, checked where the file is opened and nowhere else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ._errors import FileFormatError

# Larger numbers than any physical value; their squares still are numbers.
_LARGEST = 1e100
_LARGEST_COUNT = 2**53


def require_header(header: Any, schema: Any, where: str = "header") -> None:
    """Raise FileFormatError where a value of `header` is not as `schema` says; it names the place.

    A schema is `float` (finite), `int`, `str` or `bool`; a tuple of schemas of which one must hold, None for null; a
    list with the schema of every item; a table with the schema of each key that is there, or with `str` as its only key
    that of all. Keys that are not in the schema are not checked, as newer versions add some.
    """
    if not _holds(header, schema, where):
        raise FileFormatError(f"its {where} holds {_shown(header)}; {_words(schema)} is needed.")


def _holds(value: Any, schema: Any, where: str) -> bool:
    if isinstance(schema, tuple):
        return any(_is(value, one) for one in schema)
    if not _is(value, schema):
        return False
    if isinstance(schema, list):
        for number, item in enumerate(value):
            require_header(item, schema[0], f"{where}[{number}]")
    elif isinstance(schema, dict):
        of_all = schema.get(str)
        for key, item in value.items():
            if of_all is not None or key in schema:
                require_header(item, schema[key] if of_all is None else of_all, f"{where}.{key}")
    return True


def _is(value: Any, schema: Any) -> bool:
    """Return whether `value` is of the schema's own type."""
    if schema is None:
        return value is None
    if schema is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and _is_finite(value)
    if schema is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST_COUNT
    if isinstance(schema, list):
        return isinstance(value, list)
    return isinstance(value, Mapping if isinstance(schema, dict) else schema)


def _is_finite(value: float) -> bool:
    return abs(value) <= _LARGEST and math.isfinite(value)


def _words(schema: Any) -> str:
    if isinstance(schema, tuple):
        return " or ".join(map(_words, schema))
    names = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", None: "null"}
    return "a list" if isinstance(schema, list) else "a table" if isinstance(schema, dict) else names[schema]


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
