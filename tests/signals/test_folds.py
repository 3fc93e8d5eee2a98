"""Splits and folds by run: no row is lost, none is in two parts, and no border is crossed."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError
from softneck.signals import Recording

from ..data import TS


def numbered(rows: list[int]) -> Recording:
    """Runs whose pitch is the number of the row in the whole, so that each row can be told."""
    run = np.repeat(np.arange(len(rows)) * 10, rows)
    time = np.concatenate([TS * np.arange(n) for n in rows])
    channels = {name: 1e-4 * np.arange(run.size) for name in ("pitch", "roll")}
    channels |= {f"motor_setpoint_{j}": 0.0 * time for j in (1, 2, 3)}
    return Recording(time, TS, channels, run)


def rows_of(recording: Recording) -> list[int]:
    return np.round(recording.outputs[:, 0] / 1e-4).astype(int).tolist()


@pytest.mark.slow
@given(rows=st.lists(st.integers(2, 40), min_size=1, max_size=7), data=st.data())
def test_folds_hold_out_each_row_once_and_join_nothing(rows: list[int], data: st.DataObject) -> None:
    whole = numbered(rows)
    count = data.draw(st.integers(2, len(rows) if len(rows) > 1 else rows[0]))
    folds = whole.folds(count)
    assert sorted(itertools.chain.from_iterable(rows_of(held) for _, held in folds)) == list(range(len(whole)))
    for train, held in folds:
        assert sorted(rows_of(train) + rows_of(held)) == list(range(len(whole)))
        for run in (*train.runs(), *held.runs()):
            # Neighbours in a run were neighbours in the log.
            assert (np.diff(rows_of(run)) == 1).all()
        if len(rows) > 1:
            assert {len(run) for run in held.runs()} <= set(rows)


def test_folds_of_several_runs_have_about_as_many_rows() -> None:
    held = [len(part) for _, part in numbered([30, 10, 10, 10, 30]).folds(3)]
    assert sorted(held) == [30, 30, 30]


@pytest.mark.parametrize(("rows", "count", "message"), [([9, 9], 3, "2 runs make 2 to 2"), ([9], 1, "9 rows make")])
def test_a_number_of_folds_that_is_none(rows: list[int], count: int, message: str) -> None:
    with pytest.raises(DataError, match=f"{message}.* folds; got {count}"):
        numbered(rows).folds(count)
