"""What the numbers in the own arrays of models that hold others must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import within


def check_guarded(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["points"]]), 1, np.inf, "the number of points that were seen")
    low = {"sigma": np.nextafter(0.0, 1.0), "slope": 0.0, "fading": np.nextafter(0.0, 1.0), "reach": 0.0}
    for name, least in low.items():
        if (arrays[name] < least).any():
            raise FileFormatError(f"its array `{name}` must be {'positive' if least else '0 or positive'}.")
