"""What is searched: for each kind of controller the settings that matter, from a cube to numbers and back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import KINDS, SettingsError, Vector, kinds_of, resolve, to_si
from softneck.design import AxisSettings
from softneck.robot import Robot, Scaling

#: Kinds that are searched where nobody names any; `nmpc` needs a nonlinear model of its own and minutes.
KINDS_SEARCHED = ("pi", "pid", "fopi", "hinf", "lqg", "adaptive", "mpc")
#: Of these nothing is certified beside recordings, since they have no linear form: named, they are searched there too.
UNCERTIFIED = ("adaptive",)
#: A design of these takes ten times as long as one of the others.
COSTLY = ("mpc", "nmpc")


@dataclass(frozen=True, slots=True)
class Dimension:
    """One setting.

    Attributes:
        name: of the setting.
        low, high: ends of its range; logarithmic.
        start: where the search begins.
    """

    name: str
    low: float
    high: float
    start: float

    def value(self, part: float) -> float:
        """Return the setting at a part of the range, 0 to 1, to four digits: what is logged is what is designed."""
        return float(f"{self.low * (self.high / self.low) ** min(max(part, 0.0), 1.0):.4g}")

    @property
    def start_part(self) -> float:
        """Where the start lies in the range, 0 to 1."""
        return math.log(self.start / self.low) / math.log(self.high / self.low)


_ANGLE = math.radians(1.0)
# The bound on Ms sets how fast the feedback is, the rise what the reference filter makes of it.
_DIMENSIONS: dict[str, tuple[Dimension, ...]] = {
    "pi": (Dimension("max_sensitivity", 1.15, 2.5, 1.5), Dimension("phase_margin", 40 * _ANGLE, 80 * _ANGLE, 1.05)),
    "pid": (Dimension("max_sensitivity", 1.2, 3.0, 1.5), Dimension("noise_gain", 2.0, 10.0, 5.0)),
    "fopi": (Dimension("max_sensitivity", 1.2, 3.0, 1.5), Dimension("phase_margin", 60 * _ANGLE, 100 * _ANGLE, 1.4)),
    "hinf": (Dimension("max_sensitivity", 1.2, 3.0, 1.5), Dimension("control_weight", 0.05, 1.0, 0.3)),
    "lqg": (Dimension("max_sensitivity", 1.2, 3.0, 1.4), Dimension("control_weight", 0.01, 1.0, 0.06),
            Dimension("input_noise", 1.0, 100.0, 5.0)),
    "adaptive": (Dimension("max_sensitivity", 1.15, 2.0, 1.5), Dimension("phase_margin", 0.7, 1.4, 1.05)),
    "mpc": (Dimension("max_sensitivity", 1.2, 2.5, 1.5),),
    "nmpc": (),
}  # fmt: skip
# Starts were chosen on the foreign necks `column` and `chain`, by this search: what is asked of the nominal plant is
# less than what the slowest payload and the motors make of it.
_RISE_RATIO = 0.42
# Above the least that the motors can give.
_RISE_MARGIN = 1.03
# Of a neck [rad], and not searched: loops over models do not see what it does. On `chain` those over grey boxes are the
# same from 0.4 to 1.5, and the neck itself overshoots by 2 % at 0.4 and 0.6, by 7 % at 0.8, by 20 % at 1.5; at 0.4 it
# is slow (0.42 to 0.48 s).
_LEAD_LIMIT_RAD = 0.6
# The second number of `reference_time`.
_LEAD = Dimension("lead", 0.2, 2.5, 1.0)
# These plan with it.
_PREDICTIVE_KINDS = ("mpc", "nmpc")


@dataclass(frozen=True, slots=True)
class Space:
    """The settings of one kind that are searched, and those that are fixed.

    Attributes:
        kind: of controller.
        dimensions: searched.
        fixed: settings that hold for all.
    """

    kind: str
    dimensions: tuple[Dimension, ...]
    fixed: Mapping[str, Any]

    @property
    def start(self) -> Vector:
        """Where the search begins, in the cube."""
        return np.array([item.start_part for item in self.dimensions])

    @property
    def trade_off(self) -> int | None:
        """Number of the setting that trades speed for margins, None where there is none."""
        names = [item.name for item in self.dimensions]
        return names.index("max_sensitivity") if "max_sensitivity" in names else None

    def settings(self, x: Vector) -> dict[str, Any]:
        """Return the settings at a point of the cube."""
        searched: dict[str, Any] = {
            item.name: item.value(float(part)) for item, part in zip(self.dimensions, x, strict=True)
        }
        if _LEAD.name in searched:
            searched["reference_time"] = [searched["reference_time"], searched.pop(_LEAD.name)]
        return {**self.fixed, **searched}


def spaces(
    kinds: tuple[str, ...],
    *,
    rise: float,
    cocontraction: float | None,
    robot: Robot,
    least: float = 0.0,
) -> list[Space]:
    """Return the space of every kind.

    Args:
        kinds: of controllers.
        rise: the longest that is allowed [s].
        cocontraction: at which the robot was recorded, in the unit of its motors; None: no rule is set.
        robot: whose they are; only tendons on winches may lead their motors too far.
        least: the rise that the motors can give at best [s].

    Raises:
        SettingsError: an unknown kind, or one with nothing to search.
    """
    found, least = [], min(least, rise)
    lead = Scaling.of(robot).motor_unit / to_si(robot.motors.unit)[0] if robot.tendon_angles is not None else None
    planned = () if lead is None else (Dimension("lead_limit", 0.4 * lead, 2.0 * lead, 0.8 * lead),)
    for kind in kinds:
        if kind not in _DIMENSIONS:
            raise SettingsError(
                f"`{kind}` cannot be tuned; use some of {', '.join(_DIMENSIONS)}."
                if kind in kinds_of("controller")
                else f"unknown kind of controller `{kind}`; use some of {', '.join(_DIMENSIONS)}."
            )
        settings = resolve(KINDS[kind].settings)
        names = {_LEAD.name, *(item.name for item in dataclasses.fields(settings))}
        speed: tuple[Dimension, ...] = (
            Dimension(
                "rise_s",
                max(0.3 * rise, _RISE_MARGIN * least),
                1.2 * rise,
                max(_RISE_RATIO * rise, _RISE_MARGIN**2 * least),
            ),
        )
        if issubclass(settings, AxisSettings):
            # A step is led into the motors' limits at once, and a circle is followed the closer.
            speed = (Dimension("reference_time", 0.05 * rise, 0.6 * rise, 0.25 * rise), _LEAD)
        wanted = (*speed, *_DIMENSIONS[kind], *(planned if kind in _PREDICTIVE_KINDS else ()))
        fixed: dict[str, Any] = (
            {"lead_limit": _LEAD_LIMIT_RAD * lead} if lead is not None and kind not in _PREDICTIVE_KINDS else {}
        )
        if cocontraction is not None and "least_cocontraction" in names:
            fixed["least_cocontraction"] = cocontraction
        if cocontraction is not None and planned and kind == "nmpc":
            # Its plan begins where the recordings were: elsewhere the tendons hang, and it is refused.
            fixed["minimum_tautness"] = cocontraction
        found.append(Space(kind, tuple(item for item in wanted if item.name in names), fixed))
    return found
