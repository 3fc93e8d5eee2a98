"""Units of a guess: from titles, or else from what the numbers can be."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log, log1p, pi
from typing import NamedTuple

import numpy as np

from ..recording._channels import MOTOR_POSITIONS, MOTOR_TURNS, MOTOR_VELOCITIES, OUTPUTS, SET_POINTS, file_unit
from ._clocks import velocity_period
from ._draft import Draft
from .formats._dates import DATE

_DEGREE = pi / 180.0
UNITS = {"rad": 1.0, "deg": _DEGREE}
# ln of what is usual, and its spread: half of all logs lie within a factor of exp(0.67 spread).
# [rad] The paper's motors move by 1 to 6 rad, and by less in logs near rest.
_MOTOR_REACH, _MOTOR_SPREAD = log(2.0), 0.8
# [rad] The platform tilts by 5 to 45 deg.
_TILT_REACH, _TILT_SPREAD = log(0.3), 0.8
# [rad/rad] 5 deg a rad at winches of 7.5 mm; of stiff necks and thin winches less, of long arms more.
_GAIN, _GAIN_SPREAD = log(0.1), 0.9
# [rad] Beyond the paper's range, and where the platform has turned by more than a right angle.
MOTOR_RANGE, _TILT_RANGE = 6.0, 0.8
_BEYOND_RANGE = log(0.03)
_TILT_LIMIT = pi / 2.0
# One logger writes set-points and positions in one unit, nearly always.
_SEPARATE = log(0.02)
# Positions reach what is asked for, or, of drives that were off or late, anything.
_FOLLOW_SPREAD, _LATE, _LATE_SPREAD = 0.2, 0.05, 2.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The likeliest unit of a group of columns.

    Attributes:
        unit: "rad" or "deg".
        probability: that it is, all other groups being what they may.
        alone: whether set-points and positions were judged to differ.
    """

    unit: str
    probability: float
    alone: bool = False


def judge(reaches: Mapping[str, float], titled: Mapping[str, str]) -> dict[str, Verdict]:
    """Return the units of the groups `set-points`, `positions` and `tilt`, as far as they are logged.

    Args:
        reaches: group -> largest size as logged, of a channel of it.
        titled: group -> unit that titles name, which stands.
    """
    groups = [name for name in ("set-points", "positions", "tilt") if name in reaches]
    odds: dict[tuple[str, ...], float] = {}
    for choice in itertools.product(UNITS, repeat=len(groups)):
        units = dict(zip(groups, choice, strict=True))
        if all(units[name] == unit for name, unit in titled.items() if name in units):
            odds[choice] = _log_odds({name: reaches[name] * UNITS[units[name]] for name in groups}, units)
    if not odds:
        return {}
    best = max(odds, key=lambda choice: odds[choice])
    weights = {choice: exp(value - odds[best]) for choice, value in odds.items()}
    total = sum(weights.values())
    chosen = dict(zip(groups, best, strict=True))
    alone = "positions" in chosen and chosen["positions"] != chosen.get("set-points", chosen["positions"])
    return {
        name: Verdict(unit, sum(w for c, w in weights.items() if c[k] == unit) / total, alone and name != "tilt")
        for k, (name, unit) in enumerate(chosen.items())
    }


def _log_odds(reach: Mapping[str, float], units: Mapping[str, str]) -> float:
    """Return ln of the odds of reaches [rad] in units, to a constant."""
    total = 0.0
    motors = [reach[name] for name in ("set-points", "positions") if reach.get(name, 0.0) > 0.0]
    if len({units[name] for name in ("set-points", "positions") if name in units}) > 1:
        total += _SEPARATE
    if len(motors) == 2:
        apart = log(motors[0] / motors[1])
        follow = _normal(apart, _FOLLOW_SPREAD) + log1p(-_LATE)
        late = _normal(apart, _LATE_SPREAD) + log(_LATE)
        total += max(follow, late) + log1p(exp(-abs(follow - late)))
    if motors:
        total += _normal(log(motors[0]) - _MOTOR_REACH, _MOTOR_SPREAD)
        total += _BEYOND_RANGE * (max(motors) > 1.02 * MOTOR_RANGE) * (1.0 + log(max(motors) / MOTOR_RANGE))
    tilt = reach.get("tilt", 0.0)
    if tilt > 0.0:
        total += _normal(log(tilt) - _TILT_REACH, _TILT_SPREAD) + _BEYOND_RANGE * (tilt > _TILT_RANGE)
        total += 3.0 * _BEYOND_RANGE * (tilt > _TILT_LIMIT)
        if motors:
            total += _normal(log(tilt / motors[0]) - _GAIN, _GAIN_SPREAD)
    return total


