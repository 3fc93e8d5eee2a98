"""Open the parts of a loop's table: softneck files, FMUs, necks, and Python factories."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from softneck.core import DataError, FileFormatError, SettingsError, file_hash, load, refuse_unknown
from softneck.design import own_object
from softneck.loop import AheadReference, BlockPart, Link, Part, RecordingReference, Reference, make_reference
from softneck.plant import PRESETS, NeckParameters, VirtualNeck
from softneck.robot import Robot, find_robot
from softneck.runtime import Block, Port
from softneck.signals import read_recording, require_same_robot

from ..parts._fmu_part import FmuPart, naming_arguments
from ..parts._isolated import IsolatedPart


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


def links(table: Any, robot: Robot) -> dict[str, str | Link]:
    """Return [connections]: names, or tables {from = name, factor, offset}, which replace the conversion of units."""
    if not isinstance(table, dict):
        raise SettingsError(f"[connections] must be a table; got {table!r}.")

    def own(end: str) -> str:
        part, dot, name = end.partition(".")
        return f"{part}{dot}{robot.own(name)}"

    made: dict[str, str | Link] = {}
    for target, origin in table.items():
        where = f'[connections] "{target}"'
        if isinstance(origin, Mapping):
            refuse_unknown(where, origin, ("from", "factor", "offset"))
            name, factor, offset = origin.get("from"), origin.get("factor", 1.0), origin.get("offset", 0.0)
            if not isinstance(name, str):
                raise SettingsError(f"{where} needs `from`, the name of an output; got {name!r}.")
            made[own(target)] = Link(own(name), number(f"{where} factor", factor), number(f"{where} offset", offset))
        elif isinstance(origin, str):
            made[own(target)] = own(origin)
        else:
            raise SettingsError(f"{where} must be a name or a table with `from`; got {origin!r}.")
    return made


def tables(key: str, listed: Any) -> list[Mapping[str, Any]]:
    """Return a list of tables."""
    if not isinstance(listed, list) or not all(isinstance(table, dict) for table in listed):
        raise SettingsError(f"`{key}` must be a list of tables: [[{key}]].")
    return listed


# Table -> (keys for the source of the part, role of a softneck file).
SOURCES = {
    "plant": (("fmu", "model", "neck", "python"), "model"),
    "observer": (("fmu", "file", "python"), "observer"),
    "controller": (("fmu", "file", "python"), "controller"),
}
_OTHER_SOURCES = ("fmu", "file", "python")
# A table from Python may hold the part itself under this key.
OBJECT = "object"
# Keys beside `fmu`: names, units and step for an FMU of another tool, and whether it runs in a process of its own.
_FMU_KEYS = ("names", "units", "sample_time_s", "isolated", "timeout_s")
_NECK = Robot.preset("neck")
_REFERENCE_KINDS = ("step", "ramp", "sine", "rotation", "recording")


class PartOpener:
    """Opens the parts in the tables of one loop, and keeps the hash of each file."""

    def __init__(self, folder: Path, *, step: float = 0.02, opened: dict[Any, Any] | None = None) -> None:
        """Open relative to `folder`, with necks that step every `step` [s]; `opened` caches parts between loops."""
        self.folder, self.files = folder, dict[str, tuple[str, str]]()
        # Part -> its robot, if it has one.
        self.robots: dict[str, Robot] = {}
        # Of the plant, if it is a virtual neck.
        self._physics: NeckParameters | None = None
        self._step, self._opened = step, opened

    def robot(self, given: Any, beside: Path | None) -> Robot:
        """Return the robot of the loop: that of its parts, else `given`, else the one beside the file.

        Raises:
            SettingsError: parts of two robots; the message names both.
        """
        if given is not None and not isinstance(given, str | Robot):
            raise SettingsError(f"`robot` must be a preset or a robot file; got {given!r}.")
        if given is not None:
            file = self.folder / given if isinstance(given, str) else None
            self.robots = {"robot": find_robot(file if file is not None and file.is_file() else given), **self.robots}
        if not self.robots:
            return find_robot(beside=beside)
        first, robot = next(iter(self.robots.items()))
        for name, other in self.robots.items():
            if other.hash != robot.hash:
                raise SettingsError(
                    f"[{name}] is of robot {other.label()} and [{first}] of robot {robot.label()}; use one robot."
                )
        return robot

    def part(self, name: str, table: Any) -> Part:
        """Return plant, observer or controller."""
        keys, role = SOURCES[name]
        return self._open_part(name, table, keys, role, as_role=name)

    def other(self, name: str, table: Mapping[str, Any]) -> Part:
        """Return the part of a [[part]] table."""
        rest = {key: value for key, value in table.items() if key not in ("name", "role")}
        return self._open_part(name, rest, _OTHER_SOURCES, None, as_role=str(table.get("role", "controller")))

    def reference(self, table: Any, sample_time: float = 0.02, robot: Robot = _NECK) -> Reference | Part:
        """Return the reference of the table [reference]; with `ahead_s` a part with preview."""
        if isinstance(table, dict) and "ahead_s" in table:
            rest = {key: value for key, value in table.items() if key != "ahead_s"}
            made = self.reference(rest, sample_time, robot)
            if hasattr(made, "advance"):
                raise SettingsError("[reference] ahead_s: an FMU has no preview; leave it out.")
            ahead = number("[reference] ahead_s", table["ahead_s"])
            return AheadReference(made, ahead, sample_time=sample_time, robot=robot)  # pyright: ignore[reportArgumentType]
        if isinstance(table, dict) and OBJECT in table:
            given: Any = table[OBJECT]
            part: Any = given if callable(given) else _part_of("reference", given)
            return part
        if isinstance(table, dict) and "fmu" in table:
            return self._open_part("reference", table, ("fmu",), None, as_role="reference")
        if not isinstance(table, dict) or table.get("kind") not in _REFERENCE_KINDS:
            raise SettingsError(f"[reference] kind must be one of {', '.join(_REFERENCE_KINDS)}.")
        values = {key: value for key, value in table.items() if key != "kind"}
        if table["kind"] != "recording":
            return make_reference(table["kind"], values, robot)
        refuse_unknown("[reference]", values, ("file",))
        recording = read_recording(self._file("reference", str(values.get("file", ""))))
        require_same_robot(robot, recording.robot, "[reference] file and the loop")
        if len(recording.runs()) > 1:
            raise DataError("[reference] file: the recording has several runs; use a recording of one run.")
        time = recording.time - recording.time[0]
        return RecordingReference.of(time, recording.channels, robot.outputs.names)

    def drives(self, name: Any) -> None:
        """Keep the hash of the loop's drives file for certificates; the file is not read here."""
        if not isinstance(name, str):
            raise SettingsError(f"`drives` must be the name of a drives file; got {name!r}.")
        self._file("drives", name)

    def _open_part(self, name: str, table: Any, keys: tuple[str, ...], role: str | None, *, as_role: str) -> Part:
        if not isinstance(table, dict):
            raise SettingsError(f"`{name}` must be a table: [{name}].")
        extra = (OBJECT,) if OBJECT in table else _FMU_KEYS if "fmu" in table else ()
        refuse_unknown(f"[{name}]", table, (*keys, "parameters", *extra))
        given = [key for key in (*keys, OBJECT) if key in table]
        if len(given) != 1:
            raise SettingsError(
                f"[{name}] needs exactly one of {', '.join(keys)}; it has {', '.join(given) or 'none'}."
            )
        key, value = given[0], table[given[0]]
        if key == OBJECT:
            value = own_object(value) if name == "controller" else value
            self._note_robot(name, value)
            return _part_of(name, value)
        if not isinstance(value, str):
            raise SettingsError(f"[{name}] {key} must be a text; got {value!r}.")
        if key == "python":
            return self._from_python(name, value)
        if key == "neck" and value in PRESETS:
            return self._virtual(NeckParameters.preset(value))
        file = self._file(name, value)
        if key == "neck":
            return self._virtual(NeckParameters.from_toml(file))
        settings = sorted((k, repr(v)) for k, v in table.items() if k != "parameters")
        if key == "fmu":
            return self._open_cached((name, file, *settings), lambda: _fmu_part(file, f"[{name}]", table, as_role))
        thing = self._open_cached((role, file), lambda: load(file, role=role))
        self._note_robot(name, thing)
        return BlockPart(thing.block())

    def _virtual(self, parameters: NeckParameters) -> Part:
        """Return the virtual neck; `plant_of` makes that of another robot."""
        self._physics = parameters
        return BlockPart(VirtualNeck(parameters).block(sample_time=self._step))

    def plant_of(self, robot: Robot, made: Part) -> Part:
        """Return the plant of a loop of `robot`: `made`, or the robot's virtual plant with the same physics."""
        if self._physics is None:
            return made
        return BlockPart(VirtualNeck.of(robot, self._physics).block(sample_time=self._step))

    def with_robot_names(self, name: str, part: Part, robot: Robot) -> Part:
        """Return a part whose motor ports have the names of `robot`, not numbers or names of its own robot."""
        names = {port.name: robot.own(port.name) for port in (*part.inputs, *part.outputs)}
        if name in self.robots:
            own = self.robots[name]
            for what in ("set_points", "motor_positions", "measured_positions"):
                names |= dict(zip(getattr(own, what), getattr(robot, what), strict=True))
        names = {old: new for old, new in names.items() if old != new}
        if names and type(part) is BlockPart:
            block = part.block
            ports = {"inputs": _with_names(block.inputs, names), "outputs": _with_names(block.outputs, names)}
            return BlockPart(replace(block, **ports))
        if isinstance(part, FmuPart | IsolatedPart):
            settings: Any = {"role": part.role, "sample_time": part.sample_time}
            settings |= {"timeout": part.timeout} if isinstance(part, IsolatedPart) else {}
            return type(part)(part.path, **settings, **naming_arguments(part, names)) if names else part
        made: Any = _RenamedPart(part, names) if names else part
        return made

    def _note_robot(self, name: str, thing: Any) -> None:
        """Keep the robot of a part, if it has one."""
        if isinstance(robot := getattr(thing, "robot", None), Robot):
            self.robots[name] = robot

    def _open_cached(self, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return the result of `make`, from the cache if there is one and the file has not changed."""
        if self._opened is None:
            return make()
        stat = key[1].stat()
        full = (*key, stat.st_mtime_ns, stat.st_size)
        if full not in self._opened:
            self._opened[full] = make()
        return self._opened[full]

    def _from_python(self, name: str, path: str) -> Part:
        """Call `package.module:factory`; modules beside the loop file are found too."""
        module_name, _, factory = path.partition(":")
        try:
            with _importable(self.folder):
                module = import_module(module_name)
            made = getattr(module, factory)()
        except (ImportError, AttributeError, ValueError) as error:
            raise SettingsError(
                f"[{name}] python = `{path}` cannot be called ({error}); write package.module:factory."
            ) from error
        if module.__file__:
            self.files[name] = (module.__file__, file_hash(module.__file__))
        return _part_of(name, made, f" python = `{path}` returned")

    def _file(self, role: str, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise FileFormatError(f"[{role}]: there is no file {path}.")
        self.files[role] = (str(path), self._open_cached(("hash", path), lambda: file_hash(path)))
        return path


class _RenamedPart:
    """A user's part with other names for its ports."""

    def __init__(self, part: Part, names: Mapping[str, str]) -> None:
        """Rename the ports by `names`, old name -> new name."""
        self._part, self.sample_time, self.role = part, part.sample_time, part.role
        self.inputs, self.outputs = (_with_names(ports, names) for ports in (part.inputs, part.outputs))

    def __getattr__(self, name: str) -> Any:
        """Return all other attributes of the part."""
        return getattr(self._part, name)


def _with_names(ports: tuple[Port, ...], names: Mapping[str, str]) -> tuple[Port, ...]:
    return tuple(replace(port, name=names.get(port.name, port.name)) for port in ports)


def _part_of(name: str, made: Any, verb: str = " is") -> Part:
    """Return a part from a part, a block, an object with `block()`, or an object of the user."""
    made = own_object(made) if name == getattr(made, "role", "controller") else made
    made = made.block() if hasattr(made, "block") and not hasattr(made, "advance") else made
    if isinstance(made, Block):
        return BlockPart(made)
    if not all(hasattr(made, item) for item in ("inputs", "outputs", "sample_time", "start", "advance", "close")):
        raise SettingsError(f"[{name}]{verb} a {type(made).__name__}, not a Block or a Part.")
    return made


def _fmu_part(file: Path, where: str, table: Mapping[str, Any], role: str) -> Part:
    isolated = table.get("isolated", False)
    if not isinstance(isolated, bool):
        raise SettingsError(f"{where} isolated must be true or false; got {isolated!r}.")
    step = table.get("sample_time_s")
    settings: dict[str, Any] = {"role": role, "sample_time": None if step is None else number("sample_time_s", step)}
    for key in ("names", "units"):
        chosen = settings[key] = table.get(key, {})
        if not isinstance(chosen, dict) or not all(isinstance(value, str) for value in chosen.values()):
            raise SettingsError(f"{where} {key} must be a table of names; got {chosen!r}.")
    if not isolated:
        return FmuPart(file, **settings)
    return IsolatedPart(file, **settings, timeout=number("timeout_s", table.get("timeout_s", 10.0)))


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    before = list(sys.path)
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path[:] = before
