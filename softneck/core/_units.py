"""Units that files may carry, and their factors to SI."""

from __future__ import annotations

import math

from ._errors import DataError

# unit -> (factor to SI, SI unit). Angles are dimensionless in SI but kept apart as "rad".
_TO_SI: dict[str, tuple[float, str]] = {
    "rad": (1.0, "rad"),
    "deg": (math.pi / 180.0, "rad"),
    "rad/s": (1.0, "rad/s"),
    "deg/s": (math.pi / 180.0, "rad/s"),
    "rpm": (math.pi / 30.0, "rad/s"),
    "s": (1.0, "s"),
    "ms": (1e-3, "s"),
    "m": (1.0, "m"),
    "cm": (1e-2, "m"),
    "mm": (1e-3, "m"),
    "N": (1.0, "N"),
    "kg": (1.0, "kg"),
    "g": (1e-3, "kg"),
    "Pa": (1.0, "Pa"),
    "kPa": (1e3, "Pa"),
    "bar": (1e5, "Pa"),
    "MPa": (1e6, "Pa"),
    "psi": (6894.757293168361, "Pa"),
    "V": (1.0, "V"),
    "mV": (1e-3, "V"),
    "A": (1.0, "A"),
    "1": (1.0, "1"),
}


#: SI unit -> its exponents of base units, by name; FMI and SSP count rad among them.
SI_BASES: dict[str, dict[str, int]] = {
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "s": {"s": 1},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "kg": {"kg": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "A": {"A": 1},
    "V": {"A": -1, "kg": 1, "m": 2, "s": -3},
    "1": {},
}


def to_si(unit: str) -> tuple[float, str]:
    """Return (factor, SI unit) such that SI value = factor * value; raise DataError for an unknown unit.

    `bar/s` and the like go by the unit above the stroke.
    """
    try:
        if unit not in _TO_SI and str(unit).endswith("/s"):
            factor, unit_si = _TO_SI[unit.removesuffix("/s")]
            return factor, f"{unit_si}/s"
        return _TO_SI[unit]
    except KeyError:
        known = ", ".join(_TO_SI)
        raise DataError(f"unknown unit `{unit}`; use one of {known}.") from None
