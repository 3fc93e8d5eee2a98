"""A study: one loop, the ranges of its varied keys, the points drawn from them, and its objectives."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    FileFormatError,
    Matrix,
    ReprMixin,
    SettingsError,
    SoftneckError,
    file_hash,
    read_toml,
    refuse_unknown,
)
from softneck.design import own_attributes, own_object
from softneck.loop import Loop, LoopRun, error_unit, metric_names, reference_field
from softneck.robot import Robot, find_robot
from softneck.runtime import Block

from ..loops._loop_file import LoopSetup, load_loop, make_loop, normal_table
from ..loops._loop_parts import OBJECT, SOURCES, PartOpener
from ..loops._loop_table import check_key, loop_table, set_sources, settable, with_values

VARY_KINDS = ("grid", "uniform", "log_uniform", "normal", "choices", "seed")
# Seeds of runs must fit the FMUs' parameter `noise_seed`.
_SEED_RANGE = 2**31 - 2
# At 0.1 s a run on two cores this takes half a day.
_MAX_RUNS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Vary:
    """How one key varies.

    `kind`: "grid" (all values, in all combinations with other grids), "uniform" and "log_uniform" (between two bounds),
    "normal" (mean and standard deviation), "choices" (one of some values), "seed" (of the run). `values`: the values of
    a grid or of choices; two numbers for the other kinds. `labels`: of the values of a grid or of choices in tables.
    """

    kind: str
    values: tuple[Any, ...] = ()
    labels: tuple[Any, ...] = ()

    @property
    def is_grid(self) -> bool:
        """Whether all values are used."""
        return self.kind == "grid"

    def pick(self, u: float) -> tuple[Any, Any]:
        """Return the value at quantile `u` (0 to 1) and its label in tables."""
        from scipy.stats import norm

        if self.kind == "choices":
            i = min(int(u * len(self.values)), len(self.values) - 1)
            return self.values[i], self.labels[i]
        low, high = self.values
        if self.kind == "normal":
            value = float(norm.ppf(u, low, high))
        elif self.kind == "log_uniform":
            value = math.exp(math.log(low) + u * (math.log(high) - math.log(low)))
        else:
            value = low + u * (high - low)
        return value, value


def make_vary(key: str, given: Any) -> Vary:
    """Return the range of `key` from a table such as {"uniform": [0.0, 0.3]}; a plain list is a grid."""
    if isinstance(given, Vary):
        return given
    if isinstance(given, list | tuple):
        given = {"grid": given}
    if not isinstance(given, Mapping) or len(given) != 1 or next(iter(given)) not in VARY_KINDS:
        raise SettingsError(f"[vary] `{key}` needs exactly one of {', '.join(VARY_KINDS)}; got {given!r}.")
    kind, values = next(iter(given.items()))
    if kind == "seed":
        if values is not True:
            raise SettingsError(f"[vary] `{key}`: write seed = true for the seed of the run.")
        return Vary("seed")
    if kind in ("grid", "choices"):
        return _parse_values(key, kind, values)
    return _parse_range(key, kind, values)


def flatten_keys(tables: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield dotted key and range of [vary], from quoted keys or nested tables."""
    for key, value in tables.items():
        if isinstance(value, Mapping) and value and not set(value) & set(VARY_KINDS):
            yield from ((f"{key}.{rest}", inner) for rest, inner in flatten_keys(value))
        else:
            yield key, value


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """One run of a study, with values in the loop and labels in tables by key.

    Runs of one random sample have its seed and differ only in grid values.
    """

    run: int
    sample: int
    seed: int
    values: Mapping[str, Any]
    labels: Mapping[str, Any]