def _normal(distance: float, spread: float) -> float:
    return -0.5 * (distance / spread) ** 2 - log(spread)


_REFERENCES = ("pitch_reference", "roll_reference")
_TILTED = ("pitch", "roll", "inclination", *_REFERENCES)
# The paper's sample time [s], which decides where the data leave it open; sample times of loggers lie around it by a
# factor of exp(1.2), two thirds of them.
_USUAL, _STEP_SPREAD = 0.02, 1.2
# Units of a time column: name, in `s` or `ms`, and factor to it.
_CLOCKS = {"s": ("s", 1.0), "ms": ("ms", 1.0), "us": ("ms", 1e-3), "ns": ("ms", 1e-6)}
# No guess is surer: robots differ more than the odds know. What set-points and positions in two units are at most.
_SUREST, _ALONE = 0.99, 0.85
# Pitch and roll further apart than this are doubted.
_FAR_APART, _ALIKE = 20.0, 0.6
# What is asked of an angle and what it does are in two units where they are further apart than half way (in logarithms)
# from 1 to 57. Positions that follow set-points this well and are so many times as large, or as small, are counts,
# turns or those before a gear, unless the number is nearly the 57 of degrees.
_TWO_UNITS, _FOLLOW, _COUNTS, _DEGREES = 7.6, 0.9, 3.0, (45.0, 72.0)


class Unit(NamedTuple):
    """A channel's unit, a factor to it, why, and how likely it is."""

    name: str
    factor: float
    why: str
    confidence: float = 1.0


def units(draft: Draft) -> dict[str, Unit]:
    """Return for each pick its unit."""
    found: dict[str, Unit] = {}
    for channel, pick in draft.picks.items():
        if pick.unit is not None and channel not in ("time", "run"):
            sure = 1.0 if pick.unit_sure else 0.8
            found[channel] = Unit(pick.unit, 1.0, "its title says so", sure)
    _time(draft, found)
    counts = _counts(draft, found)
    _angles(draft, found, counted=counts is not None)
    if counts is not None:
        found.update(dict.fromkeys(MOTOR_POSITIONS, _of_counts(counts, found[SET_POINTS[0]].name)))
    _references(draft, found)
    _velocities(draft, found)
    for channel in draft.picks:
        if channel not in found and channel != "run":
            found[channel] = Unit(file_unit(channel), 1.0, "the usual unit", 0.9)
    return found


def largest(draft: Draft, channel: str, step: float = 1.0) -> float:
    """Return the largest size of a channel as logged, also if it stands still; of a rate, of its sum at `step` [s]."""
    columns = draft.sniffed.columns
    values = np.asarray(sum(term.factor * columns[term.column] for term in draft.picks[channel].terms))
    if draft.picks[channel].integrate:
        values = step * np.cumsum(np.nan_to_num(values))
    values = np.abs(values)
    return float(values[np.isfinite(values)].max(initial=0.0))


def _time(draft: Draft, found: dict[str, Unit]) -> None:
    if "time" not in draft.picks:
        return
    column = draft.picks["time"].terms[0].column
    if column in draft.sniffed.dates:
        found["time"] = Unit(DATE, 1.0, "it holds dates or times of day")
        return
    unit = draft.picks["time"].unit
    if unit is not None:
        found["time"] = Unit(*_CLOCKS.get(unit, (unit, 1.0)), f"its title says {unit}")
        return
    step = np.diff(draft.values("time"))
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    odds = {
        name: exp(
            -0.5 * (log(max(typical, 1e-300) * factor * (1e-3 if unit == "ms" else 1.0) / _USUAL) / _STEP_SPREAD) ** 2
        )
        for name, (unit, factor) in _CLOCKS.items()
    }
    name = max(odds, key=lambda key: odds[key])
    sure = min(odds[name] / sum(odds.values()), _SUREST) if sum(odds.values()) > 0.0 else 0.5
    why = f"its steps of {typical:.4g} are a sample time only in {name}"
    found["time"] = Unit(*_CLOCKS[name], why, sure)


