"""The own arrays of models that hold others, and what they must be."""

from __future__ import annotations

from collections.abc import Mapping

from softneck.core import Matrix

from ..models._arrays import ArrayLayout, check_table, within
from ..set_membership._arrays import check_set


def _check_residual(arrays: Mapping[str, Matrix], history: float) -> None:
    n = check_table(arrays["table"], history)
    within(arrays["table"][:, 0], 2, 3, "a regressor's source")
    check_set(arrays, n)


def _check_ensemble(arrays: Mapping[str, Matrix], history: float) -> None:
    """Nothing beyond what every composed model is checked for."""
    del arrays, history


RESIDUAL = ArrayLayout(
    ("history", "memory", "table", "scale", "points", "values", "bounds", "nodes", "frame"), _check_residual
)
ENSEMBLE = ArrayLayout(("history", "memory"), _check_ensemble)
