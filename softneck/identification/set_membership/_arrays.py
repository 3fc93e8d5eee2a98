"""The arrays of set membership, in its runtime's order, and what they must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix, Vector

from ..linear._arrays import check_linear
from ..models._arrays import ArrayLayout, check_table, expect, within
from ._principal_tree import is_frame, slant_nodes


def _check_nlsm(arrays: Mapping[str, Matrix], history: float) -> None:
    check_set(arrays, check_table(arrays["table"], history))
    check_linear(arrays, history)


def check_set(arrays: Mapping[str, Matrix], n: int) -> None:
    rows = arrays["values"].shape[-1]
    for name, shape in {"scale": (n,), "points": (2, n, rows), "values": (2, rows), "bounds": (2, 2)}.items():
        expect(arrays, name, shape)
    within(np.array([rows]), 1, np.inf, "the number of points")
    frame, slopes = arrays["frame"], _slopes(arrays)
    if frame.ndim != 3 or frame.shape[::2] != (2, n) or not all(is_frame(rows) for rows in frame):
        raise FileFormatError("the directions in its array `frame` are not orthogonal; identify the model again.")
    parts = zip(frame, slopes, arrays["points"], arrays["values"], strict=True)
    nodes = np.array([slant_nodes(*axis) for axis in parts])
    # A tree of another shape would be read beyond its end, and one of other numbers would leave points out.
    if not np.array_equal(arrays["nodes"], nodes):
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")


def _slopes(arrays: Mapping[str, Matrix]) -> Vector:
    """Return the climb (2,) of the values' plane of each axis, less than the cones'."""
    nodes = arrays["nodes"]
    slopes = nodes[:, 0, 0] if nodes.ndim == 3 and nodes.shape[0] == 2 and nodes.size else np.full(2, -1.0)
    if not ((slopes >= 0.0) & ((slopes < arrays["bounds"][:, 0]) | (slopes == 0.0))).all():
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    return slopes


NLSM = ArrayLayout(
    (
        "history",
        "drive",
        "table",
        "scale",
        "points",
        "values",
        "bounds",
        "nodes",
        "frame",
        "redefinition",
        "a",
        "b",
        "delay",
    ),
    _check_nlsm,
)
