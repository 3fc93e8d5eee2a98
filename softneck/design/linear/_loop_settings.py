"""What all designs around a linear plant are told of the loop: its order, its speed, and two limits of set-points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from softneck.core import SettingsError, require_between, require_finite, require_one_of, require_positive, to_si
from softneck.estimation import ORDERS
from softneck.robot import Robot, Scaling

from ..plants._uncertain import UncertainPlant
from ._ports import ControllerLimits, limits_of

#: Of `reference_time`: as slow as the plant's main pole.
PLANT = "plant"


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Settings that all designs around a linear plant share; a kind adds its own and `design`.

    A kind calls `LoopSettings.__post_init__(self)` by name: with slots `super()` would look in the wrong class.

    How far and how fast motors go, and how often, is in the robot's file.

    Attributes:
        lead_limit: how far a set-point may be from its measured motor, in the unit of the motors; keeps the integral
            from winding up while a drive at its current limit falls behind. None: of the neck 0.4 rad, without a
            nominal set-point no limit.
        least_cocontraction: the co-contraction reference is at least this, in the unit of the motors; keeps tendons
            taut under a payload. None for no such rule.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
        rise_s: time [s] in which a step on the nominal plant rises from 10 to 90 %, no limit acting; the reference
            filter is made for it in the place of `reference_time`. None: by that.
    """

    #: How far a set-point may be from its motor, scaled.
    LEAD: ClassVar[float] = 0.4

    lead_limit: float | None = None
    least_cocontraction: float | None = None
    order: str = "sequential"
    rise_s: float | None = None

    def __post_init__(self) -> None:
        require_one_of("order", self.order, ORDERS)
        if self.lead_limit is not None:
            require_positive("lead_limit", self.lead_limit)
        if self.least_cocontraction is not None:
            require_finite("least_cocontraction", self.least_cocontraction)
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
            given = getattr(self, "reference_time", None)
            if given is not None and given != PLANT:
                raise SettingsError("`rise_s` sets the reference filter; give it or `reference_time`, not both.")

    def of_robot(self, plant: UncertainPlant) -> Self:
        """Return the settings with the defaults that depend on the plant."""
        usual = {k: v for k, v in self._defaults(plant).items() if getattr(self, k) in (None, PLANT)}
        if self.rise_s is not None:
            usual.pop("reference_time", None)
        return replace(self, **usual)

    def _defaults(self, plant: UncertainPlant) -> dict[str, Any]:
        """Return settings that depend on the plant, where they are not given."""
        if plant.robot.motors.nominal is None:
            return {}
        return {"lead_limit": self.LEAD * Scaling.of(plant.robot).motor_unit / to_si(plant.robot.motors.unit)[0]}

    def limits(self, robot: Robot) -> ControllerLimits:
        """Return the limits of the set-points.

        Raises:
            SettingsError: a robot's limit that its file does not say.
        """
        return limits_of(robot, lead_limit=self.lead_limit, least_cocontraction=self.least_cocontraction)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay: of the controller and of the observer."""
        return 0 if self.order == "sequential" else 2


def reference_numbers(given: Any) -> tuple[float | None, float]:
    """Return T2 [s] and lead of a `reference_time`, which says both or T2 alone.

    Raises:
        SettingsError: no such filter.
    """
    pair = given if isinstance(given, list | tuple) else (None if given == PLANT else given, 0.0)
    if len(pair) != 2:
        raise SettingsError(f"`reference_time` is T2 [s], or [T2, lead]; got {given!r}.")
    time, lead = pair
    if time is not None:
        require_between("reference_time", time, 0.0, 1e6, "s")
    require_between("the lead of `reference_time`", lead, 0.0, 10.0)
    if lead > 0.0 and not time:
        raise SettingsError("a `reference_time` of [T2, lead] needs a T2 above 0.")
    return time, lead
