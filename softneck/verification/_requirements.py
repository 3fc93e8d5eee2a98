"""The requirements file: readable, versioned, with defaults; what it may not say is refused in words."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, SettingsError, require_between, require_whole

from ._linear import LARGE, SMALL
from ._steps import METRICS

DEFAULT_FILE = Path(__file__).with_name("requirements.toml")
VERSION = 1
_AXIS_METRICS = (*LARGE, *SMALL, "nu_gap_ratio")
_NECK_METRICS = (
    "overshoot_pct",
    "rise_s",
    "settling_s",
    "steady_rms_deg",
    "rms_error_deg",
    "max_rad",
    "limit_violation_s",
    "slack_s",
)
#: Names of all metrics that a requirement can be about.
METRIC_NAMES = (
    "stability.radius",
    "stability.searched_radius",
    *(f"{axis}.{name}" for axis in ("axes", "pitch", "roll") for name in _AXIS_METRICS),
    "mimo.disk_margin",
    "robust.mu",
    "robust.sensitivity",
    *(f"step.{name}" for name in METRICS),
    *(f"neck.{name}" for name in _NECK_METRICS),
)
# What no loop can do: least or largest value of a metric.
_POSSIBLE = {"sensitivity": (1.0, math.inf), "disk_margin": (0.0, 2.0), "gain_margin": (1.0, math.inf)}
_BOUNDS = ("min", "max", "below")
# Number -> least, largest, unit.
_NUMBERS: dict[str, dict[str, tuple[float, float, str]]] = {
    "uncertainty": {"gain_pct": (0.0, 95.0, "%"), "pole_pct": (0.0, 95.0, "%"), "delay_ms": (0.0, 1000.0, "ms")},
    "sampling": {"plants": (1, 100_000, ""), "search_generations": (0, 10_000, ""), "seed": (0, 2**31 - 2, "")},
    "step": {
        "size_deg": (0.01, 45.0, "deg"), "duration_s": (0.2, 600.0, "s"), "noise_deg": (0.0, 10.0, "deg"),
        "load_rad": (-6.0, 6.0, "rad"),
    },
    "neck": {
        "necks": (0, 1000, ""), "spread_pct": (0.0, 50.0, "%"), "size_deg": (0.01, 45.0, "deg"),
        "duration_s": (0.5, 600.0, "s"), "taut_up_to_kg": (0.0, 5.0, "kg"),
    },
}  # fmt: skip
_WHOLE = ("plants", "search_generations", "seed", "necks")


@dataclass(frozen=True, slots=True)
class Requirement:
    """One bound on one metric.

    Attributes:
        metric: such as `axes.sensitivity`.
        bound: "min", "max" or "below" (which excludes the limit itself).
        limit: of the worst plant.
        asked: whether a file of the user's states it; what only the defaults state may be impossible to compute.
    """

    metric: str
    bound: str
    limit: float
    asked: bool

    def holds(self, value: float) -> bool:
        """Return whether `value` keeps it; NaN does not."""
        if self.bound == "min":
            return value >= self.limit
        return value < self.limit if self.bound == "below" else value <= self.limit


@dataclass(frozen=True, slots=True, eq=False)
class Requirements:
    """What a verification asks of a controller, and how it is tried.

    Attributes:
        bounds: in the order of the file.
        uncertainty, sampling, step, neck: the tables of the file.
    """

    bounds: tuple[Requirement, ...]
    uncertainty: Mapping[str, Any]
    sampling: Mapping[str, Any]
    step: Mapping[str, Any]
    neck: Mapping[str, Any]


def read_requirements(path: str | Path | None = None) -> Requirements:
    """Return the defaults, with what the file at `path` says instead.

    Raises:
        FileFormatError: no such file, no TOML, another version.
        SettingsError: an unknown key or metric, a value out of range, or bounds that contradict each other.
    """
    defaults = _read(DEFAULT_FILE)
    if path is None:
        return _requirements(defaults, {})
    table = _read(Path(path))
    try:
        return _requirements(defaults, table)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from error


def make_requirements(table: Mapping[str, Any]) -> Requirements:
    """Return the defaults with what a table like a requirements file says instead."""
    return _requirements(_read(DEFAULT_FILE), {"version": VERSION, **table})


def _read(source: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(source.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: is not valid TOML ({error}).") from error
    except OSError as error:
        raise FileFormatError(
            f"{source}: cannot be read ({error.strerror}); name a requirements file (.toml)."
        ) from error
    if table.get("version") != VERSION:
        raise FileFormatError(
            f"{source}: must say `version = {VERSION}`, the form of requirements that this softneck reads; "
            f"it says {table.get('version')}."
        )
    return table


def _requirements(defaults: Mapping[str, Any], own: Mapping[str, Any]) -> Requirements:
    known = ("version", *_NUMBERS, "require")
    for key in own:
        if key not in known:
            raise SettingsError(f"unknown table `{key}` of a requirements file; it has {', '.join(known[1:])}.")
    tables = {name: _table(name, defaults[name], own.get(name, {})) for name in _NUMBERS}
    bounds = _bounds(defaults["require"], own.get("require", {}))
    _refuse_contradictions(bounds)
    _refuse_weak(bounds, tables)
    return Requirements(bounds, **tables)


def _table(name: str, defaults: Mapping[str, Any], own: Any) -> dict[str, Any]:
    if not isinstance(own, Mapping):
        raise SettingsError(f"`{name}` must be a table: [{name}].")
    for key, value in own.items():
        if key not in defaults:
            raise SettingsError(f"unknown key `{key}` of [{name}]; it takes {', '.join(defaults)}.")
        if key in _NUMBERS[name]:
            _check_number(f"[{name}] {key}", value, *_NUMBERS[name][key], whole=key in _WHOLE)
        elif isinstance(defaults[key], list):
            _check_list(f"[{name}] {key}", value, 5.0 if key == "payloads_kg" else 360.0)
        elif isinstance(defaults[key], bool):
            if not isinstance(value, bool):
                raise SettingsError(f"`[{name}] {key}` must be true or false; got {value!r}.")
        elif not isinstance(value, str):
            raise SettingsError(f"`[{name}] {key}` must be a text; got {value!r}.")
    return {**defaults, **own}


def _check_number(name: str, value: Any, low: float, high: float, unit: str, *, whole: bool) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"`{name}` must be a number; got {value!r}.")
    if whole:
        require_whole(name, value, int(low), int(high))
    require_between(name, float(value), low, high, unit)


def _check_list(name: str, value: Any, largest: float) -> None:
    if not isinstance(value, list) or not value:
        raise SettingsError(f"`{name}` must be a list of numbers; got {value!r}.")
    for number in value:
        _check_number(name, number, 0.0, largest, "", whole=False)


def _bounds(defaults: Mapping[str, Any], own: Any) -> tuple[Requirement, ...]:
    if not isinstance(own, Mapping):
        raise SettingsError("`require` must be a table: [require].")
    for metric in own:
        if metric not in METRIC_NAMES:
            raise SettingsError(f"unknown metric `{metric}`; [require] takes {', '.join(METRIC_NAMES)}.")
    found = []
    for metric, entry in {**defaults, **own}.items():
        if entry is False:
            continue
        if not isinstance(entry, Mapping) or not entry or any(key not in _BOUNDS for key in entry):
            raise SettingsError(
                f"`{metric}` must say {{ min = NUMBER }}, {{ max = NUMBER }}, both, or false; got {entry!r}."
            )
        for bound, limit in entry.items():
            if isinstance(limit, bool) or not isinstance(limit, int | float) or not math.isfinite(limit):
                raise SettingsError(f"the limit of `{metric}` must be a finite number; got {limit!r}.")
            found.append(Requirement(metric, bound, float(limit), metric in own))
    if not found:
        raise SettingsError("nothing is required; a certificate needs at least one requirement.")
    return tuple(found)


def _refuse_contradictions(bounds: tuple[Requirement, ...]) -> None:
    low: dict[str, float] = {}
    high: dict[str, float] = {}
    for item in bounds:
        # What the worse axis keeps, both keep.
        group, _, name = item.metric.partition(".")
        for metric in (f"pitch.{name}", f"roll.{name}") if group == "axes" else (item.metric,):
            if item.bound == "min":
                low[metric] = max(low.get(metric, -math.inf), item.limit)
            else:
                high[metric] = min(high.get(metric, math.inf), item.limit)
        least, most = _POSSIBLE.get(name, (0.0, math.inf))
        if (item.bound == "min" and item.limit > most) or (item.bound != "min" and item.limit < least):
            raise SettingsError(
                f"no loop has `{item.metric}` {item.bound} {item.limit:g}; it lies between {least:g} and {most:g}."
            )
    for metric in low:
        if low[metric] > high.get(metric, math.inf):
            raise SettingsError(f"`{metric}` cannot be at least {low[metric]:g} and at most {high[metric]:g}.")
    for group in ("step", "neck"):
        rise, settling = low.get(f"{group}.rise_s", 0.0), high.get(f"{group}.settling_s", math.inf)
        if rise > settling:
            raise SettingsError(f"`{group}` cannot rise in {rise:g} s or more and settle within {settling:g} s.")
    for axis in ("pitch", "roll"):
        _refuse_margins(axis, low, high)


# Metrics that no loop has less of, or more of: a bound there always holds.
_ALWAYS_AT_LEAST = {"gain_margin": 1.0, "sensitivity": 1.0}
_ALWAYS_AT_MOST = {"disk_margin": 2.0, "phase_margin_deg": 180.0}
# By the small gain theorem and by definition: what is not below 1 is not stable.
_STABILITY = ("stability.radius", "stability.searched_radius", "robust.mu")


def _refuse_weak(bounds: tuple[Requirement, ...], tables: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse what would hold whatever the controller does, and what is probably another unit."""
    for key in ("gain_pct", "pole_pct"):
        if 0.0 < (value := float(tables["uncertainty"][key])) < 1.0:
            raise SettingsError(
                f"`[uncertainty] {key}` = {value:g} is less than one percent; a fraction? Write {100 * value:g}."
            )
    for item in bounds:
        name = item.metric.rpartition(".")[2]
        always = (
            item.limit <= _ALWAYS_AT_LEAST.get(name, 0.0)
            if item.bound == "min"
            else item.limit >= _ALWAYS_AT_MOST.get(name, math.inf)
        )
        if always or (item.metric in _STABILITY and item.limit > 1.0):
            raise SettingsError(
                f"`{item.metric}` {item.bound} {item.limit:g} "
                + ("allows unstable loops; 1 is the limit." if not always else "always holds, so it says nothing.")
            )
        group, _, name = item.metric.partition(".")
        if name == "settling_s" and item.bound != "min" and item.limit > float(tables[group]["duration_s"]):
            raise SettingsError(
                f"`[{group}] duration_s` = {tables[group]['duration_s']:g} is shorter than the settling time that "
                f"`{item.metric}` allows ({item.limit:g} s); nobody would see whether it settles."
            )


def _refuse_margins(axis: str, low: Mapping[str, float], high: Mapping[str, float]) -> None:
    """Refuse what excludes each other: the gain margin is at least Ms/(Ms - 1), |S - T| at least 2 Ms - 1."""
    gain, disk = high.get(f"{axis}.gain_margin", math.inf), low.get(f"{axis}.disk_margin", 0.0)
    largest, least = high.get(f"{axis}.sensitivity", math.inf), low.get(f"{axis}.sensitivity", 1.0)
    if 1.0 < largest < math.inf and gain < largest / (largest - 1.0):
        raise SettingsError(
            f"`{axis}.sensitivity` <= {largest:g} gives a gain margin of at least {largest / (largest - 1.0):.3g}; "
            f"`gain_margin` <= {gain:g} contradicts it."
        )
    if disk > 2.0 / (2.0 * least - 1.0):
        raise SettingsError(
            f"`{axis}.sensitivity` >= {least:g} leaves a disk margin of at most {2.0 / (2.0 * least - 1.0):.3g}; "
            f"`disk_margin` >= {disk:g} contradicts it."
        )
