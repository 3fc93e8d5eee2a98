"""Requirements of `tune`, and the check that a controller could meet them."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import SettingsError, to_si
from softneck.design import ControllerLimits, LoopSettings, UncertainPlant, axis_test, least_rise, uncertain_plant
from softneck.estimation import AxisPlant
from softneck.loop import default_limits, shows_settling
from softneck.loop.default_limits import required_rise
from softneck.robot import TIME_CONSTANT, Robot
from softneck.verification import (
    VERSION,
    Requirement,
    Requirements,
    Scale,
    apply_safety_margin,
    bounds_of,
    check_number,
    expand_metrics,
    make_requirements,
    metric_names,
    read_file,
    round_12_digits,
)

_RISE_METRIC = "sim.rise_s"
# How far a search stays within limits, beside its reserve, for draws that it does not see.
_UNSEEN = {"axes.gain_margin": 0.2, "sim.overshoot_pct": default_limits.UNSEEN_OVERSHOOT_PCT}
DEFAULT_FILE = Path(__file__).with_name("requirements.toml")
# Minimum, maximum and unit of the numbers of [track].
_TRACK_NUMBERS = {
    "small_part": (0.05, 1.0, ""), "noise_deg": (0.0, 10.0, "deg"), "delay_ms": (0.0, 1e9, "ms"),
    "circle_deg": (0.1, 40.0, "deg"), "circle_rad_s": (0.01, 20.0, "rad/s"),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TuneRequirements:
    """Requirements of a search.

    `certificate`: requirements of `verify`. `track`: settings of the additional loops. `bounds`: all requirements,
    those of `certificate` first, less the safety margins. `reserve`: metric -> safety margin of its limit, for the
    difference between a robot and its models. `kept`: metric -> how far a search stays within its limit, for draws
    that it does not see. `stated`: metrics and keys of [track] and [sim] that the user states. `table`: a requirements
    file that gives `tune` and `verify` the same requirements.
    """

    certificate: Requirements
    track: Mapping[str, float]
    bounds: tuple[Requirement, ...]
    reserve: Mapping[str, float]
    table: Mapping[str, Any]
    stated: frozenset[str] = frozenset()
    kept: Mapping[str, float] = field(default_factory=dict)

    def robot_limit(self, metric: str) -> float | None:
        """Return the largest allowed value of a metric on the robot: the limit plus the safety margin."""
        limit = self.limit(metric)
        return None if limit is None else round_12_digits(limit + self.reserve.get(metric, 0.0))

    def limit(self, metric: str) -> float | None:
        """Return the largest allowed value of a metric on the plants; None without an upper bound."""
        limits = [item.limit for item in self.bounds if item.metric == metric and item.bound != "min"]
        return min(limits, default=None)

    def shows_settling(self, part: float = 1.0) -> bool:
        """Return whether the sensor noise stays within the settling band of a share of the step."""
        size = part * float(self.certificate.sim["size_deg"])
        return shows_settling(self.track["noise_deg"], size)

    def lines(self) -> list[str]:
        """Return each requirement as a line of text."""
        words = {"min": ">=", "max": "<=", "below": "<"}
        lines = []
        for item in self.bounds:
            kept = self.reserve.get(item.metric, 0.0) if item.bound != "min" else 0.0
            less = f" ({item.limit + kept:g} less a reserve of {kept:g})" if kept else ""
            lines.append(f"{item.metric} {words[item.bound]} {item.limit:g}{less}")
        return lines


def read_tune_requirements(
    path: str | Path | None = None, *, robot: Robot | None = None, scale: Scale | None = None, stepping: bool = True,
    drawn: bool = False, rise: float | None = None, payload: float | None = None,
) -> TuneRequirements:  # fmt: skip
    """Return the requirements of a file, with defaults for the rest.

    `path`: a requirements file, also one for `verify`. `robot`: of the controller; None: the neck. `scale`: of the
    defaults; None: from the robot alone. `stepping`: whether there are simulation models; else default `sim.*` limits
    apply to the linear plants. `drawn`: whether draws of a family decide. `rise`: the default [s]; None: that of the
    paper's neck, by the robot's time constant. `payload`: the heaviest recorded one [kg], to which defaults go; None:
    not known.
    """
    told = {"robot": robot, "scale": scale, "stepping": stepping, "drawn": drawn, "rise": rise, "payload": payload}
    return read_file(path, partial(make_tune_requirements, **told))


def make_tune_requirements(
    table: Mapping[str, Any], *, robot: Robot | None = None, scale: Scale | None = None, stepping: bool = True,
    drawn: bool = False, rise: float | None = None, payload: float | None = None,
) -> TuneRequirements:  # fmt: skip
    """Return the requirements of a table like a requirements file, with defaults for the rest."""
    scale = scale or Scale.of(robot or Robot.preset())
    whose = scale.robot
    table = expand_metrics(table, whose, stepping=stepping, track=True)
    defaults = tomllib.loads(default_text())
    usual = {name: scale.table(values) for name, values in defaults.items() if name != "version"}
    if not can_follow_circle(whose):
        usual["require"] = {name: limit for name, limit in usual["require"].items() if not name.startswith("track.")}
    if rise is not None:
        usual["require"][_RISE_METRIC] = {"max": rise}
    if payload is not None:
        heavy = usual["sim"]["payloads_kg"]
        usual["sim"] = {**usual["sim"], "payloads_kg": sorted({min(kg, payload) for kg in heavy})}
    kept = dict(_UNSEEN) if drawn else {}
    if drawn and "reserve" not in table:  # draws differ from each other as a robot does from its models
        kept, usual["reserve"] = kept | usual["reserve"], {}
    if not stepping:
        usual = _for_linear(usual)
    merged = {
        key: {**usual.get(key, {}), **table.get(key, {})} if isinstance(usual.get(key, {}), Mapping)
        and isinstance(table.get(key, {}), Mapping) else table[key]
        for key in dict.fromkeys((*usual, *table)) if key != "version"
    }  # fmt: skip
    track = _numbers(merged["track"], defaults["track"], scale)
    require, reserve = apply_safety_margin(merged.get("require", {}), merged.get("reserve", {}))
    tracked = {metric: entry for metric, entry in require.items() if metric.startswith("track.")}
    extra = bounds_of(tracked, metric_names(whose, track=True), tracked)
    if wrong := [item.metric for item in extra if item.bound != "max" or item.limit <= 0.0]:
        raise SettingsError(f"`{wrong[0]}` must be {{ max = NUMBER }} with a positive number, or false.")
    certificate = make_requirements(merged, scale=scale)
    return TuneRequirements(
        certificate=certificate, track=track, bounds=(*certificate.bounds, *extra), reserve=reserve,
        table={"version": VERSION, **merged}, kept=kept,
        stated=frozenset(metric for metric, entry in table.get("require", {}).items() if entry is not False)
        | frozenset(f"{name}.{key}" for name in ("track", "sim") for key in table.get(name, {})),
    )  # fmt: skip


def default_text() -> str:
    """Return the defaults of tuning as a requirements file, with the rise of the paper's neck."""
    limits = default_limits.TUNE | {_RISE_METRIC: default_limits.NECK_RISE_S}
    return DEFAULT_FILE.read_text(encoding="utf-8") + default_limits.as_toml(limits)


