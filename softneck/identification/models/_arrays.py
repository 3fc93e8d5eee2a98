"""What a model file's arrays must be before compiled code indexes them; each kind's own checks are in its room."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import KINDS, FileFormatError, Matrix, resolve

from ._composed import COMPOSED, members, own_arrays

# A minute at 1 ms: far beyond any lag of a neck, far below what memory holds.
_LONGEST_HISTORY = 60_000


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """The arrays of a kind.

    Attributes:
        names: in the order that its runtime reads.
        check: raises FileFormatError unless shapes and values fit each other; takes the arrays and the history.
    """

    names: tuple[str, ...]
    check: Callable[[Mapping[str, Matrix], float], None]


def layout_of(kind: str) -> ArrayLayout:
    """Return the layout that the table of kinds names."""
    return resolve(KINDS[kind].arrays)


def check_arrays(kind: str, arrays: Mapping[str, Matrix]) -> None:
    """Raise FileFormatError unless the arrays are finite, in order, and of shapes that fit each other."""
    if kind in COMPOSED:
        _check_composed(kind, arrays)
        return
    # `rls` over the motors and more than one pole are state spaces as well.
    form = "subspace" if kind in ("rls", "oe", "srivc") and "A" in arrays else kind
    layout = layout_of(form)
    if tuple(arrays) != layout.names:
        raise FileFormatError(
            f"a model of kind {kind} has the arrays {', '.join(layout.names)}; got {', '.join(arrays)}."
        )
    check_finite(arrays)
    history = check_history(arrays)
    expect(arrays, "drive", (3, 2))
    within(arrays["drive"][:, 1], 0, history, "a drive's delay")
    layout.check(arrays, history)


def _check_composed(kind: str, arrays: Mapping[str, Matrix]) -> None:
    layout = layout_of(kind)
    own, parts = own_arrays(arrays), members(arrays)
    if tuple(arrays)[: len(own)] != layout.names:
        raise FileFormatError(f"a model of kind {kind} starts with the arrays {', '.join(layout.names)}.")
    if len(parts) < 1 or (kind == "residual" and len(parts) != 1):
        raise FileFormatError(f"a model of kind {kind} cannot have {len(parts)} members.")
    check_finite(own)
    history = check_history(own)
    layout.check(own, history)
    for member, part in parts:
        check_arrays(member, part)


def check_finite(arrays: Mapping[str, Matrix]) -> None:
    for name, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise FileFormatError(f"its array `{name}` is not of finite floats.")


def check_history(arrays: Mapping[str, Matrix]) -> float:
    """Check history and memory, and return the history."""
    expect(arrays, "history", (1,))
    history = float(arrays["history"][0])
    if history != int(history) or not 1 <= history <= _LONGEST_HISTORY:
        raise FileFormatError(f"its history of {history:g} samples is not a number from 1 to {_LONGEST_HISTORY}.")
    if "memory" in arrays:
        expect(arrays, "memory", (1,))
        within(arrays["memory"], 1, _LONGEST_HISTORY, "its memory in samples")
    return history


def check_table(table: Matrix, history: float) -> int:
    """Check rows (source, channel, lag) and return their number."""
    if table.ndim != 2 or table.shape[1] != 3 or not len(table):
        raise FileFormatError(f"its regressor table has shape {table.shape}; (n, 3) is needed.")
    within(table[:, 0], 0, 3, "a regressor's source")
    within(table[:, 1], 0, 2, "a regressor's channel")
    within(table[table[:, 0] == 3, 1], 0, 1, "a regressor's output")
    within(table[:, 2], 1, history, "a regressor's lag")
    return len(table)


def expect(arrays: Mapping[str, Matrix], name: str, shape: tuple[int, ...]) -> None:
    if arrays[name].shape != shape:
        raise FileFormatError(f"its array `{name}` has shape {arrays[name].shape}; {shape} is needed.")


def within(values: Matrix, low: float, high: float, what: str) -> None:
    if (values != np.round(values)).any() or not ((values >= low) & (values <= high)).all():
        raise FileFormatError(f"{what} is not a whole number from {low:g} to {high:g}.")
