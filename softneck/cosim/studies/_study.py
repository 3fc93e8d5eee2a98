"""A study: one loop, what varies in it, how often, and what is asked of the runs."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, ReprMixin, SettingsError, SoftneckError, file_hash
from softneck.design import own_attributes, own_controller
from softneck.loop import Loop, LoopRun, metric_names, reference_key, shown_unit
from softneck.robot import Robot, find_robot
from softneck.runtime import Block

from ..loops._loop_file import LoopSetup, load_loop, make_loop, normal_table
from ..loops._loop_parts import OBJECT, SOURCES, PartOpener, read_toml
from ..loops._loop_table import check_key, loop_table, set_sources, settable, with_values
from ._vary import StudyPoints, Vary, flattened, make_vary

_TOP = ("loop", "runs", "seed", "objectives", "dask", "vary")
Source = str | Path | Mapping[str, Any] | Loop | LoopSetup


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Study(ReprMixin):
    """Many runs of one loop; a study file describes one, `study` runs it.

    Attributes:
        loop: the table of a loop, as in a loop file.
        vary: dotted key -> how it varies.
        runs: how many; None for all points of the grids.
        seed: of everything that is drawn.
        objectives: metrics to be small; the first one ranks, all of them span the Pareto front.
        folder: where relative paths of the loop start.
        name: for titles.
        dask: address of a Dask scheduler that runs it, such as tcp://head:8786, unless `workers` are asked for.
    """

    loop: Mapping[str, Any]
    vary: Mapping[str, Vary]
    runs: int | None = None
    seed: int = 0
    objectives: tuple[str, ...] = ("pitch.rms_error_deg", "motors.total_variation_rad")
    folder: Path = field(default_factory=Path.cwd)
    name: str = "study"
    dask: str | None = None

    def __post_init__(self) -> None:
        if self.dask is not None and (not isinstance(self.dask, str) or "://" not in self.dask):
            raise SettingsError(f"`dask` must be a scheduler's address, such as tcp://head:8786; got {self.dask!r}.")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise SettingsError(f"`seed` must be a whole number that is not negative; got {self.seed!r}.")
        for metric in self.objectives:
            if metric not in self.metrics:
                raise SettingsError(
                    f"`{metric}` is not a metric that can be an objective; use some of {', '.join(self.metrics)}."
                )
        if not self.objectives:
            raise SettingsError("`objectives` is empty; name at least one metric.")

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """The names of all that a run is judged by."""
        return metric_names(_robot_of(self.loop, self.vary, self.folder))

    @cached_property
    def points(self) -> StudyPoints:
        """The runs: what each puts into the loop."""
        return StudyPoints(self.vary, self.runs, self.seed)

    def table(self, run: int) -> dict[str, Any]:
        """Return the loop of one run, as the table of a loop file."""
        if not 0 <= run < len(self.points):
            raise SettingsError(f"the study has runs 0 to {len(self.points) - 1}; there is no run {run}.")
        return with_values(self.loop, self.points[run].values)

    def setup(self, run: int, *, opened: dict[Any, Any] | None = None) -> LoopSetup:
        """Return the loop of one run, ready for `simulate`."""
        return make_loop(self.table(run), self.folder, opened=opened)

    def check(self) -> None:
        """Open the loop of the first run with each part in turn, and find every key in it.

        Raises:
            SettingsError: a key that the loop does not have, or a loop that cannot be.
        """
        first = self.points[0].values
        kinds = {key: value for key, value in first.items() if set_sources(key)}
        turns: list[dict[str, Any]] = [kinds]
        turns += [{**kinds, key: value} for key in kinds for value in self.vary[key].values]
        names: dict[str, set[str] | None] = {}
        table = with_values(self.loop, kinds)
        for key in self.vary:
            if set_sources(key):
                check_key(table, key, {})
        for turn in turns:
            table = with_values(self.loop, turn)
            setup = make_loop(table, self.folder)
            for name, part in setup.loop.parts.items():
                more = settable(part)
                names[name] = None if more is None else (names.get(name) or set()) | more
        loop = make_loop(with_values(self.loop, kinds), self.folder).loop
        for key in self.vary:
            check_key(table, key, names, loop.robot)
        LoopRun(loop)

    def description(self) -> dict[str, Any]:
        """Return what the study is, as JSON values, with the hash of every file that it names."""
        files = sorted(set(_texts([self.loop, [v.values for v in self.vary.values()]])))
        hashes = {name: file_hash(self.folder / name) for name in files if (self.folder / name).is_file()}
        return {
            "loop": _plain(self.loop),
            "vary": {
                key: {"kind": v.kind, "values": _plain(v.values), "labels": list(v.labels)}
                for key, v in self.vary.items()
            },
            "runs": len(self.points),
            "seed": self.seed,
            "files": hashes,
        }

    @property
    def digest(self) -> str:
        """A hash of all that decides the numbers."""
        return hashlib.sha256(json.dumps(self.description(), sort_keys=True).encode()).hexdigest()


def make_study(
    loop: Source,
    *,
    vary: Mapping[str, Any],
    runs: int | None = None,
    seed: int = 0,
    objectives: Sequence[str] | None = None,
    name: str = "study",
    folder: str | Path | None = None,
    dask: str | None = None,
) -> Study:
    """Return a study of `loop`: a loop file, its table, or a loop; `vary` is as [vary] in a study file.

    Without `objectives` they are the error of the axis that the reference is about, and the moves of the motors.

    Raises:
        SettingsError: an empty or contradictory range, or no such metric.
        FileFormatError: no such loop file.
    """
    table, start = _opened(loop)
    chosen = {key: make_vary(key, given) for key, given in flattened(vary)}
    start = Path(folder) if folder else start
    return Study(
        loop=table, vary=chosen, runs=runs, seed=seed, folder=start, name=name, dask=dask,
        objectives=tuple(objectives) if objectives else _objectives(table, _robot_of(table, chosen, start)),
    )  # fmt: skip


def load_study(path: str | Path) -> Study:
    """Read a study file; its loop file is looked for beside it.

    Raises:
        FileFormatError: no such file or no TOML.
        SettingsError: unknown or missing keys, an empty or contradictory range.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        made = _from_table(source, table)
        len(made.points)  # numbers of runs that cannot be are the file's fault too
        return made
    except SoftneckError as error:
        raise (error if str(error).startswith(str(source)) else type(error)(f"{source}: {error}")) from error


