"""What a model file's arrays must be before compiled code indexes them; each kind's own checks are in its room."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import KINDS, FileFormatError, Matrix, resolve
from softneck.runtime._bundle import declared
from softneck.runtime._layout import Arrays

from ._composed import COMPOSED, members, own_arrays, runtime_of

# A minute at 1 ms: far beyond any lag of a neck, far below what memory holds.
_LONGEST_HISTORY = 60_000


def check_arrays(kind: str, arrays: Mapping[str, Matrix]) -> None:
    """Raise FileFormatError unless the arrays are finite, in order, and of shapes that fit each other."""
    if kind in COMPOSED:
        _check_composed(kind, arrays)
        return
    # `rls` over the motors and more than one pole are state spaces as well.
    form = "subspace" if kind in ("rls", "oe", "srivc") and "A" in arrays else kind
    names = declared(runtime_of(kind, arrays), Arrays).names()
    if tuple(arrays) != names:
        raise FileFormatError(f"a model of kind {kind} has the arrays {', '.join(names)}; got {', '.join(arrays)}.")
    _check_numbers(form, arrays, runtime_of(kind, arrays))


def _check_composed(kind: str, arrays: Mapping[str, Matrix]) -> None:
    names = declared(KINDS[kind].runtime, Arrays).names()
    own, parts = own_arrays(arrays), members(arrays)
    if tuple(arrays)[: len(own)] != names:
        raise FileFormatError(f"a model of kind {kind} starts with the arrays {', '.join(names)}.")
    if len(parts) < 1 or (kind == "residual" and len(parts) != 1):
        raise FileFormatError(f"a model of kind {kind} cannot have {len(parts)} members.")
    _check_numbers(kind, own, KINDS[kind].runtime)
    for member, part in parts:
        check_arrays(member, part)


def _check_numbers(kind: str, arrays: Mapping[str, Matrix], runtime: str) -> None:
    """Check what the declaration of a kind says of its arrays, and what the kind's own check does."""
    for name, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise FileFormatError(f"its array `{name}` is not of finite floats.")
    for name, what in {"history": "its history in samples", "memory": "its memory in samples"}.items():
        if name in arrays:  # before its number is a length of others
            within(arrays[name], 1, _LONGEST_HISTORY, what)
    sizes = declared(runtime, Arrays).lengths(arrays)
    if "drive" in arrays:
        within(arrays["drive"][:, 1], 0, sizes["H"], "a drive's delay")
    if KINDS[kind].check:
        resolve(KINDS[kind].check)(arrays, sizes)


def check_table(table: Matrix, history: int) -> None:
    """Check rows (source, channel, lag)."""
    within(np.array([len(table)]), 1, np.inf, "the number of regressors")
    within(table[:, 0], 0, 3, "a regressor's source")
    within(table[:, 1], 0, 2, "a regressor's channel")
    within(table[table[:, 0] == 3, 1], 0, 1, "a regressor's output")
    within(table[:, 2], 1, history, "a regressor's lag")


def within(values: Matrix, low: float, high: float, what: str) -> None:
    if (values != np.round(values)).any() or not ((values >= low) & (values <= high)).all():
        raise FileFormatError(f"{what} is not a whole number from {low:g} to {high:g}.")
