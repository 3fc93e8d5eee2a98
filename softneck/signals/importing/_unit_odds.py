"""In which units the motors and the platform of one log are: all choices weighed together.

Each choice of units makes of the logged numbers a reach of the motors, a reach of the platform and a gain between both,
which robots of this kind have with the odds below; the choices' odds, normalised, are their probabilities (Bayes). No
log was fitted: the centres are the paper's neck, the spreads are wide on purpose. `tests/signals/test_doubts.py` draws
robots half as wide again and counts: of what was 90 % sure, 96 % was right.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log, log1p, pi

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
_TWO_UNITS = log(0.02)
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
        total += _TWO_UNITS
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