def _from_table(source: Path, table: Mapping[str, Any]) -> Study:
    for key in table:
        if key not in _TOP:
            raise SettingsError(f"unknown key `{key}` of a study; it takes {', '.join(_TOP)}.")
    if "loop" not in table:
        raise SettingsError("`loop` is missing: name the loop file.")
    if not isinstance(table.get("vary", {}), dict):
        raise SettingsError("`vary` must be a table: [vary].")
    rest = {key: table[key] for key in ("runs", "seed", "objectives", "dask") if key in table}
    loop = table["loop"]
    if isinstance(loop, str):
        loop = source.parent / loop
    return make_study(
        loop, vary=table.get("vary", {}), name=source.stem,
        folder=source.parent if isinstance(loop, Mapping) else None, **rest,
    )  # fmt: skip


def _opened(loop: Source) -> tuple[Mapping[str, Any], Path]:
    if isinstance(loop, str | Path):
        path = Path(loop)
        if not path.is_file():
            raise FileFormatError(f"there is no loop file {path}.")
        table = {} if path.suffix == ".ssp" else read_toml(path)
        if path.suffix == ".ssp" or "ssp" in table:
            return loop_table(load_loop(path)), path.parent.resolve()
        return _with_robot(table, path), path.parent.resolve()
    if isinstance(loop, Loop | LoopSetup):
        return loop_table(loop), Path.cwd()
    if not isinstance(loop, Mapping):
        raise SettingsError(f"`loop` must be a loop file or a table of its keys; got {loop!r}.")
    return normal_table(loop), Path.cwd()


def _with_robot(table: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a loop file's table with the robot beside it where no part can say whose it is: runs know no file."""
    parts = [*(table.get(name) for name in SOURCES), *table.get("part", [])]
    if "robot" in table or any({"model", "file"} & set(part or ()) for part in parts):
        return table
    file = find_robot(beside=path).file
    if file is None:
        return table
    return {**table, "robot": os.path.relpath(file, path.resolve().parent / str(table.get("folder", ".")))}


def _robot_of(table: Mapping[str, Any], vary: Mapping[str, Vary], folder: Path) -> Robot:
    """Return whose loop it is, as the table and its first files say; what is wrong with them `Study.check` says."""
    opener = PartOpener(folder / str(table.get("folder", ".")))
    try:
        made = with_values(table, {key: vary[key].values[0] for key in vary if set_sources(key)})
        for name in SOURCES:
            if {"model", "file", OBJECT} & set(made.get(name, ())):
                opener.part(name, made[name])
        return opener.robot(table.get("robot"), None)
    except (SoftneckError, OSError, TypeError):
        return Robot.preset()


def _objectives(table: Mapping[str, Any], robot: Robot) -> tuple[str, ...]:
    """Return the error of the first output that the reference is about, or else the limits, and the motors' moves."""
    reference = table.get("reference", {})
    stated = {_asked(reference, key, robot) for key, value in reference.items() if value and key != "kind"}
    limited = {name.partition(".")[0] for name in table.get("limits", {})}
    names = robot.outputs.names
    axis = next((name for asked in (stated, limited) for name in names if name in asked), names[0])
    moved = next(name for name in metric_names(robot) if name.startswith("motors.total_variation_"))
    return (f"{axis}.rms_error_{shown_unit(robot)[0]}", moved)


def _asked(reference: Mapping[str, Any], key: str, robot: Robot) -> str:
    """Return the output that a key of [reference] is about; "" where it is about something else."""
    try:
        return reference_key(str(reference.get("kind")), key, robot)[0]
    except (KeyError, SettingsError):
        return ""


def _texts(value: Any) -> list[str]:
    """Return all texts in nested tables and lists."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        value = list(value.values())
    return [text for item in value for text in _texts(item)] if isinstance(value, list | tuple) else []


def _plain(value: Any) -> Any:
    """Return `value` as JSON; of a part that is not a file, a hash of what it does."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    block = value.block() if callable(getattr(value, "block", None)) else value
    if own_controller(value) is not value:
        return {OBJECT: type(value).__qualname__, "attributes": repr(own_attributes(value))}
    if not isinstance(block, Block):
        return {OBJECT: f"{type(value).__module__}.{type(value).__qualname__}"}
    text = repr((block.kind, block.runtime, block.sample_time, block.inputs, block.outputs, block.parameters))
    content = hashlib.sha256(text.encode() + b"".join(array.tobytes() for array in block.arrays)).hexdigest()
    return {OBJECT: block.kind, "sha256": content}