def default_payloads() -> list[float]:
    """Return the payloads [kg] of loops, where the recordings have them."""
    return tomllib.loads(DEFAULT_FILE.read_text(encoding="utf-8"))["sim"]["payloads_kg"]


def can_follow_circle(robot: Robot) -> bool:
    """Return whether a robot can follow a circle: it has two angles."""
    return len(robot.outputs.names) == 2 and to_si(robot.outputs.unit)[1] == "rad"


def relax_limits(asked: TuneRequirements, limits: Mapping[str, float]) -> TuneRequirements:
    """Return the requirements with new upper limits of some metrics on the plants and the same safety margins."""
    wider = {name: round_12_digits(limit + asked.reserve.get(name, 0.0)) for name, limit in limits.items()}
    require = {**asked.table.get("require", {}), **{name: {"max": limit} for name, limit in wider.items()}}
    table = {**asked.table, "require": require}
    if "sim.settling_s" in limits:  # a file states the robot's seconds, so the compared duration must too
        table["sim"] = {"duration_s": asked.certificate.sim["duration_s"], **table.get("sim", {})}
    bounds = tuple(replace(b, limit=limits[b.metric]) if b.metric in limits else b for b in asked.bounds)
    kept = tuple(b for b in bounds if not b.metric.startswith("track."))
    certificate = replace(asked.certificate, own=table | {"version": VERSION}, bounds=kept)
    return replace(asked, certificate=certificate, bounds=bounds, table=table)


def _for_linear(usual: dict[str, Any]) -> dict[str, Any]:
    """Return the defaults without simulation models: their requirements apply to the linear plants."""
    require = {re.sub(r"^sim\.", "step.", name): limit for name, limit in usual["require"].items()}
    # Loops over a built-in plant decide nothing and take half a minute.
    return {**usual, "reserve": {}, "sim": {**usual["sim"], "necks": 0}, "require": require}


