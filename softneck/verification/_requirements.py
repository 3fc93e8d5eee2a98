"""Read and check the requirements file; defaults fill the rest."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from softneck.core import (
    FileFormatError,
    ReprMixin,
    SettingsError,
    did_you_mean,
    read_toml,
    require_between,
    require_whole,
    sim_name,
    to_si,
)
from softneck.loop import default_limits
from softneck.robot import Robot

from ._linear import LARGE
from ._metrics import Scale, metric_names, round_12_digits
from ._steps import StepTest


def select_for_verify(own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a file that `verify` uses: limits less safety margins, without [track]."""
    found = {name: table for name, table in own.items() if name not in ("track", "reserve")}
    kept, _ = apply_safety_margin(found.get("require", {}), own.get("reserve", {}))
    return found | {"require": {metric: entry for metric, entry in kept.items() if not metric.startswith("track.")}}


def apply_safety_margin(require: Mapping[str, Any], reserve: Any) -> tuple[dict[str, Any], dict[str, float]]:
    """Subtract the safety margins of [reserve]; return the requirements and the margins used."""
    if not isinstance(reserve, Mapping):
        raise SettingsError("`reserve` must be a table: [reserve].")
    if not isinstance(require, Mapping):
        raise SettingsError("`require` must be a table: [require].")
    less, kept = dict(require), {}
    for metric, value in reserve.items():
        if not metric.startswith(("sim.", "track.")):
            raise SettingsError(
                f"[reserve] takes metrics of loops over simulation models, `sim.*` and `track.*`; got `{metric}`."
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise SettingsError(f"the reserve of `{metric}` must be a number from 0 on; got {value!r}.")
        if metric not in require:
            raise SettingsError(
                f"[reserve] has a safety margin for `{metric}`, which [require] does not limit; state its limit there."
            )
        entry = require[metric]
        limit = entry.get("max") if isinstance(entry, Mapping) else None
        if isinstance(limit, bool) or not isinstance(limit, int | float) or limit < 0.0 or value == 0.0:
            continue  # dropped, or refused when the limit is read
        if limit - value <= 0.0:
            raise SettingsError(
                f"`{metric}` <= {limit:g} is not above its safety margin of {value:g}; raise the limit, or lower "
                f"the margin ([reserve])."
            )
        less[metric] = {**entry, "max": round_12_digits(limit - value)}
        kept[metric] = float(value)
    return less, kept


_T = TypeVar("_T")
DEFAULT_FILE = Path(__file__).with_name("requirements.toml")
VERSION = 1
# Tables of requirements files of `verify` and `tune`.
_TABLE_NAMES = ("version", "uncertainty", "sampling", "step", "sim", "require", "track", "reserve")


def expand_metrics(table: Mapping[str, Any], robot: Robot, *, stepping: bool, track: bool = False) -> dict[str, Any]:
    """Expand a flat table such as `{"overshoot_pct": 5}` to one like a requirements file.

    A metric without a group belongs to the simulation models if there are any, else to the linear plants, or to the
    only group that has it. A number is a lower bound of a margin and an upper bound of other metrics.
    """
    table = rename_neck_table(table, robot)
    order = ("sim", "step", "track") if stepping else ("step", "track")
    known = metric_names(robot, track=track)
    nested: dict[str, Any] = {key: value for key, value in table.items() if key in _TABLE_NAMES}
    for key, value in table.items():
        if key in _TABLE_NAMES:
            continue
        full = [key, *(f"{group}.{key}" for group in (*order, "axes", "robust", "mimo", "stability"))]
        metric = next((name for name in full if name in known), None)
        if metric is None:
            if isinstance(value, Mapping):
                nested[key] = value  # an unknown table, which is refused below
                continue
            ends = sorted({name.partition(".")[2] for name in known})
            hint = did_you_mean(str(key), ends)
            raise SettingsError(f"unknown requirement `{key}`; {hint}use one of {', '.join(ends)}.")
        bound = "min" if metric.rpartition(".")[2] in LARGE else "max"
        entry = value if value is False or isinstance(value, Mapping) else {bound: value}
        require = nested.get("require", {})
        if not isinstance(require, Mapping):
            raise SettingsError("`require` must be a table: [require].")
        nested["require"] = {**require, metric: entry}
    return nested


def rename_neck_table(table: Mapping[str, Any], robot: Robot) -> dict[str, Any]:
    """Rename `neck` of files up to softneck 0.2 to `sim`."""
    if "neck" in robot.outputs.names:
        return dict(table)
    found = {sim_name(key): value for key, value in table.items()}
    for name in ("require", "reserve"):
        if isinstance(inside := found.get(name), Mapping):
            found[name] = {sim_name(key): value for key, value in inside.items()}
    return found


# Smallest and largest possible value of a metric.
_POSSIBLE = {"sensitivity": (1.0, math.inf), "disk_margin": (0.0, 2.0), "gain_margin": (1.0, math.inf)}
_BOUND_NAMES = ("min", "max", "below")
# Number -> minimum, maximum, unit.
_NUMBERS: dict[str, dict[str, tuple[float, float, str]]] = {
    "uncertainty": {
        "gain_pct": (0.0, 95.0, "%"), "pole_pct": (0.0, 95.0, "%"), "delay_ms": (0.0, 1e9, "ms"),
        "rolloff_db_per_decade": (-1.0, 200.0, "dB"),
    },
    "sampling": {"plants": (1, 100_000, ""), "search_generations": (0, 10_000, ""), "seed": (0, 2**31 - 2, "")},
    "step": {
        "size_deg": (0.01, 45.0, "deg"), "duration_s": (1e-3, 1e6, "s"), "noise_deg": (0.0, 10.0, "deg"),
        "load_rad": (-6.0, 6.0, "rad"),
    },
    "sim": {
        "necks": (0, 1000, ""), "spread_pct": (0.0, 50.0, "%"), "size_deg": (0.01, 45.0, "deg"),
        "duration_s": (1e-3, 1e6, "s"), "taut_up_to_kg": (0.0, 5.0, "kg"),
    },
}  # fmt: skip
_INTEGER_KEYS = ("plants", "search_generations", "seed", "necks")


@dataclass(frozen=True, slots=True)
class Requirement:
    """One bound on one metric.

    `metric`: such as `axes.sensitivity`. `bound`: "min", "max" or "below" (which excludes the limit itself). `limit`:
    for the worst plant. `asked`: whether the user states it; a default of simulated loops that no plant shows
    does not decide.
    """

    metric: str
    bound: str
    limit: float
    asked: bool

    def holds(self, value: float) -> bool:
        """Return whether `value` meets the bound; NaN does not."""
        if self.bound == "min":
            return value >= self.limit
        return value < self.limit if self.bound == "below" else value <= self.limit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Requirements(ReprMixin):
    """Requirements of a verification and the settings of its tests.

    Attributes:
        bounds: in the order of the file.
        uncertainty, sampling, step, sim: tables of the file under the neck's key names; `_deg` and `_rad` stand for
            the units of the robot's outputs and motors.
        scale: of the defaults.
        own: the user's file.
    """

    bounds: tuple[Requirement, ...]
    uncertainty: Mapping[str, Any]
    sampling: Mapping[str, Any]
    step: Mapping[str, Any]
    sim: Mapping[str, Any]
    scale: Scale = field(default_factory=Scale)
    own: Mapping[str, Any] = field(default_factory=dict)

    @property
    def robot(self) -> Robot:
        """The robot of the controller."""
        return self.scale.robot

    @property
    def tables(self) -> tuple[Any, ...]:
        """All that a test needs: no limits, and not which of the values the user stated."""
        return self.uncertainty, self.sampling, self.step, self.sim, self.scale

    def step_test(self, seed: int) -> StepTest:
        """Return the step test on linear plants."""
        load = to_si(self.robot.motors.unit)[0] * float(self.step["load_rad"])
        return StepTest(
            step=self.scale.si(self.step["size_deg"]), duration=float(self.step["duration_s"]),
            noise=self.scale.si(self.step["noise_deg"]), load=load, seed=seed,
        )  # fmt: skip

    def table(self, name: str) -> dict[str, Any]:
        """Return a table under the robot's key names."""
        return {self.scale.name_of(key): value for key, value in getattr(self, name).items()}

    def at(self, scale: Scale) -> Requirements:
        """Return the requirements with defaults of a scale, unless this robot's scale is known already."""
        kept = scale.robot.hash == self.robot.hash and self.scale.known
        return self if kept else make_requirements(self.own, scale=scale)

    def over_draws(self) -> Requirements:
        """Return the requirements where draws decide: the error under the load is one of their loops too."""
        load, simulated = (self.scale.name_of(f"{group}.load_rms_deg") for group in ("step", "sim"))
        if simulated in self.own.get("require", {}):
            return self
        more = [replace(item, metric=simulated) for item in self.bounds if item.metric == load]
        return replace(self, bounds=(*self.bounds, *more))


def read_requirements(
    path: str | Path | None = None, *, robot: Robot | None = None, scale: Scale | None = None
) -> Requirements:
    """Return the requirements of a file, with defaults for the rest.

    Keys and metrics use the units of the robot, such as `size_mm` and `step.load_rms_mm`.

    Args:
        path: of the file.
        robot: of the controller; None: the neck.
        scale: of the defaults; None: from the robot alone.

    Raises:
        FileFormatError: no such file, no TOML, another version.
        SettingsError: an unknown key or metric, a value out of range, or bounds that contradict each other.
    """
    return read_file(path, partial(make_requirements, robot=robot, scale=scale))


def read_file(path: str | Path | None, make: Callable[[Mapping[str, Any]], _T]) -> _T:
    """Call `make` with the tables of a file, or with none; its errors name the file."""
    if path is None:
        return make({})
    if not isinstance(path, str | Path):
        raise SettingsError(f"requirements are a file or a table; got a {type(path).__name__}.")
    table = _read(Path(path))
    try:
        return make(table)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def make_requirements(
    table: Mapping[str, Any], *, robot: Robot | None = None, scale: Scale | None = None
) -> Requirements:
    """Return the requirements of a table like a requirements file, with defaults for the rest."""
    scale = scale or Scale.of(robot or Robot.preset())
    said = {"version": VERSION, **rename_neck_table(table, scale.robot)}
    own, defaults = select_for_verify(said), tomllib.loads(default_text())
    for key in own:
        if key not in ("version", *_NUMBERS, "require"):
            raise SettingsError(f"unknown table `{key}` of a requirements file; it has {', '.join(_NUMBERS)}, require.")
    tables: Any = {name: _table(name, defaults[name], own.get(name, {}), scale) for name in _NUMBERS}
    bounds = _bounds(scale.table(defaults["require"]), own["require"], scale.robot)
    _refuse_contradictions(bounds, scale.robot)
    _refuse_weak(bounds, tables, scale)
    return Requirements(bounds, **tables, scale=scale, own=said)


def default_text() -> str:
    """Return the defaults as a requirements file."""
    return DEFAULT_FILE.read_text(encoding="utf-8") + default_limits.as_toml(default_limits.VERIFY)


def _read(source: Path) -> dict[str, Any]:
    table = read_toml(source, "name a requirements file (.toml)")
    if table.get("version") != VERSION:
        raise FileFormatError(
            f"{source}: `version` must be {VERSION}, the version of requirements that this softneck reads; "
            f"got {table.get('version')}."
        )
    return table


def _table(name: str, defaults: Mapping[str, Any], own: Any, scale: Scale) -> dict[str, Any]:
    if not isinstance(own, Mapping):
        raise SettingsError(f"`{name}` must be a table: [{name}].")
    inside = {scale.name_of(key): key for key in defaults}
    found = dict(zip(defaults, scale.table(defaults).values(), strict=True))
    for given, value in own.items():
        if given not in inside:
            raise SettingsError(f"unknown key `{given}` of [{name}]; it takes {', '.join(inside)}.")
        key = inside[given]
        found[key] = value
        if key in _NUMBERS[name]:
            check_number(f"[{name}] {given}", value, key, _NUMBERS[name][key], scale)
        elif isinstance(defaults[key], list):
            if not isinstance(value, list) or not value:
                raise SettingsError(f"`[{name}] {key}` must be a list of numbers; got {value!r}.")
            for number in value:
                check_number(f"[{name}] {key}", number, key, (0.0, 5.0 if key == "payloads_kg" else 360.0, ""), scale)
        elif isinstance(defaults[key], bool):
            if not isinstance(value, bool):
                raise SettingsError(f"`[{name}] {key}` must be true or false; got {value!r}.")
        elif not isinstance(value, str):
            raise SettingsError(f"`[{name}] {key}` must be a text; got {value!r}.")
    return found


def check_number(name: str, value: Any, key: str, ends: tuple[float, float, str], scale: Scale) -> None:
    """Raise SettingsError unless a value is a number within the neck's limits, scaled to the robot."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"`{name}` must be a number; got {value!r}.")
    low, high, unit = ends
    if key in _INTEGER_KEYS:
        require_whole(name, value, int(low), int(high))
    own = scale.name_of(key)
    if own != key or scale.factor(key) != 1.0:
        size, unit = scale.factor("size_deg" if key == "noise_deg" else key), own.rpartition("_")[2]
        low, high = (size * low, size * high) if scale.known else (-math.inf if low < 0.0 else 0.0, math.inf)
    require_between(name, float(value), low, high, unit)


def _bounds(defaults: Mapping[str, Any], own: Any, robot: Robot) -> tuple[Requirement, ...]:
    require = {metric: entry for metric, entry in {**defaults, **own}.items()
               if metric != "sim.slack_s" or metric in own or robot.tendon_angles is not None}  # fmt: skip
    found = bounds_of(require, metric_names(robot), own)
    if not found:
        raise SettingsError("there is no requirement; a certificate needs at least one.")
    return found


def bounds_of(require: Mapping[str, Any], names: tuple[str, ...], own: Any) -> tuple[Requirement, ...]:
    """Return the bounds of a table; `names`: all metrics, `own`: those the user states."""
    found = []
    for metric, entry in require.items():
        if metric not in names:
            raise SettingsError(f"unknown metric `{metric}`; [require] takes {', '.join(names)}.")
        if entry is False:
            continue
        if not isinstance(entry, Mapping) or not entry or any(key not in _BOUND_NAMES for key in entry):
            raise SettingsError(
                f"`{metric}` must be {{ min = NUMBER }}, {{ max = NUMBER }}, both, or false; got {entry!r}."
            )
        for bound, limit in entry.items():
            if isinstance(limit, bool) or not isinstance(limit, int | float) or not math.isfinite(limit):
                raise SettingsError(f"the limit of `{metric}` must be a finite number; got {limit!r}.")
            found.append(Requirement(metric, bound, float(limit), metric in own))
    return tuple(found)


def _refuse_contradictions(bounds: tuple[Requirement, ...], robot: Robot) -> None:
    low: dict[str, float] = {}
    high: dict[str, float] = {}
    for item in bounds:
        # A bound on the worst axis applies to every axis.
        group, _, name = item.metric.partition(".")
        both = [f"{axis}.{name}" for axis in robot.outputs.names]
        for metric in both if group == "axes" else (item.metric,):
            if item.bound == "min":
                low[metric] = max(low.get(metric, -math.inf), item.limit)
            else:
                high[metric] = min(high.get(metric, math.inf), item.limit)
        least, most = _POSSIBLE.get(name, (0.0, math.inf))
        if (item.bound == "min" and item.limit > most) or (item.bound != "min" and item.limit < least):
            raise SettingsError(
                f"no loop has `{item.metric}` {item.bound} {item.limit:g}; its range is {least:g} to {most:g}."
            )
    for metric in low:
        if low[metric] > high.get(metric, math.inf):
            raise SettingsError(f"`{metric}` cannot be at least {low[metric]:g} and at most {high[metric]:g}.")
    for group in ("step", "sim"):
        rise, settling = low.get(f"{group}.rise_s", 0.0), high.get(f"{group}.settling_s", math.inf)
        if rise > settling:
            raise SettingsError(f"`{group}` cannot rise in {rise:g} s or more and settle within {settling:g} s.")


# Smallest and largest possible values, at which a bound always holds.
_ALWAYS_AT_LEAST = {"gain_margin": 1.0, "sensitivity": 1.0}
_ALWAYS_AT_MOST = {"disk_margin": 2.0, "phase_margin_deg": 180.0}
# By definition and by the small gain theorem stability requires these below 1.
_STABILITY_METRICS = ("stability.radius", "stability.searched_radius", "robust.mu")


def _refuse_weak(bounds: tuple[Requirement, ...], tables: Mapping[str, Mapping[str, Any]], scale: Scale) -> None:
    """Refuse limits that always hold, and probable errors of unit."""
    for key in ("gain_pct", "pole_pct"):
        if 0.0 < (value := float(tables["uncertainty"][key])) < 1.0:
            raise SettingsError(
                f"`[uncertainty] {key}` = {value:g} is less than one percent; a fraction? Write {100 * value:g}."
            )
    for item in bounds:
        name = item.metric.rpartition(".")[2]
        always = item.limit >= _ALWAYS_AT_MOST.get(name, math.inf)
        if item.bound == "min":
            always = item.limit <= _ALWAYS_AT_LEAST.get(name, 0.0)
        if always or (item.metric in _STABILITY_METRICS and item.limit > 1.0):
            raise SettingsError(
                f"`{item.metric}` {item.bound} {item.limit:g} "
                + ("allows unstable loops; 1 is the limit." if not always else "always holds; tighten or remove it.")
            )
        group = item.metric.partition(".")[0]
        upper = name == "settling_s" and scale.known and item.bound != "min"
        if upper and item.limit > float(tables[group]["duration_s"]):
            raise SettingsError(
                f"`[{group}] duration_s` = {tables[group]['duration_s']:g} is shorter than the settling time that "
                f"`{item.metric}` allows ({item.limit:g} s); lengthen it."
            )
