"""Checks at the public edge: the argument, the rule with its unit, what came."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ._errors import DataError, SettingsError
from ._types import Vector


def require_finite(name: str, value: float, unit: str = "") -> None:
    """Raise SettingsError unless `value` is a finite number."""
    if not math.isfinite(value):
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


def finite_vector(name: str, value: ArrayLike, size: int) -> Vector:
    """Return `value` as a float vector of `size` entries; raise DataError if it is not, or not finite."""
    array = np.ascontiguousarray(value, dtype=np.float64).ravel()
    if array.size != size:
        raise DataError(f"`{name}` must have {size} entries; got {array.size}.")
    if not np.isfinite(array).all():
        raise DataError(f"`{name}` must be finite; got {array.tolist()}.")
    return array


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""
