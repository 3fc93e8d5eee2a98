"""What set-points may do: the limits that every controller with allocation shares."""

from __future__ import annotations

from dataclasses import dataclass

from softneck.core import SettingsError, require_between
from softneck.runtime import Port

from ._ports import MAX_MOTOR, MAX_SLEW, limit_ports


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerLimits:
    """What set-points may do; the runtime shares each limit among the motors.

    Attributes:
        position_limit: of each motor [rad].
        slew_limit: of each motor [rad/s]; the default is 0.25 rad in 20 ms.
        lead_limit: how far a set-point may be from its motor [rad].
        least_position: no motor is let out below this [rad], co-contraction is raised instead; tendons stay taut.
            -6 for no such rule.
        least_cocontraction: the co-contraction reference is at least this [rad of delta_i]; -6 for no such rule.
    """

    position_limit: float = MAX_MOTOR
    slew_limit: float = 12.5
    lead_limit: float = 0.8
    least_position: float = -MAX_MOTOR
    least_cocontraction: float = -MAX_MOTOR

    def __post_init__(self) -> None:
        require_between("position_limit", self.position_limit, 0.01, MAX_MOTOR, "rad")
        require_between("slew_limit", self.slew_limit, 0.01, MAX_SLEW, "rad/s")
        require_between("lead_limit", self.lead_limit, 0.01, 2.0 * MAX_MOTOR, "rad")
        require_taut(self.least_position, self.least_cocontraction, self.position_limit)

    def ports(self) -> tuple[Port, ...]:
        """Return them as parameters of a block."""
        return limit_ports(
            (self.position_limit, self.slew_limit, self.lead_limit, self.least_position, self.least_cocontraction)
        )

    def lines(self, sample_time: float) -> list[str]:
        """Return some lines for people."""
        return [
            f"  limits: |P| <= {self.position_limit:g} rad, slew {self.slew_limit:g} rad/s "
            f"({self.slew_limit * sample_time:g} rad per sample), lead {self.lead_limit:g} rad before the motors",
            *_taut_lines(self.least_position, self.least_cocontraction),
        ]


def require_taut(least_position: float, least_cocontraction: float, position_limit: float) -> None:
    """Raise SettingsError unless the rule for taut tendons leaves the motors room below their limit."""
    for name, value in (("least_position", least_position), ("least_cocontraction", least_cocontraction)):
        require_between(name, value, -MAX_MOTOR, MAX_MOTOR, "rad")
        if value >= position_limit:
            raise SettingsError(
                f"`{name}` must be below `position_limit`, {position_limit:g} rad, or no room to tilt is left; "
                f"got {value:g}."
            )


def _taut_lines(least_position: float, least_cocontraction: float) -> list[str]:
    """Return a line on the rule for taut tendons, none where there is no rule."""
    parts = []
    if least_position > -MAX_MOTOR:
        parts.append(f"no motor below {least_position:g} rad")
    if least_cocontraction > -MAX_MOTOR:
        parts.append(f"co-contraction at least {least_cocontraction:g} rad")
    return [f"  tendons kept taut: {', '.join(parts)}"] if parts else []
