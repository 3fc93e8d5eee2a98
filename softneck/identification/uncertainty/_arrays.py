"""What the numbers in the own arrays of models that hold others must be."""

from __future__ import annotations

from collections.abc import Mapping

from softneck.core import Matrix

from ..models._arrays import within
from ..set_membership._arrays import check_set


def check_residual(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["table"][:, 0], 2, 3, "a regressor's source")
    check_set(arrays, sizes)
