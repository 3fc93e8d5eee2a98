"""Array types, units, and argument checks whose errors name the argument, the rule with its unit, and the value."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._errors import DataError, SettingsError

#: An array of floats with one axis, as a type.
# `floating` and not `float64`: numpy's own stubs widen most expressions to it.
Vector = NDArray[np.floating[Any]]
#: An array of floats with two axes, as a type.
Matrix = NDArray[np.floating[Any]]


#: Called with the fraction done, 0 to 1, and a word for the current step.
Progress = Callable[[float, str], None]


def silent(done: float, what: str) -> None:
    """Ignore progress; the callback for calls without a progress bar."""
    del done, what


def require_finite(name: str, value: float, unit: str = "") -> None:
    """Raise SettingsError unless `value` is a finite number."""
    if not isinstance(value, int | float | np.number) or not math.isfinite(value):
        raise SettingsError(f"`{name}` must be a finite number{_in(unit)}; got {value}.")


def require_positive(name: str, value: float, unit: str = "") -> None:
    """Raise SettingsError unless `value` > 0 and finite."""
    require_finite(name, value, unit)
    if value <= 0:
        raise SettingsError(f"`{name}` must be positive{_in(unit)}; got {value}.")


def require_between(name: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise SettingsError unless `low` <= `value` <= `high`."""
    require_finite(name, value, unit)
    if not low <= value <= high:
        raise SettingsError(f"`{name}` must be between {low:g} and {high:g}{_in(unit)}; got {value:g}.")


def require_whole(name: str, value: object, low: int, high: int) -> None:
    """Raise SettingsError unless `value` is an integer between `low` and `high`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not low <= value <= high:
        raise SettingsError(f"`{name}` must be a whole number between {low} and {high}; got {value!r}.")


def require_one_of(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise SettingsError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise SettingsError(f"`{name}` must be one of {', '.join(allowed)}; got {value!r}.")


def finite_matrix(name: str, value: object, columns: int, *, missing: bool = False) -> Matrix:
    """Return `value` as a float matrix (time, `columns`); raise DataError if it has another shape or is not finite.

    A vector counts as one column. With `missing` an entry may be NaN.
    """
    array = _numbers(name, value)
    array = array[:, None] if array.ndim == 1 and columns == 1 else array
    if array.ndim != 2 or array.shape[1] != columns:
        raise DataError(f"`{name}` must have the shape (time, {columns}); got {array.shape}.")
    if not (np.isfinite(array) | (missing & np.isnan(array))).all():
        raise DataError(f"`{name}` must be finite; row {int(np.argmin(np.isfinite(array).all(axis=1)))} is not.")
    return array


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        if np.iscomplexobj(value):
            raise TypeError
        return np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"`{name}` must be an array of numbers; got a {type(value).__name__}.") from error


def finite_vector(name: str, value: ArrayLike, size: int) -> Vector:
    """Return `value` as a float vector of `size` entries; raise DataError if it is not, or not finite."""
    array = _numbers(name, value).ravel()
    if array.size != size:
        raise DataError(f"`{name}` must have {size} entries; got {array.size}.")
    if not np.isfinite(array).all():
        raise DataError(f"`{name}` must be finite; got {array.tolist()}.")
    return array


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""


# unit -> (factor to SI, SI unit). Angles are dimensionless in SI but kept apart as "rad".
_TO_SI: dict[str, tuple[float, str]] = {
    "rad": (1.0, "rad"),
    "deg": (math.pi / 180.0, "rad"),
    "mrad": (1e-3, "rad"),
    "turns": (2.0 * math.pi, "rad"),
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
    "mA": (1e-3, "A"),
    "mbar": (1e2, "Pa"),
    "hPa": (1e2, "Pa"),
    "us": (1e-6, "s"),
    "%": (1e-2, "1"),
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
