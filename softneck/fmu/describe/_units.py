"""Units of an FMU's variables: what they are in SI base units, and in which people see them."""

from __future__ import annotations

import math

from softneck.core import to_si
from softneck.runtime import Port

# unit -> exponents of the SI base units and (usual display unit, factor to it).
_UNITS: dict[str, tuple[dict[str, str], tuple[str, float] | None]] = {
    "rad": ({"rad": "1"}, ("deg", 180.0 / math.pi)),
    "rad/s": ({"rad": "1", "s": "-1"}, ("deg/s", 180.0 / math.pi)),
    "s": ({"s": "1"}, None),
    "m": ({"m": "1"}, ("mm", 1e3)),
    "kg": ({"kg": "1"}, None),
    "N": ({"kg": "1", "m": "1", "s": "-2"}, None),
    "Pa": ({"kg": "1", "m": "-1", "s": "-2"}, None),
}


def base_exponents(unit: str) -> dict[str, str]:
    """Return the exponents of the SI base units; none of a unit that FMUs only name."""
    return _UNITS.get(unit, ({}, None))[0]


def display_unit(port: Port) -> tuple[str, float]:
    """Return the unit in which people see a port, and what its values are multiplied by for that."""
    if port.display_unit:
        return port.display_unit, 1.0 / to_si(port.display_unit)[0]
    return _UNITS.get(port.unit, ({}, None))[1] or (port.unit, 1.0)
