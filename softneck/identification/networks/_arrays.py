"""What the numbers in the arrays of the networks must be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix

from ..models._arrays import check_payloads, check_table, within


def check_nn(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    check_table(arrays["table"], sizes)
    if (arrays["correction"] < 0).any() or (arrays["correction"] >= 1).any():
        raise FileFormatError("its correction's memory and gain are not from 0 to 1, so that it would not die out.")


def check_nss(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(arrays["delay"], 0, sizes["H"] - 1, "a dead time")
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    if np.abs(np.linalg.eigvals(arrays["A"])).max(initial=0.0) >= 1.0:
        raise FileFormatError("its linear part is not stable, so that a free run could diverge.")
    if "payload" in arrays:
        check_payloads(*arrays["payload"])