class StudyPoints:
    """The points of a study: all samples at all points of the grid; they depend on the seed alone."""

    def __init__(self, vary: Mapping[str, Vary], runs: int | None, seed: int) -> None:
        """Draw the samples."""
        if not vary:
            raise SettingsError("the study varies nothing: give [vary] at least one key.")
        self._vary = vary
        grids = [[(key, i) for i in range(len(item.values))] for key, item in vary.items() if item.is_grid]
        size = math.prod(map(len, grids))
        if size > _MAX_RUNS:
            raise SettingsError(f"the grid has {size} points; at most {_MAX_RUNS} fit. Make it smaller, or draw.")
        self._grid = list(product(*grids))
        drawn = [key for key, item in vary.items() if item.kind not in ("grid", "seed")]
        random = bool(drawn) or any(item.kind == "seed" for item in vary.values())
        self.runs = _number_of_runs(runs, len(self._grid), random=random)
        samples = -(-self.runs // len(self._grid))
        self._drawn = dict(zip(drawn, _quantiles(samples, len(drawn), seed).T, strict=True))
        states = np.random.SeedSequence(seed).generate_state(samples, np.uint64)
        self._seeds = (states % _SEED_RANGE).astype(np.int64)

    def __len__(self) -> int:
        return self.runs

    def __getitem__(self, run: int) -> Point:
        sample, place = divmod(run, len(self._grid))
        seed = int(self._seeds[sample])
        chosen = dict(self._grid[place])
        values, labels = {}, {}
        for key, item in self._vary.items():
            if item.is_grid:
                values[key], labels[key] = item.values[chosen[key]], item.labels[chosen[key]]
            elif item.kind == "seed":
                values[key] = labels[key] = seed
            else:
                values[key], labels[key] = item.pick(float(self._drawn[key][sample]))
        return Point(run, sample, seed, values, labels)


def _number_of_runs(runs: int | None, grid: int, *, random: bool) -> int:
    if runs is None:
        if random:
            raise SettingsError("`runs` is missing; only a study of grids alone does not need it.")
        return grid
    if isinstance(runs, bool) or not isinstance(runs, int) or not 1 <= runs <= _MAX_RUNS:
        raise SettingsError(f"`runs` must be a whole number between 1 and {_MAX_RUNS}; got {runs!r}.")
    if not random and runs != grid:
        raise SettingsError(f"the grid has {grid} points and nothing is random, but `runs` is {runs}; leave it out.")
    if runs < grid:
        raise SettingsError(f"the grid has {grid} points; `runs` is {runs}: raise `runs`, or reduce the grid.")
    return runs


def _quantiles(samples: int, keys: int, seed: int) -> Matrix:
    """Return a Latin hypercube (samples, keys) between 0 and 1, without these ends."""
    from scipy.stats import qmc

    if keys == 0:
        return np.zeros((samples, 0))
    drawn = qmc.LatinHypercube(keys, rng=np.random.default_rng(seed)).random(samples)
    return np.clip(drawn, 1e-12, 1.0 - 1e-12)


def _parse_values(key: str, kind: str, values: Any) -> Vary:
    if isinstance(values, Mapping):
        labels, chosen = tuple(map(str, values)), tuple(values.values())
    elif isinstance(values, list | tuple):
        chosen = tuple(values)
        labels = _labels(chosen)
    else:
        raise SettingsError(f"[vary] `{key}`: {kind} takes a list of values; got {values!r}.")
    if not chosen:
        raise SettingsError(f"[vary] `{key}`: the {kind} is empty; give it values.")
    if len(set(map(repr, labels))) < len(labels):
        raise SettingsError(f"[vary] `{key}`: the {kind} has a value twice: {', '.join(map(str, labels))}.")
    return Vary(kind, chosen, labels)


def _labels(values: Sequence[Any]) -> tuple[Any, ...]:
    """Return labels for tables: the value itself, the file of a table, the kind of an object."""
    plain = [value if isinstance(value, bool | int | float | str) else _name(value) for value in values]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in plain):
        return tuple(plain)
    names = [str(value) for value in plain]
    return tuple(f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names))


def _name(value: Any) -> str:
    if isinstance(value, Mapping):
        texts = [str(item) for item in value.values() if isinstance(item, str)]
        return texts[0] if texts else ", ".join(f"{key} = {item}" for key, item in value.items())
    return str(getattr(value, "kind", "") or type(value).__name__)


def _parse_range(key: str, kind: str, values: Any) -> Vary:
    numbers = isinstance(values, list | tuple) and len(values) == 2 and all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )  # fmt: skip
    if not numbers:
        raise SettingsError(f"[vary] `{key}`: {kind} takes two numbers; got {values!r}.")
    low, high = float(values[0]), float(values[1])
    if kind == "normal":
        if not high > 0.0:
            raise SettingsError(f"[vary] `{key}`: the standard deviation must be positive; got {high:g}.")
    elif not low < high:
        raise SettingsError(
            f"[vary] `{key}`: the {kind} range from {low:g} to {high:g} is empty; write the lower bound first."
        )
    elif kind == "log_uniform" and low <= 0.0:
        raise SettingsError(f"[vary] `{key}`: log_uniform needs positive bounds; got {low:g}.")
    return Vary(kind, (low, high))


