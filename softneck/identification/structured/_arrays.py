"""What the numbers in the arrays of the structured kinds must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import within
from ._greybox_numbers import NUMBERS


def check_play(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["chain"][1:], 1, 1000, "the order of the filters")
    signals = 3 * (1 + sizes["w"]) * sizes["order"]
    within(arrays["table"], -1, signals - 1, "a term's signal")
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")


def check_greybox(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    within(arrays["drive"][:, 1], 1, sizes["H"], "a drive's delay")
    within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    for number, value in zip(NUMBERS, arrays["neck"], strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")
