"""Loop files: TOML files that describe a loop, and the check of the Python that they would run."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from softneck.core import (
    FileFormatError,
    ReprMixin,
    SettingsError,
    SoftneckError,
    file_hash,
    read_toml,
    refuse_unknown,
    require_one_of,
    require_steps,
)
from softneck.loop import AheadReference, Fault, Loop, Part, ReferenceBlock, System, make_fault
from softneck.robot import Robot, find_robot

from ..parts._fmu_part import FmuPart
from ..parts._isolated import IsolatedPart
from ..ssp._read import StructureTable, read_ssp
from ._loop_parts import OBJECT, PRESETS, SOURCES, PartOpener, links, number, numbers, tables


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class LoopSetup(ReprMixin):
    """A loop with its limits; a loop file describes one.

    `loop`: the parts, the reference, the order. `limits`: metric -> upper limit, such as "pitch.overshoot_pct": 5.0;
    that of "validity.min" is a lower one. `files`: role -> (path, SHA-256) of each file that was read. `angle`: the
    outputs of the metrics: "true" (if the plant has them) or "measured".
    """

    loop: Loop
    limits: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    angle: str = "true"

    def __post_init__(self) -> None:
        require_one_of("angle", self.angle, ("true", "measured"))


_LOOP_KEYS = (
    "duration_s", "sample_time_s", "order", "plant", "observer", "controller", "reference", "part", "connections",
    "fault", "limits", "angle", "folder", "drives", "robot",
)  # fmt: skip
# Keys of a loop file that names an SSP archive.
_SSP_KEYS = ("ssp", "duration_s", "fault", "limits", "angle", "robot")


def load_loop(path: str | Path, *, robot: str | None = None) -> LoopSetup:
    """Read a loop file and open all files in it; relative paths start at the file's folder.

    Args:
        path: of the file, or of an SSP archive of a closed loop.
        robot: a preset or a robot file that replaces the file's `robot`; every part must be of it.

    Raises:
        FileFormatError: no such file, or not TOML.
        SettingsError: unknown or missing keys, or invalid values; the message names the key.
    """
    source = Path(path)
    if source.suffix == ".ssp":
        return _load_ssp_loop(source, robot)
    table = read_toml(source)
    try:
        if "ssp" in table:
            return _load_ssp_file(table, source, robot)
        return _setup(table if robot is None else {**table, "robot": find_robot(robot)}, source)
    except SoftneckError as error:
        if str(error).startswith(str(source)):
            raise
        raise type(error)(f"{source}: {error}") from error


def load_ssp(path: str | Path, *, step: float | None = None) -> LoopSetup | System:
    """Read an SSP 1.0 or 2.0 archive of FMUs for co-simulation, of any tool.

    Args:
        path: of the archive; its FMUs are unpacked until this process ends.
        step: [s], instead of the archive's own.

    Returns:
        A loop if the FMUs are one plant, one controller and one reference (of softneck, or with these names), and
        perhaps an observer and others; else a system, with signals "part.output".

    Raises:
        FileFormatError: no archive, a damaged one, or one that names files that are missing or outside of it.
        SettingsError: features that a loop does not have, such as signal dictionaries; the message names them.
    """
    read = read_ssp(path, step=step)
    if read.closed:
        return _load_ssp_loop(Path(path), None, read)
    opener = PartOpener(Path())
    entries = {entry["name"]: entry for entry in read.table["part"]}
    parts = {name: opener.other(name, entry) for name, entry in entries.items()}
    inputs, parameters = _constants(parts, entries)
    return System(
        parts=parts,
        connections=links(read.table["connections"], Robot.preset("neck")),
        constants=inputs,
        parameters=parameters,
        duration=number("duration_s", read.table["duration_s"]),
        order=read.table["order"],
    )


def _load_ssp_file(table: Mapping[str, Any], source: Path, robot: str | None) -> LoopSetup:
    """Return the loop of the SSP archive that a loop file names, with the other keys of the file."""
    refuse_unknown("a file with `ssp`", table, _SSP_KEYS)
    keys = {key: value for key, value in table.items() if key not in ("ssp", "robot")}
    setup = _load_ssp_loop(source.parent / str(table["ssp"]), robot or table.get("robot"), None, keys)
    return replace(setup, files={"loop": (str(source), file_hash(source)), **setup.files})


def _load_ssp_loop(
    source: Path, robot: str | None, read: StructureTable | None = None, keys: Mapping[str, Any] | None = None
) -> LoopSetup:
    read = read_ssp(source) if read is None else read
    if not read.closed:
        raise SettingsError(
            f"{source}: is no closed loop of one plant with connected set-points, one controller and one reference; "
            "`softneck simulate` runs it, and `load_ssp` returns it as a system."
        )
    whose = read.table.get("robot") if robot is None else None
    table = {**read.table, **(keys or {}), "robot": whose or find_robot(robot, beside=source)}
    try:
        setup = _setup(table, source.parent)
    except SoftneckError as error:
        raise type(error)(f"{source}: {error}") from error
    return replace(setup, files={"ssp": (str(source), file_hash(source))})


def is_loop_file(path: Path) -> bool:
    """Return whether `path` is a TOML file with a [reference]."""
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        return "reference" in read_toml(path)
    except FileFormatError:
        return False


def reference_of(path: str | Path, *, robot: str | None = None) -> ReferenceBlock:
    """Return the [reference] of a loop file as a block, from which `build_fmu` makes a reference FMU.

    Its sample time is the file's `sample_time_s`, 20 ms by default; the other parts are not opened. References of other
    robots than the neck are tabulated over the file's `duration_s`. `path`: of the file. `robot`: a preset or a robot
    file that replaces the file's `robot` or the one beside it. Raises SettingsError: the reference is an FMU already,
    or invalid.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        opener = PartOpener(source.parent)
        own = opener.robot(table.get("robot") if robot is None else robot, source)
        reference = opener.reference(table["reference"], robot=own)
        if isinstance(reference, AheadReference):
            reference = reference.reference
        if hasattr(reference, "advance"):
            raise SettingsError("[reference] is an FMU already.")
        step, duration = (
            number(key, table.get(key, usual)) for key, usual in (("sample_time_s", 0.02), ("duration_s", 0))
        )
        return ReferenceBlock(reference, sample_time=step, duration=duration or None, robot=own)  # pyright: ignore[reportArgumentType]
    except SoftneckError as error:
        raise type(error)(f"{source}: {error}") from error


