"""What a file of a filter may hold."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from softneck.core import FileFormatError, load, read_archive, write_archive
from softneck.estimation import KalmanSettings

from .necks import neck


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, value: float) -> None:
    KalmanSettings().design(neck()).save(tmp_path / "o.npz")
    header, arrays = read_archive(tmp_path / "o.npz")
    header = {key: item for key, item in header.items() if not key.startswith("format")}
    spoilt = {name: array.copy() for name, array in arrays.items()}
    spoilt["P0"][0, 0] = value
    write_archive(tmp_path / "bad.npz", header, spoilt)
    with pytest.raises(FileFormatError, match=r"positive semidefinite|not finite"):
        load(tmp_path / "bad.npz")
    lopsided = {**arrays, "P0": arrays["P0"] + np.triu(np.ones((4, 4)), 1)}
    write_archive(tmp_path / "lopsided.npz", header, lopsided)
    with pytest.raises(FileFormatError, match="must be finite and symmetric"):
        load(tmp_path / "lopsided.npz")


@pytest.mark.parametrize(
    ("form", "more", "gone"),
    [("kinematic", {}, "form kinematic"), ("model", {"gain": np.zeros((4, 2))}, "constant gains")],
)
def test_what_went_says_so(tmp_path: Path, form: str, more: dict[str, np.ndarray], gone: str) -> None:
    KalmanSettings().design(neck()).save(tmp_path / "o.npz")
    header, arrays = read_archive(tmp_path / "o.npz")
    header = {key: item for key, item in header.items() if not key.startswith("format")} | {"form": form}
    write_archive(tmp_path / "old.npz", header, {**arrays, **more})
    with pytest.raises(FileFormatError, match=rf"{gone} was removed after softneck 0\.2\.0, which reads the file"):
        load(tmp_path / "old.npz")
