"""Predictive control that is told the payload: tendons are pulled tauter with it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import FileFormatError, load, read_archive
from softneck.design import MpcController, MpcSettings
from softneck.design.predictive._mpc_state_runtime import MpcArrays
from softneck.design.predictive._settings import MpcNumbers

from .mpc_neck import Neck
from .test_mpc_speed import identified

PER_KG = 2.0


@pytest.fixture(scope="module")
def told() -> MpcController:
    return MpcNumbers(bandwidth=6.0, payload_tautness=PER_KG).design(identified())


@pytest.fixture(scope="module")
def untold() -> MpcController:
    return MpcSettings(bandwidth=6.0).design(identified())


def moved(neck: Neck, payloads: list[float] | None = None) -> np.ndarray:
    """Return the set-points of some steps."""
    rows = []
    for k in range(60):
        others = {} if payloads is None else {"payload": payloads[k]}
        rows.append(neck.step(0.2 if k % 40 < 20 else -0.1, 0.1, **others))
    return np.array(rows)


def common(path: np.ndarray) -> float:
    return float(path[-1].mean())


def test_a_payload_is_worth_so_much_tautness(told: MpcController, untold: MpcController) -> None:
    """The same numbers, to the bit, as of one whose wish is larger by as much."""
    for kg in (0.0, 0.75):
        other = Neck(untold, minimum_tautness=0.5 + PER_KG * kg)
        np.testing.assert_array_equal(moved(Neck(told), [kg] * 60), moved(other))


def test_what_comes_later_is_followed_slowly_and_what_is_lost_stays(told: MpcController) -> None:
    lost = moved(Neck(told), [0.0] * 5 + [1.0] * 15 + [math.nan] * 40)
    np.testing.assert_array_equal(lost, moved(Neck(told), [0.0] * 5 + [1.0] * 55))
    jumped, there = common(moved(Neck(told), [0.0] * 59 + [1.0])), common(moved(Neck(told), [1.0] * 60))
    before = common(moved(Neck(told), [0.0] * 60))
    # One sample behind a lag of half a second is 4 % of the way.
    assert 0.0 <= jumped - before < 0.06 * (there - before)
    # A wish of light weight: co-contraction costs as well, and takes part of it away.
    assert 0.2 * PER_KG < there - before <= PER_KG


def test_files_say_it_only_where_it_is_asked(told: MpcController, untold: MpcController, tmp_path: Path) -> None:
    columns = [MpcArrays(item.arrays).disturbances.shape[1] for item in (untold, told)]
    assert columns == [3, 4]
    told.save(tmp_path / "mpc.npz")
    again: Any = load(tmp_path / "mpc.npz")
    np.testing.assert_array_equal(moved(Neck(again), [1.0] * 60), moved(Neck(told), [1.0] * 60))


def test_where_no_tautness_is_wished_for_a_payload_asks_for_none() -> None:
    none = MpcNumbers(bandwidth=6.0, payload_tautness=1.0, minimum_tautness=None).design(identified())
    assert "payload" not in {port.name for port in none.block().inputs}


@pytest.mark.parametrize(
    ("place", "value", "said"), [(2, 3.0, "scenarios"), (15, 0.01, "tightened limits"), (9, 0.0, "measured")]
)
def test_files_of_what_went_say_so(told: MpcController, place: int, value: float, said: str, tmp_path: Path) -> None:
    old = replace(told, arrays=tuple(array.copy() for array in told.arrays))
    MpcArrays(old.arrays).constants[place] = value
    told.save(tmp_path / "mpc.npz")
    header, arrays = read_archive(tmp_path / "mpc.npz")
    arrays = {**arrays, "constants": MpcArrays(old.arrays).constants}
    with pytest.raises(FileFormatError, match=f"{said}.* went after softneck 0.2.0, which still reads the file"):
        MpcController.from_archive(header, arrays)
