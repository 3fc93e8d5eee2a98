"""What every design around a linear plant is told of the plant's doubts, the motors' limits and the loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from softneck.core import Matrix, SettingsError, require_between, require_one_of
from softneck.estimation._settings import ORDERS
from softneck.robot import Robot
from softneck.robot._neck_default import NeckDefault
from softneck.robot._redefined import redefinition_of
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ..plants._uncertain import UncertainPlant
from ._ports import LIMITS, ControllerLimits, require_limits, robot_limits

_NECK = Robot.preset("neck")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Settings that all designs around a linear plant share; a kind adds its own and `design`.

    A kind calls `LoopSettings.__post_init__(self)` by name: with slots `super()` would look in the wrong class.

    The defaults are the neck's. Of another robot no dead time and no faster pole is taken for granted, and its limits
    are those of its file; limits that are given are in the unit of its motors.

    Attributes:
        least_delay: the dead time is taken as at least this [s]; a fit of free runs hides it in the pole.
        small_move_pole: the plant is taken as well with its main pole as fast as this [1/s], at the same static
            gain; 0 for the identified plant alone. Fits to large moves come out slower than small moves are, for
            there the drives run at their current limit.
        position_limit: of each motor [rad].
        slew_limit: of each motor [rad/s]; the default is 0.25 rad in 20 ms.
        lead_limit: how far a set-point may be from its measured motor [rad]; keeps the integral from winding up
            while a drive at its current limit falls behind.
        least_position: no motor is let out below this [rad]; co-contraction is raised instead. -6 for no such rule.
        least_cocontraction: the co-contraction reference is at least this [rad]; keeps tendons taut under a payload.
            -6 for no such rule.
        order: of the loop; "jacobi" adds one sample for the controller and one for the observer.
        observer: whether the loop will have an observer.
        rise_s: time [s] in which a step on the nominal plant rises from 10 to 90 %, no limit acting; the reference
            filter is made for it in the place of `reference_time`. None: by that.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    # The paper's own dead time and pole (Eq. 31: 0.08 s, 5.293 1/s).
    least_delay: float = NeckDefault(0.08)
    small_move_pole: float = NeckDefault(5.293)
    position_limit: float = NeckDefault(6.0)
    slew_limit: float = NeckDefault(12.5)
    lead_limit: float = NeckDefault(0.4)
    least_position: float = NeckDefault(-6.0)
    least_cocontraction: float = NeckDefault(-6.0)
    order: str = "sequential"
    observer: bool = True
    rise_s: float | None = None
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        require_between("least_delay", self.least_delay, 0.0, 1.0, "s")
        require_between("small_move_pole", self.small_move_pole, 0.0, 1000.0, "1/s")
        require_one_of("order", self.order, ORDERS)
        require_limits({name: getattr(self, name) for name in LIMITS})
        if self.rise_s is not None:
            require_between("rise_s", self.rise_s, 0.001, 1e6, "s")
            given = getattr(self, "reference_time", None)
            if given is not None and not isinstance(given, NeckDefault):
                raise SettingsError("`rise_s` sets the reference filter; give it or `reference_time`, not both.")

    def of_robot(self, plant: UncertainPlant) -> Self:
        """Return the settings for the robot of `plant`: where nobody says otherwise, nothing that is known of necks.

        Raises:
            SettingsError: tendon angles for a robot that has its own.
        """
        if plant.robot.is_neck:
            return self
        if self.tendon_angles != tuple(TENDON_ANGLES.tolist()):
            raise SettingsError(f"`tendon_angles` are of necks; those of {plant.robot.label()} are in its robot file.")
        others = {
            name: value for name, value in self._others(plant).items() if isinstance(getattr(self, name), NeckDefault)
        }
        if self.rise_s is not None:
            others.pop("reference_time", None)
        return replace(self, **others)

    def _others(self, plant: UncertainPlant) -> dict[str, Any]:  # noqa: ARG002 - kinds add what depends on it
        """Return what stands for another robot in the place of the neck's defaults."""
        return {"least_delay": 0.0, "small_move_pole": 0.0}

    def assumed(self, plant: UncertainPlant) -> dict[str, float]:
        """Return what of the paper's neck, and not of this plant, a design takes where nobody says otherwise."""
        nominal = [axis.nominal for axis in plant.axes.values()] if plant.robot.is_neck else []
        changed = {
            "least_delay": any(item.delayed(self.least_delay).delay > item.delay for item in nominal),
            "small_move_pole": self.small_move_pole > 0.0
            and any(item.faster(self.small_move_pole) is not item for item in nominal),
        }
        return {
            name: float(getattr(self, name))
            for name, changes in changed.items()
            if changes and isinstance(getattr(self, name), NeckDefault)
        }

    def redefinition(self, plant: UncertainPlant) -> tuple[Matrix, Matrix]:
        """Return T from motors to the redefined inputs of all axes and co-contraction, and its inverse."""
        return self.neck_redefinition() if plant.weights is None else redefinition_of(plant.weights, plant.names)

    def neck_redefinition(self) -> tuple[Matrix, Matrix]:
        """Return T of Eq. 9-11 and its inverse."""
        T = redefinition_matrix(np.array(self.tendon_angles))
        return T, np.linalg.inv(T)

    def limits(self, robot: Robot = _NECK) -> ControllerLimits:
        """Return the limits of the set-points.

        Raises:
            SettingsError: a robot's limit that neither its file nor a setting says.
        """
        if not robot.is_neck:
            given = {name: getattr(self, name) for name in LIMITS}
            return robot_limits(robot, {key: v for key, v in given.items() if not isinstance(v, NeckDefault)})
        stricter = stricter_limits(robot, {name: getattr(self, name) for name in LIMITS})
        return ControllerLimits(robot=robot, **stricter)

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay."""
        return 0 if self.order == "sequential" else 1 + int(self.observer)


def check_reference(time: float | None, lead: float) -> None:
    """Raise SettingsError unless T2 [s], where it is given, and what part of the loop's lag leads make a filter."""
    if time is not None:
        require_between("reference_time", time, 0.0, 1e6, "s")
    require_between("reference_lead", lead, 0.0, 10.0)
    if lead > 0.0 and (not time or isinstance(time, NeckDefault)):
        raise SettingsError("`reference_lead` leads the filter of `reference_time`; give that as well, above 0.")


def stricter_limits(neck: Robot, limits: dict[str, float]) -> dict[str, float]:
    """Return the limits with those of the neck's own file, where these are stricter than a default."""
    motors = neck.motors
    files = {"slew_limit": motors.rate_limit, "position_limit": motors.setpoint_max}
    for name, values in files.items():
        if values is not None and isinstance(limits[name], NeckDefault):
            limits[name] = min(limits[name], *values)
    lowest = -limits["position_limit"] if motors.setpoint_min is None else max(motors.setpoint_min)
    # Down to the same limit there is no need of a rule.
    if lowest > -limits["position_limit"] and isinstance(limits["least_position"], NeckDefault):
        limits["least_position"] = max(limits["least_position"], lowest)
    return limits
