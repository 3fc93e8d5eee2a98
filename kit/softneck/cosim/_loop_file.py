"""Loop files: a TOML text that describes a loop."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from softneck.core import Block, DataError, FileFormatError, SettingsError, SoftneckError, file_hash, load
from softneck.loop import (
    AheadReference,
    BlockPart,
    Fault,
    Loop,
    Part,
    RecordingReference,
    Reference,
    ReferenceBlock,
    make_fault,
    make_reference,
)
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import read_recording

from ._fmu_part import FmuPart
from ._isolated import IsolatedPart
from ._simulate import LoopSetup

_TOP = (
    "duration_s", "sample_time_s", "order", "plant", "observer", "controller", "reference", "part", "connections",
    "fault", "limits", "angle", "folder",
)  # fmt: skip
# Table -> (the keys that say where the part comes from, the role of a file of ours).
_SOURCES = {
    "plant": (("fmu", "model", "neck", "python"), "model"),
    "observer": (("fmu", "file", "python"), "observer"),
    "controller": (("fmu", "file", "python"), "controller"),
}
_OTHER_SOURCES = ("fmu", "file", "python")
# A table from Python may hold the part itself.
OBJECT = "object"
# What may stand beside `fmu`: how an FMU that nobody here wrote becomes a part, and where it runs.
_FMU_KEYS = ("names", "units", "sample_time_s", "isolated", "timeout_s")
_REFERENCES = ("step", "ramp", "sine", "rotation", "recording")
_SAME_SAMPLE_TIME = 1e-6
# What `neck` may be beside a file of parameters.
PRESETS = ("paper", "lab")


def load_loop(path: str | Path) -> LoopSetup:
    """Read a loop file and open all it names; relative paths start at the file's folder.

    Raises:
        FileFormatError: no such file or no TOML.
        SettingsError: unknown or missing keys, or values that do not fit; the line names the key.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        return _Reader(source).setup(table)
    except SoftneckError as error:
        if str(error).startswith(str(source)):
            raise
        raise type(error)(f"{source}: {error}") from error


def is_loop_file(path: Path) -> bool:
    """Return whether `path` is a TOML file with a [reference]."""
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        return "reference" in read_toml(path)
    except FileFormatError:
        return False


