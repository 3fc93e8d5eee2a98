"""Units of a guess: from titles, else from the range of the numbers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log, log1p, pi
from typing import NamedTuple

import numpy as np

from softneck.core import Vector, to_si

from ..recording._channels import MOTOR_POSITIONS, MOTOR_TURNS, MOTOR_VELOCITIES, OUTPUTS, SET_POINTS, file_unit
from ._clocks import velocity_period
from ._draft import Doubt, Draft, column_label
from ._odd_clocks import is_serial_days, rises
from ._table_format import SniffResult
from .formats._text import DATE

_DEGREE = pi / 180.0
UNITS = {"rad": 1.0, "deg": _DEGREE}
# Logarithms of usual sizes and their spreads: half of all logs lie within a factor of exp(0.67 spread).
# [rad] The paper's motors move by 1 to 6 rad, and less in logs near rest.
_MOTOR_REACH, _MOTOR_SPREAD = log(2.0), 0.8
# [rad] The platform tilts by 5 to 45 deg.
_TILT_REACH, _TILT_SPREAD = log(0.3), 0.8
# [rad/rad] 5 deg per rad for winches of 7.5 mm; less for stiff necks and thin winches, more for long arms.
_GAIN, _GAIN_SPREAD = log(0.1), 0.9
# [rad] Largest motor angle of the paper, and a tilt of about 45 deg.
MOTOR_RANGE, _TILT_RANGE = 6.0, 0.8
_BEYOND_RANGE = log(0.03)
_TILT_LIMIT = pi / 2.0
# Probability that a logger writes set-points and positions in two units.
_TWO_UNITS_LOG_ODDS = log(0.02)
# Positions reach their set-points, or any value if a drive is off or late.
_FOLLOW_SPREAD, _LATE, _LATE_SPREAD = 0.2, 0.05, 2.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The likeliest unit of a group, and its probability; `alone`: set-points and positions have different units."""

    unit: str
    probability: float
    alone: bool = False


def judge(reaches: Mapping[str, float], titled: Mapping[str, str]) -> dict[str, Verdict]:
    """Return the units of the logged groups among `set-points`, `positions` and `tilt`, by their largest magnitudes.

    A unit in the titles of a group is kept.
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
    """Return the log-odds of magnitudes [rad], up to a constant."""
    total = 0.0
    motors = [reach[name] for name in ("set-points", "positions") if reach.get(name, 0.0) > 0.0]
    if len({units[name] for name in ("set-points", "positions") if name in units}) > 1:
        total += _TWO_UNITS_LOG_ODDS
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


_REFERENCE_CHANNELS = ("pitch_reference", "roll_reference")
_TILT_CHANNELS = ("pitch", "roll", "inclination", *_REFERENCE_CHANNELS)
# [s] The paper's sample time, the prior where data leave it open; two thirds of all loggers lie within a factor of
# exp(1.2).
_USUAL_STEP_S, _STEP_SPREAD = 0.02, 1.2
# A sample time this far from usual is doubted; outside these bounds [s] another reading of the clock is taken.
_FAR_STEP, _STEP_BOUNDS_S = 50.0, (0.99e-4, 600.0)
# Of a clock whose title names none; minutes only a title can name. Where a title is doubted it may be one of these.
_CLOCKS, _TITLED_CLOCKS = ("s", "ms", "us", "ns"), ("s", "ms", "us", "ns", "min")
# Largest confidence, since robots differ more than the prior; the same if set-points and positions have two units.
_MAX_CONFIDENCE, _SEPARATE_CONFIDENCE = 0.99, 0.85
# Ratio of pitch to roll that makes their unit doubtful, and its confidence.
_DOUBTFUL_RATIO, _DOUBTFUL_CONFIDENCE = 20.0, 0.6
_DAYS_CONFIDENCE, _AMBIGUOUS_CONFIDENCE = 0.95, 0.8
# References and angles have two units if they differ by more than half of the factor 57, in logarithms. Positions that
# follow set-points this well and are so many times larger or smaller are counts, turns, or before a gear, unless the
# ratio is near 57.
_TWO_UNITS_RATIO, _MIN_FOLLOW_CORRELATION, _MIN_COUNT_RATIO, _DEGREE_RATIOS = 7.6, 0.9, 3.0, (45.0, 72.0)


class Unit(NamedTuple):
    """A channel's unit, a factor to it, the reason, and the confidence."""

    name: str
    factor: float
    why: str
    confidence: float = 1.0

    @property
    def si(self) -> float:
        """The factor to SI."""
        return self.factor * to_si(self.name)[0]


