"""The ports that all controllers share, and what set-points may do: limits, and tendons that stay taut."""

from __future__ import annotations

from dataclasses import dataclass

from softneck.core import SettingsError, require_between
from softneck.runtime import Port

# The neck's inclination stays below 0.7 rad; motors within 6 rad (paper, section 5).
MAX_REFERENCE = 0.8
MAX_MOTOR = 6.0
MAX_SLEW = 1000.0


def limit_ports(starts: tuple[float, float, float, float, float]) -> tuple[Port, ...]:
    """Return the parameters of every controller with allocation, in the order of `_allocation_runtime`'s callers.

    Args:
        starts: position limit [rad], slew limit [rad/s], lead limit, least position, least co-contraction [rad].
    """
    position, slew, lead, least, common = starts
    return (
        Port(name="position_limit", unit="rad", start=position, minimum=0.01, maximum=MAX_MOTOR),
        Port(name="slew_limit", unit="rad/s", start=slew, minimum=0.01, maximum=MAX_SLEW),
        Port(name="lead_limit", unit="rad", start=lead, minimum=0.01, maximum=2.0 * MAX_MOTOR),
        Port(name="least_position", unit="rad", start=least, minimum=-MAX_MOTOR, maximum=MAX_MOTOR,
             description="no motor below this, co-contraction is raised instead"),
        Port(name="least_cocontraction", unit="rad", start=common, minimum=-MAX_MOTOR, maximum=MAX_MOTOR,
             description="lower bound of the co-contraction reference"),
    )  # fmt: skip


def controller_outputs() -> tuple[Port, ...]:
    """Return the outputs: three set-points."""
    return tuple(_motor(f"motor_setpoint_{j}", "set-point of motor") for j in (1, 2, 3))


def controller_inputs() -> tuple[Port, ...]:
    """Return the inputs: references, angles, motors and flags."""
    references = tuple(
        Port(name=f"{axis}_reference", unit="rad", minimum=-MAX_REFERENCE, maximum=MAX_REFERENCE,
             description=f"wanted {axis}") for axis in ("pitch", "roll")
    )  # fmt: skip
    cocontraction = Port(
        name="cocontraction_reference", unit="rad", minimum=-MAX_MOTOR, maximum=MAX_MOTOR,
        description="wanted delta_i (Eq. 11)",
    )  # fmt: skip
    angles = tuple(Port(name=axis, unit="rad", description=f"{axis} of the neck") for axis in ("pitch", "roll"))
    motors = tuple(_motor(f"motor_position_{j}", "measured position of motor") for j in (1, 2, 3))
    flags = (
        Port(name="healthy", description="the angles can be trusted", start=1.0, boolean=True),
        Port(name="enabled", description="may move the motors", start=1.0, boolean=True),
    )
    return (*references, cocontraction, *angles, *motors, *flags)


def _motor(name: str, what: str) -> Port:
    return Port(name=name, unit="rad", description=f"{what} {name[-1]}", minimum=-MAX_MOTOR, maximum=MAX_MOTOR)


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