def _angles(draft: Draft, found: dict[str, Unit], *, counted: bool) -> None:
    """Judge the units of set-points, positions and platform together; a title tells the unit of its whole group."""
    apart = _asked_in_another_unit(draft, found)
    groups = {
        "set-points": [name for name in SET_POINTS if name in draft.picks],
        "positions": [name for name in MOTOR_POSITIONS if name in draft.picks and not counted],
        "tilt": [name for name in _TILTED if name in draft.picks and name not in apart],
    }
    groups = {group: names for group, names in groups.items() if names}
    step = nominal_step(draft, found)
    reaches = {group: max(largest(draft, name, step) for name in names) for group, names in groups.items()}
    summed = {group for group, names in groups.items() if draft.picks[names[0]].integrate}
    titled: dict[str, str] = {}
    for group, names in groups.items():
        said = {found[name].name.removesuffix("/s") for name in names if name in found} & {"rad", "deg"}
        if len(said) == 1:
            titled[group] = said.pop()
    turned = "orientation" in draft.picks and "tilt" not in titled and largest(draft, "orientation") > 2.1 * np.pi
    verdicts = judge(reaches, {**titled, "tilt": "deg"} if turned else titled)
    for group, verdict in verdicts.items():
        why = _why(reaches, titled, group, verdict)
        sure = 1.0 if group in titled or reaches[group] == 0.0 else min(verdict.probability, _SUREST)
        sure = min(sure, _ALONE) if verdict.alone else sure
        if group == "tilt" and turned:
            why, sure = "the orientation reaches more than a turn in rad", _SUREST
        elif group == "tilt" and group not in titled and _apart(draft):
            why, sure = f"{why}; but one of pitch and roll goes {_FAR_APART:g} times as far as the other", _ALIKE
        for name in (*groups[group], *(["orientation"] if group == "tilt" and "orientation" in draft.picks else [])):
            found.setdefault(name, Unit(verdict.unit + ("/s" if group in summed else ""), 1.0, why, sure))
    if "tilt" in verdicts:
        for name in ("pitch_rate", "roll_rate"):
            if name in draft.picks:
                found.setdefault(name, Unit(f"{verdicts['tilt'].unit}/s", 1.0, "as the angles", 0.9))


def _asked_in_another_unit(draft: Draft, found: dict[str, Unit]) -> tuple[str, ...]:
    """Return the references where no title names a unit and they reach so far beside the angles that theirs differs."""
    asked = [name for name in _REFERENCES if name in draft.picks]
    angles = [name for name in (*OUTPUTS, "inclination") if name in draft.picks]
    if any(name in found for name in (*asked, *angles)):
        return ()
    reaches = [max((largest(draft, name) for name in names), default=0.0) for names in (asked, angles)]
    return tuple(asked) if max(reaches) > _TWO_UNITS * min(reaches) > 0.0 else ()


def _references(draft: Draft, found: dict[str, Unit]) -> None:
    """Take references that are not in the unit of the angles in the other one, which is doubted, and so is theirs."""
    for name in (one for one in _REFERENCES if one in draft.picks and one not in found):
        beside = next((one for one in (*OUTPUTS, "inclination") if one in found), None)
        if beside is None:
            continue
        other = "deg" if found[beside].name == "rad" else "rad"
        why = f"reach {largest(draft, name):.4g}, the angles {largest(draft, beside):.4g}: they are in two units"
        found[name] = Unit(other, 1.0, f"what is asked of the angles {why}", _ALONE)
        for angle in (*OUTPUTS, "inclination", "orientation"):
            if angle in found and found[angle].confidence > _ALONE:
                found[angle] = found[angle]._replace(confidence=_ALONE, why=f"{found[angle].why}; references {why}")


def _counts(draft: Draft, found: dict[str, Unit]) -> float | None:
    """Return how many times as large as the set-points positions of no named unit are that follow them, where that is
    no question of rad and deg."""
    if not draft.has(MOTOR_POSITIONS) or not draft.has(SET_POINTS) or MOTOR_POSITIONS[0] in found:
        return None
    x, u = (np.column_stack([draft.values(name) for name in names]) for names in (MOTOR_POSITIONS, SET_POINTS))
    seen = np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1)
    if not seen.any():
        return None
    x, u = x[seen] - x[seen].mean(axis=0), u[seen] - u[seen].mean(axis=0)
    size = np.sqrt((x**2).sum() * (u**2).sum())
    if size <= 0.0 or (x * u).sum() < _FOLLOW * size:
        return None
    # Drives lag behind what is asked: the static gain of one pole, and not the ratio of sizes, is a count's.
    before_and_now = np.column_stack([x[:-1].ravel(), u[:-1].ravel(), u[1:].ravel()])
    a, *b = np.linalg.lstsq(before_and_now, x[1:].ravel(), rcond=None)[0]
    counts = float(sum(b) / (1.0 - a)) if abs(a) < 1.0 else 0.0
    apart = max(counts, 1.0 / counts) if counts > 0.0 else 0.0
    return counts if apart > _COUNTS and not _DEGREES[0] < apart < _DEGREES[1] else None


