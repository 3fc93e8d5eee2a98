"""What a column's title says: the words loggers use, a motor's number, and a unit."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|°")
# Without accents; what a language writes like English needs no line.
_GERMAN = {
    "zeit": "time", "zeitstempel": "timestamp", "uhrzeit": "time", "datum": "time", "soll": "setpoint",
    "sollwert": "setpoint", "vorgabe": "setpoint", "stellgrosse": "setpoint", "fuhrungsgrosse": "setpoint",
    "ist": "actual", "istwert": "actual", "gemessen": "measured", "messwert": "measured", "antrieb": "drive",
    "seil": "tendon", "sehne": "tendon", "winde": "winch", "geber": "encoder", "drehgeber": "encoder",
    "lage": "position", "stellung": "position", "winkel": "angle", "drehwinkel": "angle",
    "geschwindigkeit": "velocity", "drehzahl": "velocity", "nick": "pitch", "wank": "roll", "gier": "yaw",
    "neigung": "inclination", "richtung": "orientation", "strom": "current", "spannung": "voltage",
    "drehmoment": "torque", "moment": "torque", "kraft": "force", "temperatur": "temperature", "fehler": "error",
    "abweichung": "deviation", "regelabweichung": "deviation", "modell": "model", "versuch": "trial", "lauf": "run",
    "messung": "experiment", "zeile": "row", "nummer": "index", "nr": "index",
}  # fmt: skip
_SPANISH = {
    "tiempo": "time", "fecha": "time", "hora": "time", "consigna": "setpoint", "referencia": "reference",
    "objetivo": "target", "deseado": "desired", "deseada": "desired", "mando": "command", "medido": "measured",
    "medida": "measured", "real": "actual", "codificador": "encoder", "cabrestante": "winch", "cable": "tendon",
    "posicion": "position", "angulo": "angle", "velocidad": "velocity", "cabeceo": "pitch", "alabeo": "roll",
    "balanceo": "roll", "guinada": "yaw", "inclinacion": "inclination", "orientacion": "orientation",
    "corriente": "current", "voltaje": "voltage", "par": "torque", "fuerza": "force", "temperatura": "temperature",
    "modelo": "model", "ensayo": "trial", "prueba": "trial", "experimento": "experiment", "muestra": "sample",
    "fila": "row", "indice": "index",
}  # fmt: skip
_PLURALS = {
    "motors": "motor", "positions": "position", "velocities": "velocity", "encoders": "encoder", "tendons": "tendon",
    "winches": "winch", "drives": "drive", "joints": "joint", "servos": "servo", "actuators": "actuator",
    "commands": "command", "targets": "target", "motores": "motor", "posiciones": "position", "motoren": "motor",
}  # fmt: skip
_TRANSLATED = _GERMAN | _SPANISH | _PLURALS
# Parts of German compounds, the longest first; `Sollposition` and `Nickwinkelgeschwindigkeit` are of such.
_PARTS = sorted((*_GERMAN, "position", "motor", "roll", "wert", "encoder"), key=len, reverse=True)
_LINK = {"wert": "", "s": ""}


def plain(text: str) -> str:
    """Return a text in lower case without accents."""
    folded = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(c for c in folded if not unicodedata.combining(c)).lower()


def words_of(title: str) -> list[str]:
    """Return the words and numbers of a title in English and in lower case."""
    found: list[str] = []
    folded = unicodedata.normalize("NFKD", title.replace("ß", "ss").replace("µ", "u"))
    for word in _WORD.findall("".join(c for c in folded if not unicodedata.combining(c))):
        found += _parts(word.lower())
    return found


def is_german(title: str) -> bool:
    """Return whether a title holds a German word, in which `Grad` are degrees."""
    words = [part for word in _WORD.findall(plain(title)) for part in _split(word)]
    return any(word in _GERMAN for word in words)


def _parts(word: str) -> list[str]:
    if word in _TRANSLATED:
        return [_TRANSLATED[word]]
    return [english for part in _split(word) if (english := _LINK.get(part, _TRANSLATED.get(part, part)))]


def _split(word: str) -> list[str]:
    """Return the parts of a compound; the word itself where it is none."""
    rest, parts = word, []
    while rest:
        part = next((one for one in _PARTS if rest.startswith(one)), None)
        if part is None and parts and rest.startswith("s"):
            part = "s"
        if part is None:
            return [word]
        parts.append(part)
        rest = rest[len(part) :]
    return parts


_UNITS = {
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radians": "rad", "s": "s", "sec": "s",
    "seconds": "s", "ms": "ms", "millis": "ms", "milliseconds": "ms", "us": "us", "µs": "us", "micros": "us",
    "ns": "ns", "rad/s": "rad/s", "rad_s": "rad/s", "rads": "rad/s", "deg/s": "deg/s", "°/s": "deg/s", "rpm": "rpm",
    "mm": "mm", "m": "m", "grad": "deg", "grados": "deg", "grado": "deg", "grad/s": "deg/s", "grados/s": "deg/s",
    "radianes": "rad", "radiant": "rad", "rad/seg": "rad/s", "u/min": "rpm", "1/min": "rpm", "sek": "s",
    "sekunden": "s", "seg": "s", "segundos": "s", "millisekunden": "ms", "milisegundos": "ms", "mikrosekunden": "us",
    "microsegundos": "us", "nsec": "ns", "nanosec": "ns",
}  # fmt: skip
_BRACKET = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
# `position[0]` of ROS and `u(:,1)` of MATLAB are numbers of a motor and not units.
_INDEX = re.compile(r":?,?\s*\d+")

_TIME = {"time", "t", "timestamp", "stamp", "ts", "seconds", "sec", "s", "ms", "millis", "milliseconds", "micros", "us",
         "ns", "clock", "elapsed", "nanosec", "nsec", "segundos", "sekunden"}  # fmt: skip
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
#: Of a column whose title is empty, as pandas writes its index; its numbers say whether it does.
COUNTS_ROWS = "it counts the rows"
_EULER = {"pitch", "roll", "yaw"}
_SENSED = {"sensor", "measured", "imu", "actual", "meas"}
_NOT_SENSED = (
    ({"error", "err", "ep", "ev", "deviation", "residual"}, "an error of a control loop, not a measurement"),
    ({"kinematics", "kinematic", "model", "simulated", "sim", "computed", "estimated"},
     "computed by a model, not measured"),
    ({"current", "curr", "torque", "voltage", "volt", "temperature", "temp", "pwm", "duty", "tcs", "status",
      "force", "effort"},
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
    words = words_of(text)
    numbers = [int(word) for word in words if word.isdigit() and len(word) < 4]
    said = [word for word in words if not word.isdigit()]
    if unit is None and len(said) > 1 and said[-1] in _UNITS and len(said[-1]) > 1:
        unit = _UNITS[said.pop()]
    motor = numbers[-1] if numbers else None
    role, why, rank = _role(said, motor)
    if role == "time" and unit is None and said and said[-1] in _UNITS and said[-1] != "m":
        unit = _UNITS[said[-1]]
    return Title(role, " ".join(said), motor, unit, why, rank)


def _without_unit(title: str) -> tuple[str, str | None]:
    match = _BRACKET.search(title)
    if match is None or _INDEX.fullmatch(match[1].strip()):
        return title, None
    return title[: match.start()], _UNITS.get(plain(match[1].strip()), _UNITS.get(match[1].strip().lower()))


def _role(words: list[str], motor: int | None) -> tuple[str, str, int]:
    """Return (role, why, rank) of a title's words."""
    known = set(words)
    for said, why in _NOT_SENSED:
        if known & said:
            return "ignored", f"'{' '.join(sorted(known & said))}' is {why}", 0
    if words[:1] == ["unnamed"]:
        return "ignored", COUNTS_ROWS, 0
    # `tilt.pitch` of a topic is pitch.
    angle = next((word for word in (*(known & _EULER), *words) if word in _ANGLES), None)
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
        return "ignored", "it counts the rows by its name", 0
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