def reference_of(path: str | Path) -> ReferenceBlock:
    """Return the [reference] of a loop file as a block, of which `build_fmu` makes a reference FMU.

    Its sample time is the file's `sample_time_s`, 20 ms if it states none; its other parts are not opened.

    Raises:
        SettingsError: the reference is an FMU already, or wrong.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        reference = _Reader(source).reference(table["reference"])
        if isinstance(reference, AheadReference):
            reference = reference.reference
        if hasattr(reference, "advance"):
            raise SettingsError("[reference] is an FMU already.")
        return ReferenceBlock(reference, sample_time=_number("sample_time_s", table.get("sample_time_s", 0.02)))  # pyright: ignore[reportArgumentType]
    except SoftneckError as error:
        raise type(error)(f"{source}: {error}") from error


def make_loop(table: Mapping[str, Any], folder: str | Path = ".", *, opened: dict[Any, Any] | None = None) -> LoopSetup:
    """Return the loop that a table with the keys of a loop file describes; relative paths start at `folder`.

    From Python, plant, observer, controller and reference may also be the things themselves: a part, a block, what
    has a `block()` such as a model or `VirtualNeck`, the path of an FMU or a file, a reference. `opened` remembers
    files and FMUs for the next loop of the same.

    Raises:
        SettingsError: unknown or missing keys, or values that do not fit; the line names the key.
    """
    return _Reader(Path(folder), opened).setup(normal_table(table))


class _Reader:
    """Reads one loop file, or a table like one, and remembers the hash of each file that it opens."""

    def __init__(self, source: Path, opened: dict[Any, Any] | None = None) -> None:
        self.folder = source if source.is_dir() else source.parent
        self._opened = opened
        self._step = 0.02
        self.files: dict[str, tuple[str, str]] = {}
        if not source.is_dir():
            self.files["loop"] = (str(source), file_hash(source))

    def setup(self, table: Mapping[str, Any]) -> LoopSetup:
        _refuse_unknown("the file", table, _TOP)
        for key in ("duration_s", "plant", "controller", "reference"):
            if key not in table:
                raise SettingsError(f"`{key}` is missing.")
        if "folder" in table:
            self.folder = self.folder / str(table["folder"])
        self._step = _number("sample_time_s", table.get("sample_time_s", 0.02))
        tables = {name: table[name] for name in _SOURCES if name in table}
        others = _named_parts(table.get("part", []))
        parts = {name: self._part(name, part) for name, part in tables.items()}
        parts |= {name: self._other(name, part) for name, part in others.items()}
        tables |= others
        reference = self.reference(table["reference"], parts["controller"].sample_time)
        if isinstance(reference, FmuPart | IsolatedPart):
            parts["reference"], tables["reference"] = reference, table["reference"]
        # What the file calls a parameter of a part may be one of its inputs, held constant.
        constants, parameters = {}, {}
        for name, part in parts.items():
            chosen = _numbers(f"[{name}] parameters", tables[name].get("parameters", {}))
            ports = {port.name for port in part.inputs}
            constants[name] = {key: value for key, value in chosen.items() if key in ports}
            parameters[name] = {key: value for key, value in chosen.items() if key not in ports}
        loop = Loop(
            plant=parts["plant"],
            observer=parts.get("observer"),
            controller=parts["controller"],
            reference=reference,
            duration=_number("duration_s", table["duration_s"]),
            order=table.get("order", "sequential"),
            plant_parameters=parameters.pop("plant"),
            plant_inputs=constants.pop("plant"),
            observer_parameters=parameters.pop("observer", {}),
            controller_parameters=parameters.pop("controller"),
            other_parameters=parameters,
            other_inputs=constants,
            others={name: parts[name] for name in others},
            faults=_faults(table.get("fault", [])),
            connections=_texts("[connections]", table.get("connections", {})),
        )
        _check_sample_time(loop, table.get("sample_time_s"))
        limits = _numbers("[limits]", table.get("limits", {}))
        return LoopSetup(loop=loop, limits=limits, files=dict(self.files), angle=table.get("angle", "true"))

    def _part(self, name: str, table: Any) -> Part:
        keys, role = _SOURCES[name]
        return self._made(name, table, keys, role, as_role=name)

    def _other(self, name: str, table: Mapping[str, Any]) -> Part:
        rest = {key: value for key, value in table.items() if key not in ("name", "role")}
        return self._made(name, rest, _OTHER_SOURCES, None, as_role=str(table.get("role", "controller")))

    def _made(self, name: str, table: Any, keys: tuple[str, ...], role: str | None, *, as_role: str) -> Part:
        if not isinstance(table, dict):
            raise SettingsError(f"`{name}` must be a table: [{name}].")
        extra = (OBJECT,) if OBJECT in table else _FMU_KEYS if "fmu" in table else ()
        _refuse_unknown(f"[{name}]", table, (*keys, "parameters", *extra))
        given = [key for key in (*keys, OBJECT) if key in table]
        if len(given) != 1:
            raise SettingsError(
                f"[{name}] needs exactly one of {', '.join(keys)}; it has {', '.join(given) or 'none'}."
            )
        key, value = given[0], table[given[0]]
        if key == OBJECT:
            return _part_of(name, value)
        if not isinstance(value, str):
            raise SettingsError(f"[{name}] {key} must be a text; got {value!r}.")
        if key == "python":
            return self._from_python(name, value)
        if key == "neck" and value in PRESETS:
            return BlockPart(VirtualNeck(NeckParameters.preset(value)).block(sample_time=self._step))
        file = self._file(name, value)
        if key == "neck":
            return BlockPart(VirtualNeck(NeckParameters.from_toml(file)).block(sample_time=self._step))
        settings = sorted((k, repr(v)) for k, v in table.items() if k != "parameters")
        if key == "fmu":
            return self._open((name, file, *settings), lambda: _fmu_part(file, f"[{name}]", table, as_role))
        thing = self._open((role, file), lambda: load(file, role=role))
        return BlockPart(thing.block())

    def _open(self, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        """Return what `make` opens, remembered if this reader shares what it opens; a changed file is opened again."""
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

    def reference(self, table: Any, sample_time: float = 0.02) -> Reference | Part:
        """Return what the table [reference] describes; with `ahead_s` a part that tells it so long before."""
        if isinstance(table, dict) and "ahead_s" in table:
            rest = {key: value for key, value in table.items() if key != "ahead_s"}
            made = self.reference(rest)
            if hasattr(made, "advance"):
                raise SettingsError("[reference] ahead_s: an FMU cannot be asked what it will say; leave it out.")
            return AheadReference(made, _number("[reference] ahead_s", table["ahead_s"]), sample_time=sample_time)  # pyright: ignore[reportArgumentType]
        if isinstance(table, dict) and OBJECT in table:
            given: Any = table[OBJECT]
            part: Any = given if callable(given) else _part_of("reference", given)
            return part
        if isinstance(table, dict) and "fmu" in table:
            return self._made("reference", table, ("fmu",), None, as_role="reference")
        if not isinstance(table, dict) or table.get("kind") not in _REFERENCES:
            raise SettingsError(f"[reference] kind must be one of {', '.join(_REFERENCES)}.")
        values = {key: value for key, value in table.items() if key != "kind"}
        if table["kind"] != "recording":
            return make_reference(table["kind"], values)
        _refuse_unknown("[reference]", values, ("file",))
        recording = read_recording(self._file("reference", str(values.get("file", ""))))
        if len(recording.runs()) > 1:
            raise DataError("[reference] file: the recording has several runs; cut out the one to follow.")
        channels = recording.channels
        pitch, roll = (channels.get(f"{axis}_reference", channels[axis]) for axis in ("pitch", "roll"))
        time = recording.time - recording.time[0]
        return RecordingReference(
            time=time, pitch=pitch, roll=roll, cocontraction=channels.get("cocontraction_reference")
        )

    def _file(self, role: str, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise FileFormatError(f"[{role}]: there is no file {path}.")
        self.files[role] = (str(path), self._open(("hash", path), lambda: file_hash(path)))
        return path


def normal_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a loop's table in which every part is a table, as in a loop file."""
    made = dict(table)
    for name in ("plant", "observer", "controller", "reference"):
        value = made.get(name)
        if value is None or isinstance(value, Mapping):
            continue
        if isinstance(value, str | Path) and name != "reference":
            made[name] = {_source_key(name, str(value)): str(value)}
        else:
            made[name] = {OBJECT: value}
    return {key: value for key, value in made.items() if value is not None}