def _of_counts(counts: float, unit: str) -> Unit:
    """Return the unit of positions by that of their set-points, to be multiplied by a factor that was fitted."""
    factor = float(f"{1.0 / counts:.4g}")
    why = f"they follow the set-points {counts:.4g} times as large (counts, turns, a gear?); the factor was fitted"
    return Unit(unit, factor, why, _ALIKE)


def _apart(draft: Draft) -> bool:
    """Return whether pitch and roll of a log may be in two units, or one of them is something else."""
    sizes = [largest(draft, name) for name in OUTPUTS if name in draft.picks]
    return len(sizes) == 2 and max(sizes) > _FAR_APART * min(sizes) > 0.0


def _why(reaches: dict[str, float], titled: dict[str, str], group: str, verdict: Verdict) -> str:
    """Return why a group is in its unit."""
    reach = reaches[group]
    if group == "tilt":
        if titled.get(group):
            return "the title of another of the platform's columns says so"
        if verdict.unit == "deg":
            return f"the platform reaches {reach:.4g}, " + (
                "more than a quarter turn in rad" if reach > np.pi / 2.0 else "too far in rad for these motors"
            )
        return f"the platform stays within {reach:.4g}, as the neck does in rad"
    if group in titled:
        return "the title of another of the motors' columns says so"
    if verdict.alone:
        return "of set-points and positions one reaches 57 times the other"
    both = "set-points" in reaches and "positions" in reaches
    who = "the motors' set-points and positions reach" if both else "they reach"
    who = f"{who} {max(reaches.get(name, 0.0) for name in ('set-points', 'positions')):.4g}, "
    other = "positions" if group == "set-points" else "set-points"
    if other in titled:
        return who + "and the title of another of the motors' columns says so"
    if verdict.unit == "deg":
        return who + (
            "beyond two turns in rad" if reach > MOTOR_TURNS else "which in rad does not fit how the platform moves"
        )
    return who + (
        "within the motors' reach" if reach <= MOTOR_RANGE else "beyond their range, but in deg hardly a move"
    )


def _velocities(draft: Draft, found: dict[str, Unit]) -> None:
    """Take the unit in which rates and positions agree at a period next to the time column's, or to 20 ms."""
    if not draft.has(MOTOR_VELOCITIES) or MOTOR_VELOCITIES[0] in found:
        return
    if not draft.has(MOTOR_POSITIONS):
        if SET_POINTS[0] in draft.picks and draft.picks[SET_POINTS[0]].integrate:
            found.update({name: found[asked] for name, asked in zip(MOTOR_VELOCITIES, SET_POINTS, strict=True)})
        return
    factors = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "rpm": np.pi / 30.0}
    angle = np.pi / 180.0 if found[MOTOR_POSITIONS[0]][0] == "deg" else 1.0
    run = draft.runs()
    periods = [
        angle * velocity_period(draft.values(p), draft.values(v), run)[0]
        for p, v in zip(MOTOR_POSITIONS, MOTOR_VELOCITIES, strict=True)
    ]
    period = float(np.median(periods))
    nominal = nominal_step(draft, found)
    if period <= 0.0:
        return
    unit = min(factors, key=lambda name: abs(np.log(period / factors[name] / nominal)))
    why = f"in it they agree with the positions at {1e3 * period / factors[unit]:.3g} ms a sample"
    for name in MOTOR_VELOCITIES:
        found[name] = Unit(unit, 1.0, why, 0.97)


def nominal_step(draft: Draft, found: dict[str, Unit]) -> float:
    """Return the time column's usual step [s], or the paper's sample time where there is none."""
    if "time" not in draft.picks:
        return _USUAL
    unit, factor, *_ = found["time"]
    if unit == DATE:
        unit = "s"
    step = np.diff(draft.values("time"))
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    return max(typical * factor * (1e-3 if unit == "ms" else 1.0), 1e-9)
