"""The search space: the tuned settings of each kind of controller as a unit cube."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import KINDS, SettingsError, Vector, kinds_of, resolve
from softneck.design import AxisSettings
from softneck.robot import Robot, Scaling

#: Kinds searched by default; `nmpc` needs a nonlinear model and minutes.
KINDS_SEARCHED = ("pi", "pid", "fopi", "hinf", "lqg", "adaptive", "mpc")
#: Kinds without linear form: beside recordings they are not certified, and searched only if named.
UNCERTIFIED = ("adaptive",)
#: Kinds whose design takes ten times as long.
COSTLY = ("mpc", "nmpc")


@dataclass(frozen=True, slots=True)
class Dimension:
    """The range of one setting.

    `name`: of the setting. `low`, `high`: ends of its range; logarithmic. `start`: where the search begins.
    """

    name: str
    low: float
    high: float
    start: float

    def value(self, part: float) -> float:
        """Return the setting at a share of the range, 0 to 1, in the four digits that are logged."""
        return float(f"{self.low * (self.high / self.low) ** min(max(part, 0.0), 1.0):.4g}")

    @property
    def start_part(self) -> float:
        """The start as a share of the range, 0 to 1."""
        return math.log(self.start / self.low) / math.log(self.high / self.low)


_ANGLE = math.radians(1.0)
# The bound on Ms sets the speed of the feedback; `rise_s` sets the reference filter.
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
# Start of `rise_s` over the required rise, chosen by this search on the held-out robots `column` and `chain`: the
# slowest payload and the motors make the rise longer than that of the nominal plant.
_RISE_RATIO = 0.42
# Smallest `rise_s` over the shortest rise of the motors.
_RISE_MARGIN = 1.03
# Of the neck; not searched, as loops over models do not show its effect. On `chain` those over grey boxes are equal
# from 0.4 to 1.5; the robot overshoots by 2 % at 0.4 and 0.6, 7 % at 0.8, 20 % at 1.5, and is slow at 0.4.
_LEAD_LIMIT_RAD = 0.6
# The second number of `reference_time`.
_LEAD = Dimension("lead", 0.2, 2.5, 1.0)
# The third, where draws of a family decide.
_FEEDFORWARD = Dimension("feedforward", 0.6, 1.4, 0.9)
# How far a detuned design is from another, as shares of the ranges.
_DETUNED = {"max_sensitivity": 0.1, _LEAD.name: 0.28}
# Kinds for which `lead_limit` is searched.
_PREDICTIVE_KINDS = ("mpc", "nmpc")


@dataclass(frozen=True, slots=True)
class Space:
    """The searched and fixed settings of one kind.

    `kind`: of controller. `dimensions`: searched. `fixed`: settings that hold for all.
    """

    kind: str
    dimensions: tuple[Dimension, ...]
    fixed: Mapping[str, Any]

    @property
    def start(self) -> Vector:
        """The start of the search in the cube."""
        return np.array([item.start_part for item in self.dimensions])

    @property
    def trade_off(self) -> int | None:
        """Index of the setting that trades speed for margins, or None."""
        names = [item.name for item in self.dimensions]
        return names.index("max_sensitivity") if "max_sensitivity" in names else None

    def detuned(self, x: Vector) -> Vector:
        """Return a point with smaller peaks of S and less lead of the reference."""
        away = np.array([_DETUNED.get(item.name, 0.0) for item in self.dimensions])
        return np.clip(x - away, 0.0, 1.0)

    def settings(self, x: Vector) -> dict[str, Any]:
        """Return the settings at a point of the cube."""
        searched: dict[str, Any] = {
            item.name: item.value(float(part)) for item, part in zip(self.dimensions, x, strict=True)
        }
        if _LEAD.name in searched:
            names = [name for name in (_LEAD.name, _FEEDFORWARD.name) if name in searched]
            searched["reference_time"] = [searched["reference_time"], *(searched.pop(name) for name in names)]
        return {**self.fixed, **searched}


def spaces(
    kinds: tuple[str, ...], *, rise: float, cocontraction: float | None, robot: Robot, least: float = 0.0,
    drawn: bool = False,
) -> list[Space]:  # fmt: skip
    """Return the space of every kind.

    `rise` and `least` [s] are the longest allowed rise and the shortest of the motors; `cocontraction` is that of the
    recordings [SI], or None; `drawn`: whether draws of a family decide. Only tendons on winches need a `lead_limit`.
    Raises SettingsError: an unknown kind, or one with nothing to search.
    """
    found, least = [], min(least, rise)
    lead = Scaling.of(robot).motor_unit if robot.tendon_angles is not None else None
    planned = () if lead is None else (Dimension("lead_limit", 0.4 * lead, 2.0 * lead, 0.8 * lead),)
    for kind in kinds:
        if kind not in _DIMENSIONS:
            what = (
                f"`{kind}` cannot be tuned"
                if kind in kinds_of("controller")
                else f"unknown kind of controller `{kind}`"
            )
            raise SettingsError(f"{what}; use some of {', '.join(_DIMENSIONS)}.")
        settings = resolve(KINDS[kind].settings)
        names = {_LEAD.name, _FEEDFORWARD.name, *(item.name for item in dataclasses.fields(settings))}
        low, start = max(0.3 * rise, _RISE_MARGIN * least), max(_RISE_RATIO * rise, _RISE_MARGIN**2 * least)
        speed: tuple[Dimension, ...] = (Dimension("rise_s", low, 1.2 * rise, start),)
        if issubclass(settings, AxisSettings):
            # With a lead a step reaches the motors' limits at once and a circle is followed more closely.
            speed = (Dimension("reference_time", 0.05 * rise, 0.6 * rise, 0.25 * rise), _LEAD)
            speed = (*speed, _FEEDFORWARD) if drawn else speed
        wanted = (*speed, *_DIMENSIONS[kind], *(planned if kind in _PREDICTIVE_KINDS else ()))
        fixed: dict[str, Any] = (
            {"lead_limit": _LEAD_LIMIT_RAD * lead} if lead is not None and kind not in _PREDICTIVE_KINDS else {}
        )
        if cocontraction is not None and "least_cocontraction" in names:
            fixed["least_cocontraction"] = cocontraction
        if cocontraction is not None and planned and kind == "nmpc":
            # Its plan must start at the recorded co-contraction: with slack tendons the design is refused.
            fixed["minimum_tautness"] = cocontraction
        found.append(Space(kind, tuple(item for item in wanted if item.name in names), fixed))
    return found