def units(draft: Draft) -> dict[str, Unit]:
    """Return the unit of each pick."""
    found: dict[str, Unit] = {}
    for channel, pick in draft.picks.items():
        if pick.unit is not None and channel not in ("time", "run"):
            sure = _AMBIGUOUS_CONFIDENCE if pick.ambiguous else 1.0
            found[channel] = Unit(pick.unit, 1.0, pick.ambiguous or "its title says so", sure)
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
    for channel, pick in draft.picks.items():
        title = draft.titles.get(pick.terms[0].column)
        if title is not None and title.written and pick.unit is None and channel in found:
            why = f"its title names `{title.written}`, which is no known unit of it; {found[channel].why}"
            found[channel] = found[channel]._replace(
                why=why, confidence=min(found[channel].confidence, _DOUBTFUL_CONFIDENCE)
            )
    return found


def largest(draft: Draft, channel: str, step: float = 1.0) -> float:
    """Return the largest magnitude of a channel as logged; of a rate, of its integral with `step` [s]."""
    columns = draft.sniffed.columns
    values = np.asarray(sum(term.factor * columns[term.column] for term in draft.picks[channel].terms))
    if draft.picks[channel].integrate:
        values = step * np.cumsum(np.nan_to_num(values))
    values = np.abs(values)
    return float(values[np.isfinite(values)].max(initial=0.0))


def _time(draft: Draft, found: dict[str, Unit]) -> None:
    if "time" in draft.picks:
        pick = draft.picks["time"]
        dates = pick.terms[0].column in draft.sniffed.dates
        found["time"] = Unit(DATE, 1.0, "it holds dates or times of day") if dates else clock_unit(
            draft.values("time"), pick.unit, neck=draft.neck
        )  # fmt: skip


def clock_unit(values: Vector, titled: str | None, *, neck: bool) -> Unit:
    """Return the unit of a clock (time,) whose title names the unit `titled` or none; `neck`: of the neck's log."""
    step = np.diff(values)
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    if titled is not None:
        return _doubted_clock(Unit(titled, 1.0, f"its title says {titled}"), typical, neck=neck)
    if is_serial_days(values):
        why = "it counts days, as a spreadsheet or `datenum` does (a day has 86,400 s)"
        return Unit("days", 1.0, why, _DAYS_CONFIDENCE)
    odds = {
        name: exp(-0.5 * (log(max(typical, 1e-300) * to_si(name)[0] / _USUAL_STEP_S) / _STEP_SPREAD) ** 2)
        for name in _CLOCKS
    }
    name = max(odds, key=lambda key: odds[key])
    sure = min(odds[name] / sum(odds.values()), _MAX_CONFIDENCE) if sum(odds.values()) > 0.0 else 0.5
    return Unit(name, 1.0, f"its steps of {typical:.4g} are a sample time only in {name}", sure)


def _doubted_clock(unit: Unit, typical: float, *, neck: bool) -> Unit:
    """Doubt a title whose sample time is far from usual; take another reading if it is impossible.

    A robot that is no neck may be as slow as its title says, such as a heated one.
    """
    step = max(typical * unit.si, 1e-9)
    if _USUAL_STEP_S / _FAR_STEP <= step <= (_USUAL_STEP_S * _FAR_STEP if neck else _STEP_BOUNDS_S[1]):
        return unit
    others = {name: typical * to_si(name)[0] for name in _TITLED_CLOCKS if name != unit.name}
    other = min(others, key=lambda name: abs(log(max(others[name], 1e-300) / _USUAL_STEP_S)))
    why = (
        f"an unusual sample time: {1e3 * step:.4g} ms by its title, {1e3 * others[other]:.4g} ms if its numbers "
        f"are {other}"
    )
    if _STEP_BOUNDS_S[0] <= step <= _STEP_BOUNDS_S[1]:
        return Unit(unit.name, 1.0, why, _DOUBTFUL_CONFIDENCE)
    return Unit(other, 1.0, why, _DOUBTFUL_CONFIDENCE)


