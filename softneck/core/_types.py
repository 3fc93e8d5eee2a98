"""Array types; shapes stand in the docstrings of those who use them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# `floating` and not `float64`: numpy's own stubs widen most expressions to it.
Vector = NDArray[np.floating[Any]]
Matrix = NDArray[np.floating[Any]]
