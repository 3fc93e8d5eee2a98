"""The meaning of a column's title: the words that loggers use, a motor's number, and a unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace

from softneck.core import AMBIGUOUS, spelled_unit, to_si

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|°")
# Words without accents; those spelled as in English are not listed.
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
    "weg": "displacement", "hub": "stroke", "messung": "experiment", "zeile": "row", "nummer": "index", "nr": "index",
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
# Parts of German compounds, longest first, for words such as `Sollposition` and `Nickwinkelgeschwindigkeit`.
_PARTS = sorted((*_GERMAN, "position", "motor", "roll", "wert", "encoder"), key=len, reverse=True)
_LINK = {"wert": "", "s": ""}


def plain(text: str) -> str:
    """Return a text in lower case, without accents."""
    folded = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(c for c in folded if not unicodedata.combining(c)).lower()


def words_of(title: str) -> list[str]:
    """Return the words and numbers of a title in English and lower case."""
    found: list[str] = []
    for word in _WORD.findall(_latin(title.replace("µ", "u"))):
        found += _parts(word.lower())
    return found


def _latin(text: str) -> str:
    """Return a text without accents, and Greek letters by their names: `Δp` is `Delta p`."""
    folded = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    return "".join(_letter(c) for c in folded if not unicodedata.combining(c))


def _letter(c: str) -> str:
    greek = "" if c.isascii() else unicodedata.name(c, "")
    if not greek.startswith("GREEK") or "LETTER" not in greek:
        return c
    name = greek.split()[-1].lower()
    return f" {name.capitalize() if c.isupper() else name} "


def name_of(title: str) -> str:
    """Return what names a column in its title, without the unit and in Latin letters: `tip_mm` is `tip`."""
    text, written = _without_unit(title.strip())
    head, _, last = text.replace(" ", "_").rpartition("_")
    if not written and head and len(last) > 1 and spelled_unit(last) and last.lower() not in _WORDS_TOO:
        text = text[: len(head)]
    return re.sub(r"[\W_]+", "_", _latin(text), flags=re.ASCII).strip("_")


def _is_german(title: str) -> bool:
    words = [part for word in _WORD.findall(plain(title)) for part in _split(word)]
    return any(word in _GERMAN for word in words)


def _parts(word: str) -> list[str]:
    if word in _TRANSLATED:
        return [_TRANSLATED[word]]
    parts = _split(word)
    if len(parts) == 1:
        return parts  # `s` alone is a unit, no link
    return [english for part in parts if (english := _LINK.get(part, _TRANSLATED.get(part, part)))]


def _split(word: str) -> list[str]:
    """Return the parts of a compound, or the word itself."""
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


# Units that are words as well: only in brackets, and as the last word of no title.
_WORDS_TOO = {"in", "ma", "pa", "mn", "kn", "ka", "kv", "km", "ml", "ua", "un", "mt", "atm", "day", "tag"}
#: Of temperatures, known units or not.
TEMPERATURES = {"c", "degc", "°c", "degf", "°f", "f", "k"}
# What stands where a unit would, and is none: an encoder's counts, numbers without a unit.
_NO_UNITS = {"", "-", "1", "counts", "count", "ticks", "inc", "lsb", "raw", "a.u.", "au", "n/a"}
# `_V` and `_kPa` at the end of a title; in lower case some are words.
_CAPITAL = re.compile(r"[_ ]([mku]?[VAN]|[mk]?W|[mk]?Nm|Pa|kPa|hPa|MPa|mmHg|degC|°C?)$")
# `setpoint / rad`, as DIN 1313 writes units of axes.
_SLASH = re.compile(r"\s/\s*(\S+)\s*$")
# `F/N` and `t/s`, or a whole unit as in `speed mm/s`; with another slash it is a path, such as `/motor/m`.
_TIGHT_SLASH = re.compile(r"[^/]*?(([^/\s]+)/([^/\s]+))")
_ONE_LETTER = set("VANKsm°%")
# `Druck in bar`; `end in mind` names no unit.
_IN = re.compile(r"\s+in\s+(.+?)\s*$")
_BRACKET = re.compile(r"\s*[\[(]([^\])]*)[\])]\s*$")
# `position[0]` of ROS and `u(:,1)` of MATLAB are motor numbers, not units.
_INDEX = re.compile(r":?,?\s*\d+")

_TIME_WORDS = {
    "time", "t", "timestamp", "stamp", "ts", "seconds", "sec", "s", "ms", "millis", "milliseconds", "micros", "us",
    "ns", "clock", "elapsed", "datenum", "nanosec", "nsec", "segundos", "sekunden",
}  # fmt: skip
_RUN_WORDS = {"run", "trial", "experiment", "segment", "repetition"}
_COUNTER_WORDS = {"index", "idx", "sample", "samples", "row", "k", "n", "count", "counter", "unnamed", "id"}
_TARGET_WORDS = (
    "target", "setpoint", "setpoints", "set", "sp", "reference", "ref", "command", "commanded", "cmd", "desired", "des",
    "goal", "demand", "control", "input", "u", "cs",
)  # fmt: skip
_POSITION_WORDS = {"encoder", "enc", "position", "pos", "angle", "measured", "actual", "q"}
_VELOCITY_WORDS = {"velocity", "vel", "speed", "rpm", "omega", "dq", "rate"}
_MOTOR_WORDS = {"motor", "mot", "m", "winch", "tendon", "drive", "axis", "joint", "servo", "actuator", "p"}
_ANGLES = {"pitch": "pitch", "roll": "roll", "yaw": "yaw", "inclination": "inclination", "incl": "inclination",
           "tilt": "inclination", "orientation": "orientation", "orient": "orientation",
           "azimuth": "orientation"}  # fmt: skip
#: Why a column with an empty title, as pandas writes its index, is ignored; its numbers confirm it.
COUNTS_ROWS = "it counts the rows"
_EULER = {"pitch", "roll", "yaw"}
_SENSED_WORDS = {"sensor", "measured", "imu", "actual", "meas"}
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
    """The meaning of a title.

    `role`: time, run, set-point, position, velocity, pitch, ..., ignored, or unknown. `family`: words without number
    and unit; columns of the motors share it. `unit`: as softneck writes it, None without one that is known, and
    `written`: as the title does. `rank`: clarity of the reason; smaller is clearer.
    """

    role: str
    family: str
    motor: int | None
    unit: str | None
    why: str
    rank: int = 0
    written: str = ""

    @property
    def quantity(self) -> str:
        """The unit's SI unit, "" without a unit that is known."""
        return "" if self.unit is None else to_si(self.unit)[1]


