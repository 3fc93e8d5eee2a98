"""One drive: maxon RE16, gear, winch and the cascaded position loop of the drive amplifier.

The electrical time constant L / R is 36 us and the current loop faster than 1 kHz, so the current is
what the speed controller asks for, within the current limit and what the supply leaves over the back-EMF.
"""


def drive_rates(
    x: tuple[float, float, float],
    command: float,
    pull: float,
    turning: float,
    c: tuple[float, float, float, float, float, float, float, float, float, float],
) -> tuple[float, float]:
    """Return (acceleration of the winch, rate of the speed controller's integral).

    `x` is (position [rad], speed [rad/s], integral [N m]) at the winch, `command` the position [rad],
    `pull` the torque of the tendon on the winch [N m], `turning` tanh(speed / friction speed). `c` is (position
    gain, speed limit, speed bandwidth, 1 / integral time, torque limit, supply torque, back-EMF torque per speed,
    inertia, friction torque, friction speed).
    """
    position, speed, integral = x
    gain, speed_limit, bandwidth, reset, torque_limit, supply, back_emf, inertia, friction, _ = c
    wanted = min(max(gain * (command - position), -speed_limit), speed_limit)  # P controller of position
    # By the inertia, so that `bandwidth` is that of the closed speed loop.
    error = inertia * bandwidth * (wanted - speed)
    asked = error + integral
    # What the supply leaves over the back-EMF; turned backwards the winch has more.
    high = min(torque_limit, supply - back_emf * speed)
    low = max(-torque_limit, -supply - back_emf * speed)
    torque = min(max(asked, low), high)
    # Anti-windup: the integral waits while the current is limited and would be driven further out.
    waits = (asked > high and error > 0.0) or (asked < low and error < 0.0)
    growth = 0.0 if waits else reset * error
    drag = friction * turning
    return (torque - pull - drag) / inertia, growth  # a tendon that pulls turns the winch back, towards negative
