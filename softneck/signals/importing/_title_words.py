"""The words of a column's title in English: those of German and Spanish loggers are translated, compounds are split."""

from __future__ import annotations

import re
import unicodedata

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