def unread_clocks(table: SniffResult, sample_time: float) -> list[Doubt]:
    """Return a doubt about a sample time [s] that a user gave for each column that may be a clock all the same."""
    said = {column: "its title names time" for column in (*table.words, *table.columns)
            if (title := table.title(column)).role == "time" or title.quantity == "s"}  # fmt: skip
    said |= {column: "it rises from row to row" for column, values in table.columns.items()
             if column not in said and rises(values)}  # fmt: skip
    return [
        Doubt("sample time", ("sample_time",), f"{1e3 * sample_time:.6g} ms as given", _DOUBTFUL_CONFIDENCE,
              f"{column_label(column)} was not recognised as a clock, and {why}; if it is one, write it into [time]")
        for column, why in said.items()
    ]  # fmt: skip


def _angles(draft: Draft, found: dict[str, Unit], *, counted: bool) -> None:
    """Judge the units of set-points, positions and platform together; a title's unit holds for its whole group."""
    apart = _asked_in_another_unit(draft, found)
    groups = {
        "set-points": [name for name in SET_POINTS if name in draft.picks],
        "positions": [name for name in MOTOR_POSITIONS if name in draft.picks and not counted],
        "tilt": [name for name in _TILT_CHANNELS if name in draft.picks and name not in apart],
    }
    groups = {group: names for group, names in groups.items() if names}
    step = nominal_step(draft, found)
    reaches = {group: max(_reach(draft, found, name, step) for name in names) for group, names in groups.items()}
    summed = {group for group, names in groups.items() if draft.picks[names[0]].integrate}
    named = {group: {found[name].name.removesuffix("/s") for name in names if name in found}
             for group, names in groups.items()}  # fmt: skip
    alike = {group: names.pop() for group, names in named.items() if len(names) == 1}
    titled = {group: "deg" if name == "deg" else "rad" for group, name in alike.items()}
    turned = "orientation" in draft.picks and "tilt" not in titled and largest(draft, "orientation") > 2.1 * np.pi
    verdicts = judge(reaches, {**titled, "tilt": "deg"} if turned else titled)
    for group, verdict in verdicts.items():
        why = _why(reaches, titled, group, verdict)
        sure = 1.0 if group in titled or reaches[group] == 0.0 else min(verdict.probability, _MAX_CONFIDENCE)
        sure = min(sure, _SEPARATE_CONFIDENCE) if verdict.alone else sure
        if group == "tilt" and turned:
            why, sure = "the orientation reaches more than a turn in rad", _MAX_CONFIDENCE
        elif group == "tilt" and group not in titled and _may_differ_in_unit(draft):
            why, sure = (
                f"{why}; but one of pitch and roll goes {_DOUBTFUL_RATIO:g} times as far as the other",
                _DOUBTFUL_CONFIDENCE,
            )
        for name in (*groups[group], *(["orientation"] if group == "tilt" and "orientation" in draft.picks else [])):
            unit = alike.get(group, verdict.unit)
            found.setdefault(name, Unit(f"{unit}/s" if group in summed else unit, 1.0, why, sure))
    if "tilt" in verdicts:
        for name in ("pitch_rate", "roll_rate"):
            if name in draft.picks:
                unit = alike.get("tilt", verdicts["tilt"].unit)
                found.setdefault(name, Unit(f"{unit}/s", 1.0, "as the angles", 0.9))


def _reach(draft: Draft, found: dict[str, Unit], name: str, step: float) -> float:
    """Return the largest magnitude of a channel: as logged in deg or in an unknown unit, else in rad."""
    unit = found.get(name)
    factor = 1.0 if unit is None or unit.name.removesuffix("/s") == "deg" else unit.si
    return factor * largest(draft, name, step)


def _asked_in_another_unit(draft: Draft, found: dict[str, Unit]) -> tuple[str, ...]:
    """Return the references whose magnitude differs so much from the angles that their unit must differ too."""
    references = [name for name in _REFERENCE_CHANNELS if name in draft.picks]
    angles = [name for name in (*OUTPUTS, "inclination") if name in draft.picks]
    if any(name in found for name in (*references, *angles)):
        return ()
    reaches = [max((largest(draft, name) for name in names), default=0.0) for names in (references, angles)]
    return tuple(references) if max(reaches) > _TWO_UNITS_RATIO * min(reaches) > 0.0 else ()


