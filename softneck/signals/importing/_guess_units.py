"""Units of a guess: from titles, or else from what the numbers can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..recording._channels import MOTOR_POSITIONS, MOTOR_TURNS, MOTORS, SET_POINTS, file_unit
from ._draft import Draft
from ._sample_time import velocity_period

_VELOCITIES = tuple(f"motor_velocity_{j}" for j in MOTORS)
# Set-points in degrees and positions in rad, or the reverse; at rest a position is within a quarter of its set-point.
_DEGREES, _ALIKE = 180.0 / np.pi, 1.25
# The neck tilts by 0.8 rad at most: as radians, a quarter turn is out of reach.
_TILT = np.pi / 2.0
# The paper's sample time [s], which decides where the data leave it open.
_USUAL = 0.02
# Steps of a time column from which its unit is told: (at least, unit, factor to it).
_CLOCKS = ((1e6, "ms", 1e-6, "ns"), (1e3, "ms", 1e-3, "us"), (1.0, "ms", 1.0, "ms"), (0.0, "s", 1.0, "s"))

Unit = tuple[str, float, str]


def units(draft: Draft) -> dict[str, Unit]:
    """Return for each pick its unit, a factor to it, and why."""
    found: dict[str, Unit] = {}
    for channel, pick in draft.picks.items():
        if pick.unit is not None and channel not in ("time", "run"):
            found[channel] = (pick.unit, 1.0, "its title says so")
    _time(draft, found)
    _motors(draft, found)
    _platform(draft, found)
    _velocities(draft, found)
    for channel in draft.picks:
        if channel not in found and channel != "run":
            found[channel] = (file_unit(channel), 1.0, "the usual unit")
    return found


def largest(draft: Draft, channel: str) -> float:
    """Return the largest size of a channel as logged, of one that stands still too."""
    columns = draft.sniffed.columns
    values = np.abs(sum(term.factor * columns[term.column] for term in draft.picks[channel].terms))
    return float(values[np.isfinite(values)].max(initial=0.0))


def _time(draft: Draft, found: dict[str, Unit]) -> None:
    if "time" not in draft.picks:
        return
    unit = draft.picks["time"].unit
    if unit is not None:
        clear = {"us": ("ms", 1e-3), "ns": ("ms", 1e-6)}.get(unit, (unit, 1.0))
        found["time"] = (*clear, f"its title says {unit}")
        return
    step = np.diff(draft.values("time"))
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    name, factor, meant = next(entry[1:] for entry in _CLOCKS if typical >= entry[0])
    found["time"] = (name, factor, f"its steps of {typical:.4g} are a sample time only in {meant}")


def _motors(draft: Draft, found: dict[str, Unit]) -> None:
    """Positions follow their set-points: both have one unit, of which either may tell, unless they are 57 apart."""
    groups = [group for group in (SET_POINTS, MOTOR_POSITIONS) if draft.has(group)]
    names = [name for group in groups for name in group]
    sizes = {group: max(largest(draft, name) for name in group) for group in groups}
    if (
        len(groups) == 2
        and _DEGREES / _ALIKE < max(sizes.values()) / max(min(sizes.values()), 1e-12) < _DEGREES * _ALIKE
    ):
        for group in groups:
            unit = "deg" if sizes[group] == max(sizes.values()) else "rad"
            _unsure(draft, found, group, (unit, 1.0, "of set-points and positions one reaches 57 times the other"))
        return
    titled = {found[name][0] for name in names if name in found}
    reach = max(sizes.values(), default=0.0)
    beyond = reach > MOTOR_TURNS
    unit = "deg" if beyond else "rad"
    why = (
        f"the motors' set-points and positions reach {reach:.4g}, " if len(groups) == 2 else f"they reach {reach:.4g}, "
    )
    why += "beyond two turns" if beyond else "within the motors' reach"
    if len(titled) == 1:
        unit, why = titled.pop(), "the title of another of the motors' columns says so"
    for name in names:
        found.setdefault(name, (unit, 1.0, why))


def _unsure(draft: Draft, found: dict[str, Unit], group: tuple[str, ...], unit: Unit) -> None:
    for name in group:
        if name not in found:
            found[name] = unit
            draft.picks[name] = replace(draft.picks[name], sure=False)


def _platform(draft: Draft, found: dict[str, Unit]) -> None:
    tilted = [
        name for name in ("pitch", "roll", "inclination", "pitch_reference", "roll_reference") if name in draft.picks
    ]
    if tilted:
        size = max(largest(draft, name) for name in tilted)
        beyond = size > _TILT
        turn = "orientation" in draft.picks and largest(draft, "orientation") > 2.1 * np.pi
        unit = "deg" if beyond or turn else "rad"
        tilt = "the tilt" if "inclination" in draft.picks else "it"
        why = f"{tilt} reaches {size:.4g}, more than a quarter turn in rad"
        if not beyond:
            why = f"{tilt} stays within {size:.4g}, as the neck does in rad"
        if turn and not beyond:
            why = "the orientation reaches more than a turn in rad"
        for name in (*tilted, "orientation"):
            if name in draft.picks:
                found.setdefault(name, (unit, 1.0, why))
    for name in ("pitch_rate", "roll_rate"):
        if name in draft.picks and tilted:
            same = "rad/s" if found[tilted[0]][0] == "rad" else "deg/s"
            found.setdefault(name, (same, 1.0, "as the angles"))


def _velocities(draft: Draft, found: dict[str, Unit]) -> None:
    """Take the unit in which rates and positions agree at a period next to the time column's, or to 20 ms."""
    if not draft.has(_VELOCITIES) or not draft.has(MOTOR_POSITIONS) or _VELOCITIES[0] in found:
        return
    factors = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "rpm": np.pi / 30.0}
    angle = np.pi / 180.0 if found[MOTOR_POSITIONS[0]][0] == "deg" else 1.0
    run = draft.runs()
    periods = [
        angle * velocity_period(draft.values(p), draft.values(v), run)[0]
        for p, v in zip(MOTOR_POSITIONS, _VELOCITIES, strict=True)
    ]
    period = float(np.median(periods))
    nominal = nominal_step(draft, found)
    if period <= 0.0:
        return
    unit = min(factors, key=lambda name: abs(np.log(period / factors[name] / nominal)))
    why = f"in it they agree with the positions at {1e3 * period / factors[unit]:.3g} ms a sample"
    for name in _VELOCITIES:
        found[name] = (unit, 1.0, why)


def nominal_step(draft: Draft, found: dict[str, Unit]) -> float:
    """Return the time column's usual step [s], or the paper's sample time where there is none."""
    if "time" not in draft.picks:
        return _USUAL
    unit, factor, _ = found["time"]
    step = np.diff(draft.values("time"))
    typical = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    return max(typical * factor * (1e-3 if unit == "ms" else 1.0), 1e-9)
