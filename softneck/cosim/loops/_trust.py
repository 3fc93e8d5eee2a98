"""Which Python a loop's table would run: that of its own folder, or of elsewhere. Nothing is imported to find out."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from softneck.core import SettingsError

from ._loop_values import read_toml

# Our own package runs anyway; loops of worst plants name it.
_OURS = "softneck"


def python_of(table: Any) -> Iterator[str]:
    """Yield each `python = "package.module:factory"` of a table, at any depth; dotted keys of a study too."""
    if isinstance(table, Mapping):
        for key, value in table.items():
            if str(key).rpartition(".")[2] == "python":
                yield from _texts(value)
            else:
                yield from python_of(value)
    elif isinstance(table, list):
        for item in table:
            yield from python_of(item)


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in a value: one, or the choices of a study."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)


def foreign_python(source: Path) -> str:
    """Return the first `python =` of a loop or study file whose module is not in the loop's folder, else "".

    Raises:
        FileFormatError: no such file or no TOML.
    """
    table = read_toml(source)
    loop, named = table.get("loop"), list(python_of(table))
    project = source.resolve().parent
    if isinstance(loop, str) and (source.parent / loop).is_file():
        project = (source.parent / loop).resolve().parent
        loop = read_toml(source.parent / loop)
        named += python_of(loop)
    start = loop if isinstance(loop, Mapping) else table
    folder = project / str(start.get("folder", "."))
    return next((path for path in named if not _lies_in(project, folder, path.partition(":")[0].partition(".")[0])), "")


def require_trusted(source: Path, *, trust: bool) -> None:
    """Raise SettingsError if a loop or study file would run Python of outside its folder, unless it is trusted."""
    path = "" if trust else foreign_python(source)
    if path:
        raise SettingsError(
            f"{source}: python = `{path}` is not in the loop's folder; it would run with your rights. Say --trust if "
            "it may. Nothing was run."
        )


def _lies_in(project: Path, folder: Path, package: str) -> bool:
    """Return whether the import of `package`, looked for in `folder` first, would run a file of `project`."""
    if package == _OURS:
        return True
    loaded = sys.modules.get(package)
    if loaded is not None:
        file = getattr(loaded, "__file__", None)
        return file is not None and Path(file).resolve().is_relative_to(project)
    found = PathFinder.find_spec(package, [str(folder)])
    if found is None:
        return False
    places = [found.origin] if found.origin else list(found.submodule_search_locations or ())
    return bool(places) and all(Path(place).resolve().is_relative_to(project) for place in places)