def make_loop(table: Mapping[str, Any], folder: str | Path = ".", *, opened: dict[Any, Any] | None = None) -> LoopSetup:
    """Return the loop of a table with the keys of a loop file; relative paths start at `folder`.

    Plant, observer, controller and reference may also be Python objects: a part, a block, an object with `block()` such
    as a model or `VirtualNeck`, the path of an FMU or a file, a reference. `opened` caches files and FMUs between
    loops.

    Raises:
        SettingsError: unknown or missing keys, or invalid values; the message names the key.
    """
    return _setup(normal_table(table), Path(folder), opened)


def _setup(table: Mapping[str, Any], source: Path, opened: dict[Any, Any] | None = None) -> LoopSetup:
    """Return the loop of a normal table; `source` is its file, or the folder where its paths start."""
    refuse_unknown("the file", table, _LOOP_KEYS)
    for key in ("duration_s", "plant", "controller", "reference"):
        if key not in table:
            raise SettingsError(f"`{key}` is missing.")
    folder = source if source.is_dir() else source.parent
    step = number("sample_time_s", table.get("sample_time_s", 0.02))
    if step > 0.0:  # checked before the parts are opened, which takes longer; the run checks it with all columns
        require_steps("duration_s", number("duration_s", table["duration_s"]), step)
    opener = PartOpener(folder / str(table.get("folder", ".")), step=step, opened=opened)
    if not source.is_dir():
        opener.files["loop"] = (str(source), file_hash(source))
    described = {name: table[name] for name in SOURCES if name in table}
    others = _named_parts(table.get("part", []))
    parts = {name: opener.part(name, part) for name, part in described.items()}
    parts |= {name: opener.other(name, part) for name, part in others.items()}
    described |= others
    if "drives" in table:
        opener.drives(table["drives"])
    robot = opener.robot(table.get("robot"), None if source.is_dir() else source)
    _check_fmus(parts, robot)
    parts["plant"] = opener.plant_of(robot, parts["plant"])
    parts = {name: opener.with_robot_names(name, part, robot) for name, part in parts.items()}
    reference = opener.reference(table["reference"], parts["controller"].sample_time, robot)
    if isinstance(reference, FmuPart | IsolatedPart):
        parts["reference"], described["reference"] = reference, table["reference"]
    inputs, parameters = _constants(parts, described)
    loop = Loop(
        plant=parts["plant"],
        observer=parts.get("observer"),
        controller=parts["controller"],
        reference=reference,
        duration=number("duration_s", table["duration_s"]),
        order=table.get("order", "sequential"),
        plant_parameters=parameters.pop("plant"),
        plant_inputs=inputs.pop("plant"),
        observer_parameters=parameters.pop("observer", {}),
        controller_parameters=parameters.pop("controller"),
        other_parameters=parameters,
        other_inputs=inputs,
        others={name: parts[name] for name in others},
        faults=_faults(table.get("fault", []), robot),
        robot=robot,
        connections=links(table.get("connections", {}), robot),
    )
    fastest = min(part.sample_time for part in loop.parts.values())
    if "sample_time_s" in table and abs(step - fastest) > 1e-6 * fastest:  # rounding of decimals in files
        raise SettingsError(f"`sample_time_s` is {step:g}, but the fastest part runs at {fastest:g} s; use that.")
    limits = numbers("[limits]", table.get("limits", {}))
    return LoopSetup(loop=loop, limits=limits, files=dict(opener.files), angle=table.get("angle", "true"))


