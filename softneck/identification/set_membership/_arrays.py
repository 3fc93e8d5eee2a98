"""What the numbers in the arrays of set membership must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix, Vector

from ..linear._arrays import check_linear
from ..models._arrays import check_table, within
from ._trees import is_frame, slant_nodes


def check_nlsm(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_set(arrays, sizes)
    check_linear(arrays, sizes)


def check_set(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_table(arrays["table"], sizes)
    within(np.array([sizes["rows"]]), 1, np.inf, "the number of points")
    frame, slopes = arrays["frame"], _slopes(arrays)
    if not all(is_frame(rows) for rows in frame):
        raise FileFormatError("the directions in its array `frame` are not orthogonal; identify the model again.")
    parts = zip(frame, slopes, arrays["points"], arrays["values"], strict=True)
    nodes = np.array([slant_nodes(*axis) for axis in parts])
    # A tree of another shape would be read beyond its end, and one of other numbers would leave points out.
    if not np.array_equal(arrays["nodes"], nodes):
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")


def _slopes(arrays: Mapping[str, Matrix]) -> Vector:
    """Return the climb (outputs,) of the values' plane of each axis, less than the cones'."""
    nodes = arrays["nodes"]
    axes = len(arrays["bounds"])
    slopes = nodes[:, 0, 0] if nodes.ndim == 3 and len(nodes) == axes and nodes.size else np.full(axes, -1.0)
    if not ((slopes >= 0.0) & ((slopes < arrays["bounds"][:, 0]) | (slopes == 0.0))).all():
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    return slopes
