"""What is tuned: requirements, of `verify` and of loops that only tuning looks at, plants, and whose controller."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from softneck.core import KINDS, SettingsError, resolve, to_si
from softneck.identification import Model
from softneck.loop import SETTLING_BAND, default_limits
from softneck.robot import Robot
from softneck.verification import (
    VERSION,
    Requirement,
    Requirements,
    Scale,
    bounds_of,
    check_number,
    digits,
    kept_back,
    make_requirements,
    metric_names,
    of_file,
    with_groups,
)

_RISE = "sim.rise_s"
# Standard deviations of noise: of some hundred samples one may be so far off.
_SIGMAS = 4.0
DEFAULT_FILE = Path(__file__).with_name("requirements.toml")
# Least, largest and unit of the numbers of [track].
_TRACK = {
    "small_part": (0.05, 1.0, ""), "noise_deg": (0.0, 10.0, "deg"), "delay_ms": (0.0, 1e9, "ms"),
    "circle_deg": (0.1, 40.0, "deg"), "circle_rad_s": (0.01, 20.0, "rad/s"),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TuneRequirements:
    """What is asked.

    Attributes:
        certificate: what `verify` is asked to hold.
        track: the loops that are judged besides.
        bounds: all requirements, those of `certificate` first; the reserve is taken off.
        reserve: metric -> safety margin of its limit, for the difference between a robot and its models.
        stated: metrics and keys of [track] that somebody asks something of; the others are as the defaults have them.
        table: of a requirements file that asks `tune` and `verify` for the same: limits as asked, the reserve beside.
    """

    certificate: Requirements
    track: Mapping[str, float]
    bounds: tuple[Requirement, ...]
    reserve: Mapping[str, float]
    table: Mapping[str, Any]
    stated: frozenset[str] = frozenset()

    def wanted(self, metric: str) -> float | None:
        """Return the largest value that is allowed of a metric of the robot itself: its limit with the reserve."""
        limit = self.limit(metric)
        return None if limit is None else digits(limit + self.reserve.get(metric, 0.0))

    def limit(self, metric: str) -> float | None:
        """Return the largest value that is allowed of a metric on the plants; None where nothing bounds it."""
        limits = [item.limit for item in self.bounds if item.metric == metric and item.bound != "min"]
        return min(limits, default=None)

    def told(self, part: float = 1.0) -> bool:
        """Return whether the sensor shows if a part of the step has settled: its noise alone stays in that band."""
        size = part * float(self.certificate.sim["size_deg"])
        return _SIGMAS * self.track["noise_deg"] <= SETTLING_BAND * size

    def lines(self) -> list[str]:
        """Return each requirement as a line for people."""
        words = {"min": ">=", "max": "<=", "below": "<"}
        lines = []
        for item in self.bounds:
            kept = self.reserve.get(item.metric, 0.0) if item.bound != "min" else 0.0
            less = f" ({item.limit + kept:g} less a reserve of {kept:g})" if kept else ""
            lines.append(f"{item.metric} {words[item.bound]} {item.limit:g}{less}")
        return lines


def read_tune_requirements(
    path: str | Path | None = None, *, robot: Robot | None = None, scale: Scale | None = None, stepping: bool = True,
    rise: float | None = None,
) -> TuneRequirements:  # fmt: skip
    """Return the defaults, with what the file at `path` says instead.

    Args:
        path: a requirements file, also one for `verify`.
        robot: whose controller is asked for; None: a neck's.
        scale: by which the defaults are the robot's; None: by what the robot alone tells.
        stepping: whether there are simulation models; else `sim.*` of the defaults is asked of the linear plants.
        rise: the default [s]; None: that of the paper's neck, by the robot's time constant.

    Raises:
        FileFormatError: no such file, no TOML, another version.
        SettingsError: an unknown key or metric, a value out of range, or bounds that contradict each other.
    """
    return of_file(path, partial(make_tune_requirements, robot=robot, scale=scale, stepping=stepping, rise=rise))


def make_tune_requirements(
    table: Mapping[str, Any], *, robot: Robot | None = None, scale: Scale | None = None, stepping: bool = True,
    rise: float | None = None,
) -> TuneRequirements:  # fmt: skip
    """Return the defaults with what a table like a requirements file says instead."""
    scale = scale or Scale.of(robot or Robot.preset())
    whose = scale.robot
    table = with_groups(table, whose, stepping=stepping, track=True)
    defaults = tomllib.loads(default_text())
    limits = defaults["require"]
    if not circles(whose):
        limits = {metric: limit for metric, limit in limits.items() if not metric.startswith("track.")}
    usual = {
        name: scale.table(limits if name == "require" else defaults[name]) for name in defaults if name != "version"
    }
    if rise is not None:
        usual["require"][_RISE] = {"max": rise}
    if not stepping:
        usual = _for_linear(usual)
    merged = {
        key: {**usual.get(key, {}), **table.get(key, {})} if isinstance(usual.get(key, {}), Mapping)
        and isinstance(table.get(key, {}), Mapping) else table[key]
        for key in dict.fromkeys((*usual, *table)) if key != "version"
    }  # fmt: skip
    track = _numbers(merged["track"], defaults["track"], scale)
    require, reserve = kept_back(merged.get("require", {}), merged.get("reserve", {}))
    tracked = {metric: entry for metric, entry in require.items() if metric.startswith("track.")}
    extra = bounds_of(tracked, metric_names(whose, track=True), tracked)
    if wrong := [item.metric for item in extra if item.bound != "max" or item.limit <= 0.0]:
        raise SettingsError(f"`{wrong[0]}` must say {{ max = NUMBER }} of a positive number, or false.")
    certificate = make_requirements(merged, scale=scale)
    return TuneRequirements(
        certificate=certificate, track=track, bounds=(*certificate.bounds, *extra), reserve=reserve,
        table={"version": VERSION, **merged},
        stated=frozenset(metric for metric, entry in table.get("require", {}).items() if entry is not False)
        | frozenset(f"track.{key}" for key in table.get("track", {})),
    )  # fmt: skip


def default_text() -> str:
    """Return the defaults of tuning as a requirements file, with the rise of the paper's neck."""
    limits = default_limits.TUNE | {_RISE: default_limits.NECK_RISE_S}
    return DEFAULT_FILE.read_text(encoding="utf-8") + default_limits.as_toml(limits)