def _check_fmus(parts: Mapping[str, Part], robot: Robot) -> None:
    """Raise SettingsError if an FMU of softneck has the annotation of another robot."""
    for name, part in parts.items():
        whose, digest = part.annotated_robot if isinstance(part, FmuPart | IsolatedPart) else ("", "")
        if digest and digest != robot.hash:
            raise SettingsError(
                f"[{name}] is an FMU of robot `{whose}` ({digest[:8]}) and the loop of robot {robot.label()}; use "
                "parts of one robot, or name it: `robot` in a loop file, --robot for an SSP file."
            )


def _constants(
    parts: Mapping[str, Part], described: Mapping[str, Any]
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Return constant inputs and parameters by part; the file has both under `parameters`."""
    inputs, parameters = {}, {}
    for name, part in parts.items():
        chosen = numbers(f"[{name}] parameters", described[name].get("parameters", {}))
        ports = {port.name for port in part.inputs}
        inputs[name] = {key: value for key, value in chosen.items() if key in ports}
        parameters[name] = {key: value for key, value in chosen.items() if key not in ports}
    return inputs, parameters


def normal_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a loop's table with a table for each part, as in a loop file."""
    made = dict(table)
    for name in ("plant", "observer", "controller", "reference"):
        value = made.get(name)
        if value is None or isinstance(value, Mapping):
            continue
        text, key = str(value), OBJECT
        if isinstance(value, str | Path) and name != "reference":
            is_file_or_preset = text in PRESETS or text.endswith(".toml")
            own = "file" if name != "plant" else "neck" if is_file_or_preset else "model"
            key, value = "fmu" if text.endswith(".fmu") else own, text
        made[name] = {key: value}
    return {key: value for key, value in made.items() if value is not None}


def _named_parts(listed: Any) -> dict[str, Mapping[str, Any]]:
    named: dict[str, Mapping[str, Any]] = {}
    for table in tables("part", listed):
        name = table.get("name")
        if not isinstance(name, str):
            raise SettingsError("each [[part]] needs a `name`.")
        if name in named:
            raise SettingsError(f"two [[part]] are named `{name}`.")
        named[name] = table
    return named


def _faults(listed: Any, robot: Robot) -> tuple[Fault, ...]:
    faults = []
    for place, table in enumerate(tables("fault", listed), start=1):
        values = {key: value for key, value in table.items() if key != "kind"}
        try:
            faults.append(make_fault(str(table.get("kind", "")), values, robot))
        except SettingsError as error:
            raise SettingsError(f"[[fault]] {place}: {error}") from error
    return tuple(faults)


def find_python(table: Any) -> Iterator[str]:
    """Yield each `python = "package.module:factory"` of a table, at any depth, also for dotted keys of a study."""
    if isinstance(table, Mapping):
        for key, value in table.items():
            if str(key).rpartition(".")[2] == "python":
                yield from _iterate_texts(value)
            else:
                yield from find_python(value)
    elif isinstance(table, list):
        for item in table:
            yield from find_python(item)


def _iterate_texts(value: Any) -> Iterator[str]:
    """Yield the texts in a value: itself, or the choices of a study."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _iterate_texts(item)


def foreign_python(source: Path) -> str:
    """Return the first `python =` of a loop or study file whose module is not in the loop's folder, else ""."""
    table = read_toml(source)
    loop, named = table.get("loop"), list(find_python(table))
    project = source.resolve().parent
    if isinstance(loop, str) and (source.parent / loop).is_file():
        project = (source.parent / loop).resolve().parent
        loop = read_toml(source.parent / loop)
        named += find_python(loop)
    start = loop if isinstance(loop, Mapping) else table
    folder = project / str(start.get("folder", "."))
    return next(
        (path for path in named if not _is_in_project(project, folder, path.partition(":")[0].partition(".")[0])), ""
    )


def require_trusted(source: Path, *, trust: bool) -> None:
    """Raise SettingsError if a loop or study file would run Python from outside its folder, unless `trust`."""
    path = "" if trust else foreign_python(source)
    if path:
        raise SettingsError(
            f"{source}: python = `{path}` is not in the loop's folder and would run with your rights; use --trust to "
            "allow it. Nothing was run."
        )


def _is_in_project(project: Path, folder: Path, package: str) -> bool:
    """Return whether the import of `package`, searched in `folder` first, would run a file of `project`."""
    if package == "softneck":  # runs anyway; loops of worst plants name it
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
