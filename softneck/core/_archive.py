"""The binary file format of softneck: a numpy `.npz` with a JSON header, whose types are checked; never a pickle."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ._errors import FileFormatError, error_reason
from ._files import MOST_JSON, as_path, atomic_write, open_zip, require_file

FORMAT_VERSION = 1
_HEADER_KEY, _SHAPES_KEY = "header", "shapes"
# Allowed `dtype.kind` of arrays: real numbers. Reading a complex array as float would drop its imaginary part.
_NUMBER_KINDS = "fiub"
# Larger numbers than any physical value; their squares still are numbers.
_LARGEST = 1e100
_LARGEST_COUNT = 2**53


def write_archive(
    path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, force: bool = False
) -> None:
    """Write `header` (JSON values) and `arrays` to `path` in one piece.

    Raises:
        OutputFileError: the file exists (and not `force`) or cannot be written.
    """
    shapes = {name: list(np.shape(array)) for name, array in arrays.items()}
    text = json.dumps({"format": "softneck", "format_version": FORMAT_VERSION, **header, _SHAPES_KEY: shapes})
    contents = {_HEADER_KEY: np.frombuffer(text.encode(), dtype=np.uint8), **arrays}
    with atomic_write(path, force=force) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **contents)


def is_archive(path: str | Path) -> bool:
    """Return whether a file claims to be one that `write_archive` wrote: a ZIP archive with our header, or no ZIP."""
    try:
        with zipfile.ZipFile(as_path(path)) as file:
            return f"{_HEADER_KEY}.npy" in file.namelist()
    except (OSError, ValueError, zipfile.BadZipFile, NotImplementedError):
        return True


def read_archive(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays of a file that `write_archive` wrote.

    Raises:
        FileFormatError: no such file, not a softneck file, another version, damaged.
    """
    source = as_path(path)
    require_file(source)
    if not zipfile.is_zipfile(source):
        raise FileFormatError(
            f"{source}: is not a softneck file or is damaged; expected a model, family, controller or observer (.npz)."
        )
    try:
        open_zip(source).close()
        with np.load(source, allow_pickle=False) as archive:
            contents = {name: archive[name] for name in archive.files}
        written = contents.pop(_HEADER_KEY)
        if written.nbytes > MOST_JSON:
            raise ValueError(f"its header has {written.nbytes} bytes")
        header = json.loads(written.tobytes().decode())
        for name, array in contents.items():
            if not isinstance(array, np.ndarray) or array.dtype.kind not in _NUMBER_KINDS:
                raise ValueError(f"its member `{name}` is not an array of numbers")
    except FileFormatError:
        raise
    except Exception as error:  # damaged bytes raise all kinds of errors in zipfile, its decompressors, numpy and json
        raise FileFormatError(f"{source}: is not a softneck file or is damaged ({error_reason(error)}).") from error
    _check_header(source, header)
    # Files of versions before 0.3 do not tell their shapes.
    _check_shapes(source, header.pop(_SHAPES_KEY, None), contents)
    return header, contents


def _check_shapes(source: Path, shapes: object, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise FileFormatError for an array that was written with another shape, or that was not written."""
    found = {name: list(array.shape) for name, array in arrays.items()}
    if shapes is None or shapes == found:
        return
    told = shapes if isinstance(shapes, dict) else {}
    name = next((name for name in (*told, *found) if told.get(name) != found.get(name)), "shapes")
    raise FileFormatError(
        f"{source}: is damaged: its array `{name}` has shape {found.get(name)} and was written with {told.get(name)}."
    )


def _check_header(source: Path, header: object) -> None:
    if not isinstance(header, dict) or header.get("format") != "softneck":
        raise FileFormatError(f"{source}: is not a softneck file; expected one that softneck wrote.")
    version = header.get("format_version")
    if version != FORMAT_VERSION:
        raise FileFormatError(
            f"{source}: has format version {version}; this softneck reads {FORMAT_VERSION}. "
            "Write it again with this version or use the softneck that wrote it."
        )


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
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST
    if schema is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST_COUNT
    if isinstance(schema, list):
        return isinstance(value, list)
    return isinstance(value, Mapping if isinstance(schema, dict) else schema)


def _words(schema: Any) -> str:
    if isinstance(schema, tuple):
        return " or ".join(map(_words, schema))
    names = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", None: "null"}
    return "a list" if isinstance(schema, list) else "a table" if isinstance(schema, dict) else names[schema]


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
