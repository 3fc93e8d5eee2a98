"""The arrays of the structured kinds, in their runtimes' order, and what they must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import ArrayLayout, expect, within
from ._greybox_numbers import NUMBERS


def _check_play(arrays: Mapping[str, Matrix], history: float) -> None:
    widths, n, p = arrays["widths"].shape[0], len(arrays["table"]), arrays["echo"].shape[-1]
    shapes = {
        "load": (4,), "redefinition": (3, 3), "widths": (widths,), "chain": (2,), "table": (n, 3), "weights": (2, n),
        "range": (2, 2), "echo": (2, p),
    }  # fmt: skip
    for name, shape in shapes.items():
        expect(arrays, name, shape)
    within(arrays["chain"][1:], 1, 1000, "the order of the filters")
    signals = 3 * (1 + widths) * arrays["chain"][1]
    within(arrays["table"], -1, signals - 1, "a term's signal")
    within(np.array([p]), 1, history, "the length of the echo")


def _check_greybox(arrays: Mapping[str, Matrix], history: float) -> None:
    p = arrays["echo"].shape[-1]
    for name, shape in {"neck": (len(NUMBERS),), "sensor": (2,), "echo": (2, p)}.items():
        expect(arrays, name, shape)
    within(np.array([p]), 1, history, "the length of the echo")
    within(arrays["drive"][:, 1], 1, history, "a drive's delay")
    within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    for number, value in zip(NUMBERS, arrays["neck"], strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")


PLAY = ArrayLayout(
    ("history", "drive", "load", "redefinition", "widths", "chain", "table", "weights", "range", "echo", "memory"),
    _check_play,
)
GREYBOX = ArrayLayout(("history", "drive", "neck", "sensor", "echo", "memory"), _check_greybox)
