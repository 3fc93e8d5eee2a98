"""Array types, and argument checks whose errors name the argument, the rule with its unit, and the value."""

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
