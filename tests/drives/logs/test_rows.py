"""Rows of a run on disk: the same numbers as in memory, in memory that does not grow, on a full disk too."""

from __future__ import annotations

import errno
import itertools
import os
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.drives.logs import _rows
from softneck.drives.logs._rows import Rows, Spool, motion_at
from softneck.drives.running._pilot import RunLog
from softneck.signals import NECK


def fed(cycles: int, every: int, folder: Path) -> tuple[Rows, np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Feed random cycles, with a row each `every` of them; return what was fed, and the cycles of the rows."""
    rng = np.random.default_rng(cycles + every)
    times, positions = np.cumsum(rng.uniform(0.005, 0.02, cycles)), rng.normal(size=(cycles, 2))
    rows, table, first = Rows(3, 2, folder), rng.normal(size=(cycles // every + 1, 3)), list[int]()
    row = [0.0] * 7  # there is none before the first cycle
    for k in range(cycles):
        rows.take(times[k], tuple(positions[k].tolist()))
        if k % every == 0:
            first.append(k)
            row = rows.add([0.0, 0.0, 0.0])
        row[:3] = table[len(first) - 1]  # until the next one a row may change
    return rows, table[: len(first)], times, positions, first


@pytest.mark.parametrize("block", [_rows._BLOCK, 10])
@pytest.mark.parametrize(("cycles", "every"), list(itertools.product([1, 2, 3, 4, 500], [1, 2, 5])))
def test_rows_on_disk_are_those_in_memory(
    cycles: int, every: int, block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_rows, "_BLOCK", block)
    monkeypatch.setattr(_rows, "_ROWS_AT_ONCE", 7)
    rows, table, times, positions, first = fed(cycles, every, tmp_path)
    found = rows.finish()
    for one, other in zip(found, (table, *motion_at(times, positions, first)), strict=True):
        np.testing.assert_array_equal(one, other)
    assert rows.notes() == ()
    assert list(tmp_path.iterdir()) == []


class SmallDisk:
    """A file that takes `space` bytes."""

    def __init__(self, file: Any, space: int) -> None:
        self._file, self._space = file, space

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, data: memoryview) -> int:
        left = self._space - self._file.tell()
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._file.write(data[:left])


@pytest.mark.parametrize("space", [0, 8 * 64, 8 * 64 * 3 + 5])
def test_a_full_disk_loses_nothing_and_is_told_once(
    space: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_rows, "_BLOCK", 64)
    spool = Spool(4, tmp_path)
    monkeypatch.setattr(spool, "_file", SmallDisk(spool._file, space))
    rows = np.random.default_rng(1).normal(size=(500, 4))
    for row in rows.tolist():
        spool.append(row)
    np.testing.assert_array_equal(spool.columns(), rows.T)
    assert (spool.problem, spool.lost) == (os.strerror(errno.ENOSPC), 0)


def test_a_disk_without_room_for_columns_gives_them_from_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(_rows, "_BLOCK", 64)
    monkeypatch.setattr(os, "posix_fallocate", full)
    rows = np.random.default_rng(2).normal(size=(500, 4))
    spool = Spool(4, tmp_path)
    for row in rows.tolist():
        spool.append(row)
    np.testing.assert_array_equal(spool.columns(), rows.T)


def test_without_disk_and_memory_the_first_rows_are_kept_and_the_rest_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_rows, "_MOST_HELD", 70)
    rows = Rows(3, 2, tmp_path / "gone")
    for k in range(20):
        rows.take(float(k), (0.0, 0.0))
        rows.add([float(k)] * 3)
    table, _, _ = rows.finish()
    assert table[:, 0].tolist() == list(range(10))
    assert rows.notes() == ("the disk took no more rows (No such file or directory): the last 10 are lost",)


def grown(cycles: int, folder: Path) -> int:
    """Return the most memory [B] that a run of so many cycles takes, its result included."""
    signals = np.linspace(0.0, 1.0, 40)
    pilot: Any = SimpleNamespace(robot=NECK, signals=signals, slot=lambda part, name: len(part + name) % 40)
    log = RunLog(pilot, truth=False, folder=folder)
    master: Any = SimpleNamespace(ran=True, tilt=None, tensions=(1.0, 2.0, 3.0))
    tracemalloc.start()
    for k in range(cycles):
        master.index, master.positions = k, (0.001 * k, 0.002 * k, 0.003 * k)
        log.take(0.01 * k, master, None)
    most = tracemalloc.get_traced_memory()[1]
    result, speeds, _ = log.finish(0.01)
    tracemalloc.stop()
    assert len(result.time) == len(speeds) == cycles
    return most


def test_memory_does_not_grow_with_the_duration(tmp_path: Path) -> None:
    grown(10, tmp_path)  # what is imported and kept for ever
    # Two blocks of 64 kB more or less; 6,000 rows of 200 B in memory would be 1.2 MB.
    short, long = grown(2_000, tmp_path), grown(8_000, tmp_path)
    assert long < short + 2 * 8 * _rows._BLOCK
