"""Types for signatures: arrays, whose shapes stand in docstrings, and how long work reports itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: An array of floats with one axis, as a type.
# `floating` and not `float64`: numpy's own stubs widen most expressions to it.
Vector = NDArray[np.floating[Any]]
#: An array of floats with two axes, as a type.
Matrix = NDArray[np.floating[Any]]


#: Called with the fraction done, 0 to 1, and a word on what is being done.
Progress = Callable[[float, str], None]


def silent(done: float, what: str) -> None:
    """Report nothing."""
    del done, what
