"""What a column's title says: the words loggers use, a motor's number, and a unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

_UNITS = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radians": "rad", "s": "s", "sec": "s",
    "seconds": "s", "ms": "ms", "millis": "ms", "milliseconds": "ms", "us": "us", "µs": "us", "micros": "us",
    "ns": "ns", "rad/s": "rad/s", "rad_s": "rad/s", "rads": "rad/s", "deg/s": "deg/s", "°/s": "deg/s", "rpm": "rpm",
    "mm": "mm", "m": "m",
}  # fmt: skip
_BRACKET = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|°")

_TIME = {"time", "t", "timestamp", "stamp", "ts", "seconds", "sec", "s", "ms", "millis", "milliseconds", "micros", "us",
         "ns", "clock", "elapsed"}  # fmt: skip
_RUN = {"run", "trial", "experiment", "segment", "repetition"}
_COUNTER = {"index", "idx", "sample", "samples", "row", "k", "n", "count", "counter", "unnamed", "id"}
_TARGET = ("target", "setpoint", "setpoints", "set", "sp", "reference", "ref", "command", "commanded", "cmd", "desired",
           "des", "goal", "demand", "control", "input", "u", "cs")  # fmt: skip
_POSITION = {"encoder", "enc", "position", "pos", "angle", "measured", "actual", "q"}
_VELOCITY = {"velocity", "vel", "speed", "rpm", "omega", "dq", "rate"}
_MOTOR = {"motor", "mot", "m", "winch", "tendon", "drive", "axis", "joint", "servo", "actuator", "p"}
_ANGLES = {"pitch": "pitch", "roll": "roll", "yaw": "yaw", "inclination": "inclination", "incl": "inclination",
           "tilt": "inclination", "orientation": "orientation", "orient": "orientation",
           "azimuth": "orientation"}  # fmt: skip
_SENSED = {"sensor", "measured", "imu", "actual", "meas"}
_NOT_SENSED = (
    ({"error", "err", "ep", "ev", "deviation", "residual"}, "an error of a control loop, not a measurement"),
    ({"kinematics", "kinematic", "model", "simulated", "sim", "computed", "estimated"},
     "computed by a model, not measured"),
    ({"current", "curr", "torque", "voltage", "volt", "temperature", "temp", "pwm", "duty", "tcs", "status"},
     "a quantity of the drives that a recording does not hold"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Title:
    """A title's meaning.

    Attributes:
        role: time, run, set-point, position, velocity, pitch, ..., ignored, or unknown.
        family: its words without number and unit; motors' columns of one kind share it.
        motor: the number in it, or None.
        unit: in it, or None.
        why: it was taken so.
        rank: of the clue; smaller is clearer.
    """

    role: str
    family: str
    motor: int | None
    unit: str | None
    why: str
    rank: int = 0


def read_title(title: str) -> Title:
    """Return what a column's title says."""
    text, unit = _without_unit(title.strip())
    words = [word.lower() for word in _WORD.findall(text)]
    numbers = [int(word) for word in words if word.isdigit() and len(word) < 4]
    plain = [word for word in words if not word.isdigit()]
    if unit is None and len(plain) > 1 and plain[-1] in _UNITS and len(plain[-1]) > 1:
        unit = _UNITS[plain.pop()]
    motor = numbers[-1] if numbers else None
    role, why, rank = _role(plain, motor)
    if role == "time" and unit is None and plain[-1] in _UNITS and plain[-1] != "m":
        unit = _UNITS[plain[-1]]
    return Title(role, " ".join(plain), motor, unit, why, rank)


def _without_unit(title: str) -> tuple[str, str | None]:
    match = _BRACKET.search(title)
    if match is None:
        return title, None
    return title[: match.start()], _UNITS.get(match[1].strip().lower())


def _role(words: list[str], motor: int | None) -> tuple[str, str, int]:
    """Return (role, why, rank) of a title's words."""
    known = set(words)
    for said, why in _NOT_SENSED:
        if known & said:
            return "ignored", f"'{' '.join(sorted(known & said))}' is {why}", 0
    if words[:1] == ["unnamed"]:
        return "ignored", "it counts the rows", 0
    angle = next((word for word in words if word in _ANGLES), None)
    target = next((word for word in _TARGET if word in known), None)
    speed = known & _VELOCITY
    if angle is not None:
        return _angle_role(_ANGLES[angle], known, target, bool(speed))
    if motor is not None:
        if target is not None and speed:
            return "ignored", "it is a command of speed; set-points are positions", 0
        if target is not None:
            return "set-point", f"'{target}' names what is asked of a motor", _TARGET.index(target)
        if speed:
            return "velocity", f"'{min(speed)}' names a speed", 0
        clues = [word for word in words if word in _POSITION] or [word for word in words if word in _MOTOR]
        if clues:
            return "position", f"'{clues[0]}' names where a motor is", 0 if clues[0] in _POSITION else 1
    elif known & _RUN:
        return "run", "it numbers the experiments", 0
    elif known & _TIME:
        return "time", f"'{next(word for word in words if word in _TIME)}' names time", len(words)
    elif known & _COUNTER:
        return "ignored", "it counts the rows", 0
    return "unknown", "softneck does not recognise its name", 0


def _angle_role(angle: str, known: set[str], target: str | None, speed: bool) -> tuple[str, str, int]:
    if target is not None:
        if angle in ("pitch", "roll"):
            return f"{angle}_reference", f"'{target}' names what is asked of the platform", 0
        return "ignored", f"'{target}' is a target of the platform, not a measurement", 0
    if speed:
        if angle in ("pitch", "roll"):
            return f"{angle}_rate", f"it names the rate of {angle}", 0
        return "ignored", f"the rate of {angle} is not a channel of a recording", 0
    return angle, f"it names the platform's {angle}", 0 if known & _SENSED else 1
