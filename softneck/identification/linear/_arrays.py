"""The arrays of the linear kinds, in their runtimes' order, and what they must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Matrix

from ..models._arrays import ArrayLayout, expect, within


def no_base() -> dict[str, Matrix]:
    """Return the arrays of a set that stands alone."""
    empty = np.zeros((2, 0))
    return {"redefinition": np.zeros((3, 3)), "a": empty, "b": empty, "delay": np.zeros(2)}


def _check_rls(arrays: Mapping[str, Matrix], history: float) -> None:
    check_linear(arrays, history)
    within(np.array([arrays["a"].shape[-1]]), 1, history, "the order")


def _check_oe(arrays: Mapping[str, Matrix], history: float) -> None:
    _check_rls(arrays, history)
    expect(arrays, "source", (1,))
    within(arrays["source"], 0, 1, "the source")


def _check_state_space(arrays: Mapping[str, Matrix], history: float) -> None:
    n = arrays["A"].shape[-1]
    for name, shape in {"A": (n, n), "B": (n, 3), "K": (n, 2), "delay": (2,)}.items():
        expect(arrays, name, shape)
    within(np.array([n]), 2, 2 * history, "the order")
    within(arrays["delay"][:1], 0, history - 1, "a dead time")
    within(arrays["delay"][1:], 0, 1, "the source")


def check_linear(arrays: Mapping[str, Matrix], history: float) -> None:
    na, nb = arrays["a"].shape[-1], arrays["b"].shape[-1]
    for name, shape in {"redefinition": (3, 3), "a": (2, na), "b": (2, nb), "delay": (2,)}.items():
        expect(arrays, name, shape)
    within(arrays["delay"], 0, history - nb, "a dead time")
    within(np.array([na]), 0, history, "the order")


RLS = ArrayLayout(("history", "drive", "redefinition", "a", "b", "delay"), _check_rls)
# `oe` and `srivc`.
OE = ArrayLayout(("history", "drive", "redefinition", "a", "b", "delay", "source"), _check_oe)
# `subspace`, and what is linear over the motors or of more than one pole.
STATE_SPACE = ArrayLayout(("history", "drive", "A", "B", "K", "delay"), _check_state_space)