_STUDY_KEYS = ("loop", "runs", "seed", "objectives", "dask", "vary")
Source = str | Path | Mapping[str, Any] | Loop | LoopSetup


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Study(ReprMixin):
    """Many runs of one loop; a study file describes one, `study` runs it.

    Attributes:
        loop: the table of a loop, as in a loop file.
        vary: dotted key -> its range.
        runs: number of runs; None for all points of the grids.
        seed: of all random values.
        objectives: metrics to minimise; the first one ranks, all of them span the Pareto front.
        folder: where relative paths of the loop start.
        name: for titles.
        dask: address of a Dask scheduler, such as tcp://head:8786, which `workers` override.
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
                listed = ", ".join(self.metrics)
                raise SettingsError(f"`{metric}` is not a metric that can be an objective; use some of {listed}.")
        if not self.objectives:
            raise SettingsError("`objectives` is empty; name at least one metric.")

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """The names of the metrics of a run."""
        return metric_names(_robot_of(self.loop, self.vary, self.folder))

    @cached_property
    def points(self) -> StudyPoints:
        """The points of all runs, with their values in the loop."""
        return StudyPoints(self.vary, self.runs, self.seed)

    def table(self, run: int) -> dict[str, Any]:
        """Return the loop of one run, as the table of a loop file."""
        if not 0 <= run < len(self.points):
            raise SettingsError(f"the study has runs 0 to {len(self.points) - 1}; there is no run {run}.")
        return with_values(self.loop, self.points[run].values)

    def setup(self, run: int) -> LoopSetup:
        """Return the loop of one run, ready for `simulate`."""
        return make_loop(self.table(run), self.folder)

    def check(self) -> None:
        """Open the loop of the first run with each part in turn, and check that it has all keys."""
        first = self.points[0].values
        kinds = {key: value for key, value in first.items() if set_sources(key)}
        turns: list[dict[str, Any]] = [kinds]
        turns += [{**kinds, key: value} for key in kinds for value in self.vary[key].values]
        names: dict[str, set[str] | None] = {}
        for turn in turns:
            setup = make_loop(with_values(self.loop, turn), self.folder)
            for name, part in setup.loop.parts.items():
                more = settable(part)
                names[name] = None if more is None else (names.get(name) or set()) | more
        table = with_values(self.loop, kinds)
        loop = make_loop(table, self.folder).loop
        for key in self.vary:
            check_key(table, key, names, loop.robot)
        LoopRun(loop)

    def description(self) -> dict[str, Any]:
        """Return the study as JSON values, with the hash of each of its files."""
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
        """A hash of all settings and files that the results depend on."""
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

    Default objectives are the error of the axis that the reference moves, and the total variation of the motors.

    Raises:
        SettingsError: an empty or contradictory range, or an unknown metric.
        FileFormatError: no such loop file.
    """
    table, start = _open_loop(loop)
    chosen = {key: make_vary(key, given) for key, given in flatten_keys(vary)}
    start = Path(folder) if folder else start
    return Study(
        loop=table, vary=chosen, runs=runs, seed=seed, folder=start, name=name, dask=dask,
        objectives=tuple(objectives) if objectives else _objectives(table, _robot_of(table, chosen, start)),
    )  # fmt: skip


def load_study(path: str | Path) -> Study:
    """Read a study file; relative paths start at its folder.

    Raises:
        FileFormatError: no such file, or not TOML.
        SettingsError: unknown or missing keys, an empty or contradictory range.
    """
    source = Path(path)
    table = read_toml(source)
    try:
        made = _from_table(source, table)
        len(made.points)  # raises for an impossible number of runs
        return made
    except SoftneckError as error:
        raise (error if str(error).startswith(str(source)) else type(error)(f"{source}: {error}")) from error


def _from_table(source: Path, table: Mapping[str, Any]) -> Study:
    refuse_unknown("a study", table, _STUDY_KEYS)
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


def _open_loop(loop: Source) -> tuple[Mapping[str, Any], Path]:
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
    """Return a loop file's table, with the robot beside the file if no part has a robot; runs do not have the file."""
    parts = [*(table.get(name) for name in SOURCES), *table.get("part", [])]
    if "robot" in table or any({"model", "file"} & set(part or ()) for part in parts):
        return table
    file = find_robot(beside=path).file
    if file is None:
        return table
    return {**table, "robot": os.path.relpath(file, path.resolve().parent / str(table.get("folder", ".")))}


def _robot_of(table: Mapping[str, Any], vary: Mapping[str, Vary], folder: Path) -> Robot:
    """Return the robot of the table and its first files, or the neck; `Study.check` reports errors in them."""
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
    """Return the error of the first output in the reference, or else in the limits, and the motors' total variation."""
    reference = table.get("reference", {})
    moving = {
        reference_field(str(reference.get("kind")), key, robot)
        for key, value in reference.items()
        if value and key != "kind"
    }
    limited = {name.partition(".")[0] for name in table.get("limits", {})}
    names = robot.outputs.names
    axis = next((name for group in (moving, limited) for name in names if name in group), names[0])
    variation = next(name for name in metric_names(robot) if name.startswith("motors.total_variation_"))
    return (f"{axis}.rms_error_{error_unit(robot)[0]}", variation)


def _texts(value: Any) -> list[str]:
    """Return all texts in nested tables and lists."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, Mapping):
        value = list(value.values())
    return [text for item in value for text in _texts(item)] if isinstance(value, list | tuple) else []


def _plain(value: Any) -> Any:
    """Return `value` as JSON; a part that is not a file becomes a hash of its content."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    block = value.block() if callable(getattr(value, "block", None)) else value
    if own_object(value) is not value:
        return {OBJECT: type(value).__qualname__, "attributes": repr(own_attributes(value))}
    if not isinstance(block, Block):
        return {OBJECT: f"{type(value).__module__}.{type(value).__qualname__}"}
    text = repr((block.kind, block.runtime, block.sample_time, block.inputs, block.outputs, block.parameters))
    content = hashlib.sha256(text.encode() + b"".join(array.tobytes() for array in block.arrays)).hexdigest()
    return {OBJECT: block.kind, "sha256": content}
