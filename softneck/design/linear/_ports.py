"""The ports that all controllers share."""

from __future__ import annotations

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