def _numbers(given: Any, defaults: Mapping[str, float], scale: Scale) -> dict[str, float]:
    """Return the table [track] under the neck's names of its keys, which files up to 0.2 use for every robot."""
    inside = {key: key for key in defaults} | {scale.name_of(key): key for key in defaults}
    found = dict(zip(defaults, scale.table(defaults).values(), strict=True))
    if not isinstance(given, Mapping):
        raise SettingsError("`track` must be a table: [track].")
    for key, value in given.items():
        if key not in inside:
            raise SettingsError(f"unknown key `{key}` of [track]; it takes {', '.join(map(scale.name_of, defaults))}.")
        check_number(f"[track] {key}", value, inside[key], _TRACK_NUMBERS[inside[key]], scale)
        found[inside[key]] = float(value)
    return found


# A settled output has risen, so a settling limit bounds the rise.
_RISE_METRICS = ("sim.rise_s", "step.rise_s", "sim.settling_s", "step.settling_s")
#: Default rise time, in time constants, where the motors allow a shorter one: models are less accurate there.
USUAL_RISE = 2.0


def check_feasibility(asked: TuneRequirements, plant: Any) -> None:
    """Raise SettingsError for a requirement that no controller of the nominal plant can meet."""
    uncertain = uncertain_plant(plant)
    limits = LoopSettings().limits(uncertain.robot)
    _refuse_quiet(asked)
    for name in uncertain.names:
        nominal = uncertain.axis(name).nominal
        _refuse_rise(asked, uncertain, limits, name, nominal)
        _refuse_circle(asked, name, nominal)
        _refuse_turn(asked, uncertain, limits, name, nominal)
        _refuse_sensitivity(asked, name)
        _refuse_load(asked, name, nominal)
    _refuse_order(asked)


def fastest_rise(plant: Any) -> float:
    """Return the shortest `rise_s` [s] that designs on a plant accept; 0 if the motors cannot reach the test step."""
    uncertain = uncertain_plant(plant)
    limits = LoopSettings().limits(uncertain.robot)
    found = [
        least_rise(axis, axis_test(axis, limits, uncertain.redefinition[1]))
        for axis in (uncertain.axis(name).nominal for name in uncertain.names)
    ]
    return max((least for least in found if math.isfinite(least)), default=0.0)


def default_rise(plants: list[Any], asked: TuneRequirements) -> float | None:
    """Return the default rise time [s] of the slowest axis; None if no step can be reached."""
    uncertain = uncertain_plant(plants[0] if len(plants) == 1 else plants)
    limits, size = LoopSettings().limits(uncertain.robot), asked.certificate.scale.si(asked.certificate.sim["size_deg"])
    time, found = asked.certificate.scale.time, []
    for name in uncertain.names:
        axis = uncertain.axis(name)
        test = axis_test(axis.nominal, limits, uncertain.redefinition[1])
        latest = max((plant.delay + 1) * plant.sample_time for plant in (axis.nominal, *axis.samples))
        least = least_rise(axis.nominal, test, size)
        found.append(required_rise(least / time, latest / time) if math.isfinite(least) else math.inf)
    # A shorter required settling time bounds the rise.
    most = round_12_digits(time * max(*found, USUAL_RISE * TIME_CONSTANT))
    return min(most, asked.robot_limit("sim.settling_s") or math.inf) if most < math.inf else None


def _refuse_order(asked: TuneRequirements) -> None:
    """Refuse a stated settling time below a stated rise time."""
    said = {item.metric for item in asked.bounds if item.asked}
    for group in ("sim", "step"):
        names = f"{group}.settling_s", f"{group}.rise_s"
        settling, rise = (asked.robot_limit(name) for name in names)
        if settling is not None and rise is not None and settling < rise and said.issuperset(names):
            raise SettingsError(
                f"`{names[0]}` <= {settling:g} s and `{names[1]}` <= {rise:g} s contradict each other: a "
                f"settled step has risen; require a rise of at most {settling:g} s as well, or a later settling."
            )


def _refuse_quiet(asked: TuneRequirements) -> None:
    """Refuse a steady-state error below the sensor noise, which every measurement contains."""
    name_of, noise = asked.certificate.scale.name_of, asked.track["noise_deg"]
    metric = f"sim.{name_of('steady_rms_deg')}"
    limit = min((b.limit for b in asked.bounds if b.metric == metric and b.bound != "min" and b.asked), default=noise)
    if limit < noise:
        raise SettingsError(
            f"`{metric}` <= {limit:g} cannot be: the sensor noise alone is {noise:g} (`[track] "
            f"{name_of('noise_deg')}`); allow more, or state the noise of your sensor."
        )


