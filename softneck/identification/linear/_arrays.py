"""What the numbers in the arrays of the linear kinds must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import Matrix

from ..models._arrays import within


def no_base(motors: int = 3, outputs: int = 2) -> dict[str, Matrix]:
    """Return the arrays of a set that stands alone."""
    empty = np.zeros((outputs, 0))
    return {"redefinition": np.zeros((3, motors)), "a": empty, "b": empty, "delay": np.zeros(outputs)}


def check_rls(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_linear(arrays, sizes)
    within(np.array([sizes["na"]]), 1, sizes["H"], "the order")


def check_oe(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_rls(arrays, sizes)
    within(arrays["source"], 0, 1, "the source")


def check_state_space(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["n"]]), sizes["outputs"], sizes["outputs"] * sizes["H"], "the order")
    within(arrays["delay"][:1], 0, sizes["H"] - 1, "a dead time")
    within(arrays["delay"][1:], 0, 1, "the source")


def check_linear(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["delay"], 0, sizes["H"] - sizes["nb"], "a dead time")
    within(np.array([sizes["na"]]), 0, sizes["H"], "the order")
