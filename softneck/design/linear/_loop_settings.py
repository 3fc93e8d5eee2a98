"""What every design around a linear plant is told of the plant's doubts, the motors' limits and the loop."""

from __future__ import annotations

from dataclasses import dataclass

from softneck.core import require_between, require_one_of
from softneck.estimation._settings import ORDERS
from softneck.signals import TENDON_ANGLES

from ._ports import ControllerLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Settings that all designs around a linear plant share; a kind adds its own and `design`.

    A kind calls `LoopSettings.__post_init__(self)` by name: with slots `super()` would look in the wrong class.

    Attributes:
        least_delay: the dead time is taken as at least this [s]; a fit of free runs hides it in the pole.
        small_move_pole: the plant is taken as well with its slowest pole as fast as this [1/s], at the same static
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
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    # The paper's own dead time and pole (Eq. 31: 0.08 s, 5.293 1/s).
    least_delay: float = 0.08
    small_move_pole: float = 5.293
    position_limit: float = 6.0
    slew_limit: float = 12.5
    lead_limit: float = 0.4
    least_position: float = -6.0
    least_cocontraction: float = -6.0
    order: str = "sequential"
    observer: bool = True
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        require_between("least_delay", self.least_delay, 0.0, 1.0, "s")
        require_between("small_move_pole", self.small_move_pole, 0.0, 1000.0, "1/s")
        require_one_of("order", self.order, ORDERS)
        self.limits()

    def limits(self) -> ControllerLimits:
        """Return the limits of the set-points."""
        return ControllerLimits(
            position_limit=self.position_limit,
            slew_limit=self.slew_limit,
            lead_limit=self.lead_limit,
            least_position=self.least_position,
            least_cocontraction=self.least_cocontraction,
        )

    @property
    def extra_delay(self) -> int:
        """Samples that the loop's order adds to the plant's delay."""
        return 0 if self.order == "sequential" else 1 + int(self.observer)
