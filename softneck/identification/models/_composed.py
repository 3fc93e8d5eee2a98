"""Models that hold others: their arrays, their runtime, and their start.

The arrays of member 0 of kind `play` are named `0.play.history` and so on, behind the model's own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import KINDS, FileFormatError, Matrix, SettingsError, Vector
from softneck.runtime import load_runtime
from softneck.runtime._bundle import declared
from softneck.runtime._layout import Arrays, StateVector

from ._linear_systems import AFFINE, STATE_SPACE

COMPOSED = ("residual", "ensemble")


def prefixed_arrays(members: list[tuple[str, Mapping[str, Matrix]]]) -> dict[str, Matrix]:
    """Return the arrays of all members (kind, arrays) under their names in a composed model."""
    for kind, _ in members:
        if kind in COMPOSED:
            raise SettingsError(f"a model of kind `{kind}` holds others itself and cannot be held; take its members.")
    return {f"{i}.{kind}.{name}": array for i, (kind, arrays) in enumerate(members) for name, array in arrays.items()}


def own_arrays(arrays: Mapping[str, Matrix]) -> dict[str, Matrix]:
    """Return the arrays that are no member's."""
    return {name: array for name, array in arrays.items() if "." not in name}


def members(arrays: Mapping[str, Matrix]) -> list[tuple[str, dict[str, Matrix]]]:
    """Return kind and arrays of each member, in order.

    Raises:
        FileFormatError: members out of order, or of a kind that cannot be held.
    """
    found: list[tuple[str, dict[str, Matrix]]] = []
    for name, array in arrays.items():
        if "." not in name:
            continue
        number, kind, own = name.split(".", 2)
        if number == str(len(found)) and kind in KINDS and KINDS[kind].role == "model" and kind not in COMPOSED:
            found.append((kind, {}))
        if not found or (number, kind) != (str(len(found) - 1), found[-1][0]):
            raise FileFormatError(
                f"its array `{name}` belongs to no member in order, or to a kind that cannot be held."
            )
        found[-1][1][own] = array
    return found


def runtime_of(kind: str, arrays: Mapping[str, Matrix]) -> str:
    """Return the name of the runtime, with those of the members (see `softneck.runtime.bundle`)."""
    if kind not in COMPOSED:
        if "A" in arrays and kind != "nss":
            return AFFINE if "offset" in arrays else STATE_SPACE
        return KINDS[kind].runtime
    inner = ",".join(f"{runtime_of(member, part)}:{len(part)}" for member, part in members(arrays))
    return f"{KINDS[kind].runtime}({inner})"


def memory_of(arrays: Mapping[str, Matrix]) -> int:
    """Return the samples after which a held input and output have filled all that a model remembers."""
    longest = max(float(arrays["history"][0]), float(arrays.get("memory", np.zeros(1))[0]))
    return int(max([longest, *(memory_of(part) for _, part in members(arrays))]))


def set_now(kind: str, arrays: Mapping[str, Matrix], values: Vector, m: Vector, y: Vector) -> None:
    """Write motors `m` (3,) and outputs `y` (2,) of now into a state, which a `step` has moved on."""
    runtime = runtime_of(kind, arrays).partition("(")[0]
    named = declared(runtime, Arrays)(list(arrays.values()))
    parts = declared(runtime, StateVector).parts(named)
    if "added" in parts and kind in COMPOSED:
        # The base stands where the neck does less what the set adds.
        y = y - values[parts["added"]]
    if "motors" in parts:
        values[parts["motors"]], values[parts["angles"]] = m, y
    at = parts[list(parts)[-1]].start
    for member, part in members(arrays):
        size = load_runtime(runtime_of(member, part)).state_size(tuple(part.values()))
        set_now(member, part, values[at : at + size], m, y)
        at += size