def circles(robot: Robot) -> bool:
    """Return whether a robot can follow a circle: of two angles."""
    return len(robot.outputs.names) == 2 and to_si(robot.outputs.unit)[1] == "rad"


def loosened(asked: TuneRequirements, limits: Mapping[str, float]) -> TuneRequirements:
    """Return the requirements with other upper limits of some metrics on the plants; safety margins stay."""
    require = {metric: {"max": digits(limit + asked.reserve.get(metric, 0.0))} for metric, limit in limits.items()}
    table = {**asked.table, "require": {**asked.table.get("require", {}), **require}}
    if "sim.settling_s" in limits:  # a file states seconds of the robot: so must the duration it is compared with
        table["sim"] = {"duration_s": asked.certificate.sim["duration_s"], **table.get("sim", {})}
    bounds = tuple(replace(b, limit=limits[b.metric]) if b.metric in limits else b for b in asked.bounds)
    own = {key: value for key, value in table.items() if key != "version"}
    certificate = replace(
        asked.certificate, own=own | {"version": VERSION},
        bounds=tuple(b for b in bounds if not b.metric.startswith("track.")),
    )  # fmt: skip
    return replace(asked, certificate=certificate, bounds=bounds, table=table)


def _for_linear(usual: dict[str, Any]) -> dict[str, Any]:
    """Return the defaults without simulation models: their requirements apply to the linear plants."""
    require = {re.sub(r"^sim\.", "step.", name): limit for name, limit in usual["require"].items()}
    # Presets are foreign plants, which decide nothing and take half a minute.
    return {**usual, "reserve": {}, "sim": {**usual["sim"], "necks": 0}, "require": require}


def _numbers(given: Any, defaults: Mapping[str, float], scale: Scale) -> dict[str, float]:
    """Return the table [track] by the neck's names of its keys, which files up to 0.2 have of every robot."""
    inside = {key: key for key in defaults} | {scale.name_of(key): key for key in defaults}
    found = dict(zip(defaults, scale.table(defaults).values(), strict=True))
    for key, value in given.items():
        if key not in inside:
            raise SettingsError(f"unknown key `{key}` of [track]; it takes {', '.join(map(scale.name_of, defaults))}.")
        check_number(f"[track] {key}", value, inside[key], _TRACK[inside[key]], scale)
        found[inside[key]] = float(value)
    return found


def has_observer(kind: str) -> bool:
    """Return whether loops of a kind have an observer: designed for it."""
    return hasattr(resolve(KINDS[kind].settings), "over")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Task:
    """All that a worker must know to judge a candidate.

    Attributes:
        digest: of all that follows; workers keep what they have made ready by it.
        linear: by name, models and families.
        own: by name, simulation models.
        asked: the requirements.
        robot: whose controller is tuned.
        cocontraction: at which the loops are held [SI unit of the motors]; None: by the controller's own rule.
        seed: of the noise.
        observer: of the loops of kinds that have one (`mpc`, `nmpc`); None: these have none either.
    """

    digest: str
    linear: Mapping[str, Any]
    own: Mapping[str, Any]
    asked: TuneRequirements
    robot: Robot
    cocontraction: float | None = None
    seed: int = 0
    observer: Any = None

    @property
    def said_cocontraction(self) -> float | None:
        """As settings and loop files say it: in the unit of the robot's motors."""
        factor = to_si(self.robot.motors.unit)[0]
        return None if self.cocontraction is None else float(f"{self.cocontraction / factor:.4g}")

    @property
    def tested(self) -> bool:
        """Whether a family was tested against its recordings."""
        return any(getattr(thing, "measured", {}) for thing in self.linear.values())

    @property
    def models(self) -> list[Model]:
        """Nonlinear models among the simulation models."""
        return [thing for thing in self.own.values() if isinstance(thing, Model)]

    @property
    def plant(self) -> Any:
        """What controllers are designed on: the first of several linear sources is the nominal plant."""
        sources = list(self.linear.values())
        return sources[0] if len(sources) == 1 else sources
