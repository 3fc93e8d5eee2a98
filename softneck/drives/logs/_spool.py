"""Rows of numbers on disk, so that the memory of a run does not grow with its duration."""

from __future__ import annotations

import os
import tempfile
import weakref
from array import array
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from softneck.core import Matrix

# Numbers in one write, 64 kB: a few seconds of a run.
_BLOCK = 8192
# Most numbers in memory where the disk takes no more, 134 MB: four hours of a neck at 50 Hz.
_MOST_HELD = 2**24
# Rows copied at once where rows become columns.
_ROWS_AT_ONCE = 4096


class Spool:
    """Rows of float64 in an unnamed temporary file, which a thread writes beside the control loop.

    `problem`: why the disk took no more, "" while it does; from then on rows stay in memory. `lost`: rows for which
    there was no memory either.
    """

    def __init__(self, columns: int, folder: Path | None = None) -> None:
        """Open the file in `folder`, or where temporary files are; nothing is opened later."""
        self.problem, self.lost = "", 0
        self._columns, self._stored, self._buffer = columns, 0, array("d")
        self._writing: Future[array[float]] | None = None
        self._writer = ThreadPoolExecutor(1, "softneck-rows")
        try:
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115 - lives as long as the run
            weakref.finalize(self, self._file.close)  # maps of it stay
        except OSError as error:
            self.problem = error.strerror or str(error)

    def append(self, row: Sequence[float]) -> None:
        """Add one row; a slow or full disk is not waited for."""
        if self.lost or len(self._buffer) + self._columns > _MOST_HELD:
            self.lost += 1
            return
        self._buffer.extend(row)
        if len(self._buffer) >= _BLOCK and not self.problem and (self._writing is None or self._writing.done()):
            self._take_back()
            if not self.problem:
                block, self._buffer = self._buffer, array("d")
                self._writing = self._writer.submit(self._store, block)

    def columns(self) -> Matrix:
        """Return all rows, (columns, rows); on disk where they are there. Nothing can be added afterwards."""
        self._writer.shutdown(wait=True)
        self._take_back()
        if self._stored and not self.problem:
            self._buffer = self._store(self._buffer)
        rows = (self._stored + len(self._buffer)) // self._columns
        if not self._stored:
            return np.array(self._buffer).reshape(rows, self._columns).T.copy()
        stored = np.memmap(self._file, np.float64, "r", shape=(self._stored,))
        made = None if self._buffer else self._room(rows)
        if made is None:  # the disk is full
            return np.concatenate([stored, self._buffer]).reshape(rows, self._columns).T.copy()
        table = stored.reshape(rows, self._columns)
        for start in range(0, rows, _ROWS_AT_ONCE):
            made[:, start : start + _ROWS_AT_ONCE] = table[start : start + _ROWS_AT_ONCE].T
        return made

    def _store(self, block: array[float]) -> array[float]:
        """Write `block`; return the part that does not fit on the disk."""
        data = memoryview(block).cast("B")
        done = 0
        try:
            self._file.seek(8 * self._stored)
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError as error:
            self.problem = error.strerror or str(error)
        data.release()
        self._stored += done // 8
        return block[done // 8 :]

    def _take_back(self) -> None:
        """Put what the thread could not write before the rows that came after it."""
        if self._writing is not None:
            self._buffer, self._writing = self._writing.result() + self._buffer, None

    def _room(self, rows: int) -> Matrix | None:
        """Return (columns, rows) behind the rows in the file, or None where the disk has no room for them."""
        size = 8 * rows * self._columns
        try:
            # Without it a full disk would end the process by SIGBUS.
            os.posix_fallocate(self._file.fileno(), size, size)
            return np.asarray(np.memmap(self._file, np.float64, "r+", offset=size, shape=(self._columns, rows)))
        except (OSError, AttributeError) as error:
            self.problem = str(error)
            return None