def _refuse_rise(
    asked: TuneRequirements, uncertain: UncertainPlant, limits: ControllerLimits, name: str, plant: AxisPlant
) -> None:
    """Refuse a rise that is too fast for slew and range of the motors."""
    test = axis_test(plant, limits, uncertain.redefinition[1])
    for metric in _RISE_METRICS:
        limit = asked.robot_limit(metric)
        if limit is None:
            continue
        table = asked.certificate.sim if metric.startswith("sim.") else asked.certificate.step
        least = least_rise(plant, test, asked.certificate.scale.si(float(table["size_deg"])))
        if math.isinf(least):
            raise SettingsError(
                f"`{metric}` cannot be: the motors' range does not reach {name}'s step of the requirements; ask for a "
                "smaller step."
            )
        if limit < least:
            raise SettingsError(
                f"`{metric}` <= {limit:g} s cannot be: within the motors' slew and range {name}'s step of the "
                f"requirements takes at least {least:.2g} s; allow more, or ask for a smaller step."
            )


def _refuse_circle(asked: TuneRequirements, name: str, plant: AxisPlant) -> None:
    """Refuse a circle beyond a bandwidth of 1/delay: a reference filter can only compensate slower ones."""
    scale = asked.certificate.scale
    metric = f"track.{scale.name_of('circle_rms_deg')}"
    limit = asked.robot_limit(metric)
    dead, turn = (plant.delay + 1) * plant.sample_time, asked.track["circle_rad_s"]
    # An output at rest in the middle has the radius as its error.
    if limit is None or not can_follow_circle(scale.robot) or limit >= asked.track["circle_deg"] or turn * dead < 1.0:
        return
    raise SettingsError(
        f"`{metric}` <= {limit:g} cannot be: a circle at {turn:g} rad/s is beyond the bandwidth that the "
        f"dead time of {name}, {1e3 * dead:.0f} ms, allows, {1.0 / dead:.3g} rad/s; ask for a slower one, or for "
        "`track.ahead_rms_deg`, of a reference that is known ahead."
    )


def _refuse_turn(
    asked: TuneRequirements, uncertain: UncertainPlant, limits: ControllerLimits, name: str, plant: AxisPlant
) -> None:
    """Refuse a circle beyond slew and range of the motors.

    The largest first harmonic is that of the square wave of the range, or of the triangle wave of the slew.
    """
    scale = asked.certificate.scale
    if not can_follow_circle(scale.robot):
        return
    size, turn = asked.track["circle_deg"], asked.track["circle_rad_s"]
    share = float(np.abs(uncertain.redefinition[1][:, uncertain.names.index(name)]).max())
    most = 4.0 / math.pi * min(limits.position_limit, limits.slew_limit / turn) / share
    reached = float(scale.shown(most * np.abs(plant.response(np.array([turn])))[0]))
    # The rms error of one output; the rms of a sine is its amplitude over the root of two.
    least = (size - reached) / math.sqrt(2.0)
    for metric in ("track.circle_rms_deg", "track.ahead_rms_deg"):
        limit = asked.robot_limit(metric)
        if limit is not None and limit < least:
            raise SettingsError(
                f"`{metric}` <= {limit:g} cannot be: within the motors' slew and range {name} swings by {reached:.2g} "
                f"deg at {turn:g} rad/s, of {size:g} deg; ask for a slower circle, or a smaller one."
            )


def _refuse_sensitivity(asked: TuneRequirements, name: str) -> None:
    """Refuse an Ms of 1: Bode's integral leaves |S| above 1 somewhere (Astrom and Murray 2021, ch. 14)."""
    for group in ("axes", name):
        limit = asked.robot_limit(f"{group}.sensitivity")
        if limit is not None and limit <= 1.0:
            raise SettingsError(
                f"`{group}.sensitivity` <= {limit:g} cannot be: no feedback through a dead time has it."
            )


def _refuse_load(asked: TuneRequirements, name: str, plant: AxisPlant) -> None:
    """Refuse a load error below that of the dead time, before any feedback acts."""
    certificate = asked.certificate
    metric = f"step.{certificate.scale.name_of('load_rms_deg')}"
    limit = asked.robot_limit(metric)
    if limit is None:
        return
    rows = round(float(certificate.step["duration_s"]) / plant.sample_time)
    load = certificate.step_test(0).load
    # The load is measured a dead time later, and feedback acts another one later.
    alone = np.zeros(rows)
    felt = load * _step_response(plant, plant.delay + 2)
    alone[plant.delay : plant.delay + felt.size] = felt[: max(rows - plant.delay, 0)]
    least = math.sqrt(float((alone**2).mean())) / certificate.scale.si(1.0)
    if limit < least:
        raise SettingsError(
            f"`{metric}` <= {limit:g} cannot be: the load of the requirements moves {name} for a dead time before any "
            f"feedback acts, which alone is {least:.2g}; allow more."
        )


def _step_response(plant: AxisPlant, rows: int) -> np.ndarray:
    """Return the response (rows,) to a step of the input, without the delay."""
    from scipy.signal import lfilter

    return np.asarray(lfilter(np.append(0.0, plant.numerator), plant.denominator, np.ones(rows)))
