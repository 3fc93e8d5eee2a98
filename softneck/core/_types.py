"""Array types; shapes stand in the docstrings of those who use them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: An array of floats with one axis, as a type.
# `floating` and not `float64`: numpy's own stubs widen most expressions to it.
Vector = NDArray[np.floating[Any]]
#: An array of floats with two axes, as a type.
Matrix = NDArray[np.floating[Any]]