def _references(draft: Draft, found: dict[str, Unit]) -> None:
    """Give references in another unit than the angles the other unit; both are doubtful."""
    for name in (one for one in _REFERENCE_CHANNELS if one in draft.picks and one not in found):
        beside = next((one for one in (*OUTPUTS, "inclination") if one in found), None)
        if beside is None:
            continue
        other = "deg" if found[beside].name == "rad" else "rad"
        why = f"reach {largest(draft, name):.4g}, the angles {largest(draft, beside):.4g}: they are in two units"
        found[name] = Unit(other, 1.0, f"references of the angles {why}", _SEPARATE_CONFIDENCE)
        for angle in (*OUTPUTS, "inclination", "orientation"):
            if angle in found and found[angle].confidence > _SEPARATE_CONFIDENCE:
                found[angle] = found[angle]._replace(
                    confidence=_SEPARATE_CONFIDENCE, why=f"{found[angle].why}; references {why}"
                )


def _counts(draft: Draft, found: dict[str, Unit]) -> float | None:
    """Return the ratio of positions to the set-points that they follow; None if it may be that of rad and deg."""
    if not draft.has(MOTOR_POSITIONS) or not draft.has(SET_POINTS) or MOTOR_POSITIONS[0] in found:
        return None
    x, u = (np.column_stack([draft.values(name) for name in names]) for names in (MOTOR_POSITIONS, SET_POINTS))
    present = np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1)
    if not present.any():
        return None
    x, u = x[present] - x[present].mean(axis=0), u[present] - u[present].mean(axis=0)
    size = np.sqrt((x**2).sum() * (u**2).sum())
    if size <= 0.0 or (x * u).sum() < _MIN_FOLLOW_CORRELATION * size:
        return None
    # Drives lag behind their set-points, so the ratio is the static gain of a first-order fit, not that of the sizes.
    before_and_now = np.column_stack([x[:-1].ravel(), u[:-1].ravel(), u[1:].ravel()])
    a, *b = np.linalg.lstsq(before_and_now, x[1:].ravel(), rcond=None)[0]
    counts = float(sum(b) / (1.0 - a)) if abs(a) < 1.0 else 0.0
    apart = max(counts, 1.0 / counts) if counts > 0.0 else 0.0
    return counts if apart > _MIN_COUNT_RATIO and not _DEGREE_RATIOS[0] < apart < _DEGREE_RATIOS[1] else None


def _of_counts(counts: float, unit: str) -> Unit:
    """Return the unit of positions: that of their set-points, with a fitted factor."""
    factor = float(f"{1.0 / counts:.4g}")
    why = f"they follow the set-points {counts:.4g} times as large (counts, turns, a gear?); the factor was fitted"
    return Unit(unit, factor, why, _DOUBTFUL_CONFIDENCE)


def _may_differ_in_unit(draft: Draft) -> bool:
    """Return whether pitch and roll may be in two units, or one of them is another quantity."""
    sizes = [largest(draft, name) for name in OUTPUTS if name in draft.picks]
    return len(sizes) == 2 and max(sizes) > _DOUBTFUL_RATIO * min(sizes) > 0.0


def _why(reaches: dict[str, float], titled: dict[str, str], group: str, verdict: Verdict) -> str:
    """Return the reason for a group's unit."""
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
    """Choose the unit in which rates and positions agree at a period close to the time column's, or to 20 ms."""
    if not draft.has(MOTOR_VELOCITIES) or MOTOR_VELOCITIES[0] in found:
        return
    if not draft.has(MOTOR_POSITIONS):
        if SET_POINTS[0] in draft.picks and draft.picks[SET_POINTS[0]].integrate:
            found.update(
                {name: found[references] for name, references in zip(MOTOR_VELOCITIES, SET_POINTS, strict=True)}
            )
        return
    factors = {name: to_si(name)[0] for name in ("rad/s", "deg/s", "rpm")}
    angle = found[MOTOR_POSITIONS[0]].si
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
    """Return the time column's median step [s], or the paper's sample time without one."""
    if "time" not in draft.picks:
        return _USUAL_STEP_S
    step = np.diff(draft.values("time"))
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    return max(typical * (1.0 if found["time"].name == DATE else found["time"].si), 1e-9)
