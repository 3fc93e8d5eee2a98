"""The table of units: their factors to SI, and how logs spell them."""

from __future__ import annotations

import re
from math import pi

from ._errors import DataError

# Unit -> factor to SI, SI unit, and other spellings in lower case without accents, in English, German and Romance
# languages. Angles are dimensionless in SI but kept apart as "rad".
_UNITS: dict[str, tuple[float, str, str]] = {
    "rad": (1.0, "rad", "radian radians radianes radiant"),
    "deg": (pi / 180.0, "rad", "° º degree degrees grad grado grados gradi graus degre degres"),
    "mrad": (1e-3, "rad", "milliradian milliradians"),
    "turns": (2.0 * pi, "rad", "turn rev revs revolution revolutions rotation rotations umdrehung umdrehungen"),
    "gon": (pi / 200.0, "rad", "gons gradian gradians"), "cdeg": (pi / 18_000.0, "rad", "centidegree centidegrees"),
    "mdeg": (pi / 180_000.0, "rad", "millidegree millidegrees"),
    "arcmin": (pi / 10_800.0, "rad", "arcminute arcminutes"),
    "arcsec": (pi / 648_000.0, "rad", "arcsecond arcseconds"), "rad/s": (1.0, "rad/s", "rad_s rads rad/seg"),
    "deg/s": (pi / 180.0, "rad/s", "°/s grad/s grados/s dps"), "rpm": (pi / 30.0, "rad/s", "u/min 1/min rev/min"),
    "s": (1.0, "s", "sec secs second seconds sek sekunde sekunden seg segundo segundos"),
    "ms": (1e-3, "s", "msec millis millisecond milliseconds millisekunden milisegundos"),
    "us": (1e-6, "s", "usec micros microsecond microseconds mikrosekunden microsegundos"),
    "ns": (1e-9, "s", "nsec nanosec nanos nanosecond nanoseconds"),
    "min": (60.0, "s", "mins minute minutes minuten minutos"), "h": (3600.0, "s", "hr hrs hour hours stunden horas"),
    "days": (86_400.0, "s", "d day tag tage dias"), "m": (1.0, "m", "meter meters metre metres"),
    "cm": (1e-2, "m", ""), "um": (1e-6, "m", ""), "in": (0.0254, "m", "inch inches"),
    "N": (1.0, "N", "newton"), "kgf": (9.80665, "N", ""), "lbf": (4.4482216152605, "N", ""), "Nm": (1.0, "Nm", ""),
    "Ncm": (1e-2, "Nm", ""), "Nmm": (1e-3, "Nm", ""), "kg": (1.0, "kg", ""),
    "g": (1e-3, "kg", ""), "Pa": (1.0, "Pa", "pascal"), "hPa": (1e2, "Pa", ""), "bar": (1e5, "Pa", ""),
    "psi": (6894.757293168361, "Pa", "psig"), "atm": (101_325.0, "Pa", ""), "mmHg": (133.322387415, "Pa", "torr"),
    "V": (1.0, "V", "volt volts"), "A": (1.0, "A", "amp amps ampere"), "W": (1.0, "W", "watt watts"),
    "Hz": (1.0, "Hz", ""), "J": (1.0, "J", "joule"), "Ohm": (1.0, "Ohm", "ohms"),
    "m/s2": (1.0, "m/s2", "m/s^2 m/s²"), "K": (1.0, "K", "kelvin"), "l": (1e-3, "m3", "litre litres liter liters"),
    "m3": (1.0, "m3", "m^3 m³"), "degC": (1.0, "degC", "°c celsius"), "T": (1.0, "T", "tesla"),
    "gauss": (1e-4, "T", ""), "%": (1e-2, "1", "pct percent prozent"), "1": (1.0, "1", ""),
}  # fmt: skip
# Prefix -> its factor and the units that logs have with it. `nm` may be Nm, and `mPa` is a slip for MPa.
_PREFIXED = {
    "u": (1e-6, "N Nm g V A W T l"), "m": (1e-3, "m N Nm g bar V A W J T l"), "k": (1e3, "m N Nm Pa V A W J Hz Ohm"),
    "M": (1e6, "Pa Hz Ohm"),
}  # fmt: skip
_UNITS |= {
    prefix + unit: (factor * _UNITS[unit][0], _UNITS[unit][1], "")
    for prefix, (factor, units) in _PREFIXED.items() for unit in units.split()
}  # fmt: skip
_SPELLED = {word: unit for unit, (_, _, others) in _UNITS.items() for word in (*others.split(), unit.lower())}
# `N m`, `mN·m`: how a product is written; and what a rate is over [s].
_PRODUCT = re.compile(r"(?<=[nN])\s*[ ·⋅∙•*.-]\s*(?=[cm]?m$)")
_PER = {"s": 1.0, "min": 60.0, "h": 3600.0}

#: SI unit -> its exponents of base units, by name; FMI and SSP count rad among them. degC has none.
SI_BASES: dict[str, dict[str, int]] = {
    "rad": {"rad": 1}, "rad/s": {"rad": 1, "s": -1}, "s": {"s": 1}, "m": {"m": 1}, "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2}, "kg": {"kg": 1}, "N": {"kg": 1, "m": 1, "s": -2}, "Nm": {"kg": 1, "m": 2, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2}, "A": {"A": 1}, "V": {"A": -1, "kg": 1, "m": 2, "s": -3},
    "J": {"kg": 1, "m": 2, "s": -2}, "Ohm": {"A": -2, "kg": 1, "m": 2, "s": -3}, "m3": {"m": 3},
    "W": {"kg": 1, "m": 2, "s": -3}, "T": {"A": -1, "kg": 1, "s": -2}, "Hz": {"s": -1}, "K": {"K": 1},
    "degC": {}, "1": {},
}  # fmt: skip

#: What a unit's spelling leaves open.
AMBIGUOUS = {
    "grad": "`grad` is deg in German and gon (400 of a turn) in English",
    "%": "percent of what? Other logs and the drives must mean the same 100 %",
    "nm": "`nm` is taken as newton metres and may be nanometres",
}


def to_si(unit: str) -> tuple[float, str]:
    """Return (factor, SI unit) such that SI value = factor * value; raise DataError for an unknown unit.

    `bar/s`, `l/min` and the like go by the unit above the stroke.
    """
    if unit in _UNITS:
        return _UNITS[unit][:2]
    above, _, per = str(unit).rpartition("/")
    if above not in _UNITS or per not in _PER:
        raise DataError(f"unknown unit `{unit}`; use one of {', '.join(_UNITS)}.")
    factor, si = _UNITS[above][:2]
    return factor / _PER[per], f"{si}/s"


def spelled_unit(text: str) -> str | None:
    """Return the unit that a log spells as `text`, such as "deg" of `°`; None if it is unknown."""
    text = _PRODUCT.sub("", text.replace("µ", "u").replace("μ", "u").replace("Ω", "Ohm").replace("Ω", "Ohm"))
    if text in _UNITS:
        return text  # capitals tell mPa from MPa
    word = text.lower()
    above, _, per = word.rpartition("/")
    return _SPELLED.get(word) or (f"{_SPELLED[above]}/{per}" if above in _SPELLED and per in _PER else None)