def _source_key(part: str, text: str) -> str:
    if text.endswith(".fmu"):
        return "fmu"
    if part == "plant":
        return "neck" if text in PRESETS or text.endswith(".toml") else "model"
    return "file"


def _part_of(name: str, made: Any, said: str = " is") -> Part:
    """Return a part out of a part, a block, or what has a block."""
    made = made.block() if hasattr(made, "block") and not hasattr(made, "advance") else made
    if isinstance(made, Block):
        return BlockPart(made)
    if not all(hasattr(made, item) for item in ("inputs", "outputs", "sample_time", "start", "advance", "close")):
        raise SettingsError(f"[{name}]{said} a {type(made).__name__}, not a Block or a Part.")
    return made


def _fmu_part(file: Path, where: str, table: Mapping[str, Any], role: str) -> Part:
    isolated = table.get("isolated", False)
    if not isinstance(isolated, bool):
        raise SettingsError(f"{where} isolated must be true or false; got {isolated!r}.")
    step = table.get("sample_time_s")
    settings: dict[str, Any] = {
        "role": role,
        "names": _texts(f"{where} names", table.get("names", {})),
        "units": _texts(f"{where} units", table.get("units", {})),
        "sample_time": None if step is None else _number("sample_time_s", step),
    }
    if not isolated:
        return FmuPart(file, **settings)
    return IsolatedPart(file, **settings, timeout=_number("timeout_s", table.get("timeout_s", 10.0)))


def _named_parts(tables: Any) -> dict[str, Mapping[str, Any]]:
    named: dict[str, Mapping[str, Any]] = {}
    for table in _tables("part", tables):
        name = table.get("name")
        if not isinstance(name, str):
            raise SettingsError("each [[part]] needs a `name`.")
        if name in named:
            raise SettingsError(f"two [[part]] are named `{name}`.")
        named[name] = table
    return named


def _faults(tables: Any) -> tuple[Fault, ...]:
    faults = []
    for number, table in enumerate(_tables("fault", tables), start=1):
        values = {key: value for key, value in table.items() if key != "kind"}
        try:
            faults.append(make_fault(str(table.get("kind", "")), values))
        except SettingsError as error:
            raise SettingsError(f"[[fault]] {number}: {error}") from error
    return tuple(faults)


def _tables(key: str, tables: Any) -> list[Mapping[str, Any]]:
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise SettingsError(f"`{key}` must be a list of tables: [[{key}]].")
    return tables


def _texts(where: str, table: Any) -> dict[str, str]:
    if not isinstance(table, dict) or not all(isinstance(value, str) for value in table.values()):
        raise SettingsError(f"{where} must be a table of names; got {table!r}.")
    return dict(table)


def read_toml(source: Path) -> dict[str, Any]:
    """Return the content of a TOML file; raise FileFormatError if there is none."""
    if not source.is_file():
        raise FileFormatError(f"{source}: no such file.")
    try:
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{source}: is no TOML ({error}).") from error
    except OSError as error:
        raise FileFormatError(f"{source}: cannot be read: {error.strerror}.") from error


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    before = list(sys.path)
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path[:] = before


def _refuse_unknown(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    unknown = [key for key in table if key not in known]
    if unknown:
        raise SettingsError(f"`{unknown[0]}` is no key of {where}; it takes {', '.join(known)}.")


def _numbers(where: str, table: Any) -> dict[str, float]:
    if not isinstance(table, dict):
        raise SettingsError(f"{where} must be a table of numbers; got {table!r}.")
    return {name: _number(f"{where} {name}", value) for name, value in table.items()}


def _number(name: str, value: Any) -> float:
    if not isinstance(value, bool | int | float):
        raise SettingsError(f"`{name}` must be a number; got {value!r}.")
    return float(value)


def _check_sample_time(loop: Loop, given: Any) -> None:
    if given is None:
        return
    step = min(part.sample_time for part in loop.parts.values())
    if abs(_number("sample_time_s", given) - step) > _SAME_SAMPLE_TIME * step:
        raise SettingsError(f"`sample_time_s` is {given:g}, but the fastest part runs at {step:g} s; state that.")
