"""The arrays of the networks, in their runtimes' order, and what they must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import ArrayLayout, check_table, expect, within


def _check_nn(arrays: Mapping[str, Matrix], history: float) -> None:
    n = check_table(arrays["table"], history)
    h1, h2 = arrays["b1"].shape[-1], arrays["b2"].shape[-1]
    shapes = {
        "W1": (2, h1, n), "b1": (2, h1), "W2": (2, h2, h1), "b2": (2, h2), "w3": (2, h2), "b3": (2,),
        "input_scale": (2, 2, n), "output_scale": (2, 2), "load": (4,),
        "correction": (2, 2),
    }  # fmt: skip
    for name, shape in shapes.items():
        expect(arrays, name, shape)
    if (arrays["correction"] < 0).any() or (arrays["correction"] >= 1).any():
        raise FileFormatError("its correction's memory and gain are not from 0 to 1, so that it would not die out.")


def _check_nss(arrays: Mapping[str, Matrix], history: float) -> None:
    widths, n, q, p = (arrays[name].shape[-1] for name in ("widths", "A", "h", "echo"))
    inputs = 3 * (1 + widths)
    shapes = {
        "load": (4,), "redefinition": (3, 3), "widths": (widths,), "delay": (1,), "A": (n, n), "B": (n, inputs),
        "E": (n, q), "F": (q, n), "G": (q, inputs), "h": (q,), "D": (q, q), "C": (2, n), "c": (2,), "range": (2, 2),
        "echo": (2, p),
    }  # fmt: skip
    for name, shape in shapes.items():
        expect(arrays, name, shape)
    within(arrays["delay"], 0, history - 1, "a dead time")
    within(np.array([p]), 1, history, "the length of the echo")
    if np.abs(np.linalg.eigvals(arrays["A"])).max(initial=0.0) >= 1.0:
        raise FileFormatError("its linear part is not stable, so that a free run could diverge.")


NN = ArrayLayout(
    (
        "history",
        "drive",
        "table",
        "W1",
        "b1",
        "W2",
        "b2",
        "w3",
        "b3",
        "input_scale",
        "output_scale",
        "load",
        "correction",
    ),
    _check_nn,
)
NSS = ArrayLayout(
    (
        "history",
        "drive",
        "load",
        "redefinition",
        "widths",
        "delay",
        "A",
        "B",
        "E",
        "F",
        "G",
        "h",
        "D",
        "C",
        "c",
        "range",
        "echo",
        "memory",
    ),
    _check_nss,
)