def read_title(title: str) -> Title:
    """Return the meaning of a column's title."""
    text, written = _without_unit(title.strip())
    words = words_of(text)
    numbers = [int(word) for word in words if word.isdigit() and len(word) < 4]
    names = [word for word in words if not word.isdigit()]
    if not written and len(names) > 1 and len(names[-1]) > 1 and spelled_unit(names[-1]):
        written = "" if names[-1] in _WORDS_TOO else names.pop()
    motor = numbers[-1] if numbers else None
    role, why, rank = _role(names, motor)
    unit = spelled_unit(written) or spelled_unit(plain(written))
    if role == "time" and not written and (last := spelled_unit(names[-1])) and to_si(last)[1] == "s":
        unit = last
    found = Title(role, " ".join(names), motor, unit, why, rank, written)
    other = plain(written) in TEMPERATURES or found.quantity not in ("", "rad", "rad/s")
    if other and role not in ("time", "run", "ignored", "velocity"):
        return replace(found, role="ignored", why=f"{written} is no unit of an angle")
    return found


def ambiguity(title: Title, titles: Iterable[str | int]) -> str:
    """Return what the unit of a title leaves open beside the other `titles` of its log; "" where nothing."""
    if title.written == title.unit != "%" or (title.unit == "deg" and any(map(_is_german, map(str, titles)))):
        return ""
    return AMBIGUOUS.get(title.written.lower().removesuffix("/s")) or AMBIGUOUS.get(title.unit or "", "")


def _without_unit(title: str) -> tuple[str, str]:
    """Return a title without its unit, and the unit as it is written."""
    said = _IN.search(title)
    last = said if said is not None and spelled_unit(said[1]) else _CAPITAL.search(title)
    match = _BRACKET.search(title) or _SLASH.search(title) or last
    if (tight := _TIGHT_SLASH.fullmatch(title)) is not None:
        if tight.start(1) and spelled_unit(tight[1]):
            return title[: tight.start(1)], tight[1]
        if tight[3] in _ONE_LETTER or (len(tight[3]) > 1 and spelled_unit(tight[3])):
            return title[: tight.start(3) - 1], tight[3]
    if match is None or _INDEX.fullmatch(match[1].strip()):
        return title, ""
    text = match[1].strip()
    return title[: match.start()], "" if text in _NO_UNITS else text


def _role(words: list[str], motor: int | None) -> tuple[str, str, int]:
    """Return (role, why, rank) of a title's words."""
    known = set(words)
    for names, why in _NOT_SENSED:
        if known & names:
            return "ignored", f"'{' '.join(sorted(known & names))}' is {why}", 0
    if words[:1] == ["unnamed"]:
        return "ignored", COUNTS_ROWS, 0
    # The title `tilt.pitch` of a topic means pitch.
    angle = next((word for word in (*(known & _EULER), *words) if word in _ANGLES), None)
    target = next((word for word in _TARGET_WORDS if word in known), None)
    speed = known & _VELOCITY_WORDS
    if angle is not None:
        return _angle_role(_ANGLES[angle], known, target, bool(speed))
    if motor is not None:
        if target is not None and speed:
            return "ignored", "it is a command of speed; set-points are positions", 0
        if target is not None:
            return "set-point", f"'{target}' names a set-point of a motor", _TARGET_WORDS.index(target)
        if speed:
            return "velocity", f"'{min(speed)}' names a speed", 0
        clues = [word for word in words if word in _POSITION_WORDS] or [word for word in words if word in _MOTOR_WORDS]
        if clues:
            return "position", f"'{clues[0]}' names a position of a motor", 0 if clues[0] in _POSITION_WORDS else 1
    elif known & _RUN_WORDS:
        return "run", "it numbers the experiments", 0
    elif known & _TIME_WORDS:
        return "time", f"'{next(word for word in words if word in _TIME_WORDS)}' names time", len(words)
    elif known & _COUNTER_WORDS:
        return "ignored", "its name looks like a row counter", 0
    return "unknown", "it is not recognised from its name", 0


def _angle_role(angle: str, known: set[str], target: str | None, speed: bool) -> tuple[str, str, int]:
    if target is not None:
        if angle in ("pitch", "roll"):
            return f"{angle}_reference", f"'{target}' names a set-point of the platform", 0
        return "ignored", f"'{target}' is a target of the platform, not a measurement", 0
    if speed:
        if angle in ("pitch", "roll"):
            return f"{angle}_rate", f"it names the rate of {angle}", 0
        return "ignored", f"the rate of {angle} is not a channel of a recording", 0
    return angle, f"it names the platform's {angle}", 0 if known & _SENSED_WORDS else 1
