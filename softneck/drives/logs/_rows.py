"""Rows of an experiment, as collected and logged, and the recording made from them.

Positions and speeds of the motors at the samples of a run are computed from the positions of all bus cycles. A drive
samples its position at a SYNC, and the master reads it one cycle later: the position at t_k is known in the next cycle.
Speeds (606Ch) are not mapped: they would need three more frames in each cycle, and are also differences of counts.
"""

from __future__ import annotations

import math
import os
import tempfile
import weakref
from array import array
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.signals import NECK, Recording

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


class Rows:
    """Rows of a run, each with the positions and speeds of the motors at its time, which the next two cycles tell.

    `motors`: how many there are.
    """

    def __init__(self, columns: int, motors: int, folder: Path | None = None) -> None:
        """Start with no row of `columns` numbers; the file is in `folder`."""
        self._spool, self._motors = Spool(columns + 2 * motors, folder), motors
        self._unfinished: deque[tuple[int, list[float]]] = deque()
        self._recent: deque[tuple[float, Sequence[float]]] = deque(maxlen=4)
        self._cycle = -1

    def take(self, now: float, positions: Sequence[float]) -> None:
        """Take the positions [rad] read in the cycle at `now` [s]; `motion_at` has the equations."""
        self._cycle += 1
        self._recent.append((now, positions))
        m = self._motors
        for cycle, row in self._unfinished:
            if self._cycle == cycle + 1:
                row[-2 * m : -m] = positions
            elif self._cycle == cycle + 2 and cycle >= 1:
                (first, _), (_, before), (last, _), _ = self._recent
                if last > first:
                    row[-m:] = [(p - q) / (last - first) for p, q in zip(positions, before, strict=True)]
        # The last row may still change.
        while len(self._unfinished) > 1 and self._unfinished[0][0] + 2 <= self._cycle:
            self._spool.append(self._unfinished.popleft()[1])

    def add(self, row: Sequence[float]) -> list[float]:
        """Add a row of this cycle; return it, which may be changed until the next one."""
        added = [*row, *[math.nan] * (2 * self._motors)]
        self._unfinished.append((self._cycle, added))
        return added

    def finish(self) -> tuple[Matrix, Matrix, Matrix]:
        """Return the rows (rows, columns), positions [rad] and speeds [rad/s] (rows, motors)."""
        while self._unfinished:
            self._spool.append(self._unfinished.popleft()[1])
        table, m = self._spool.columns().T, self._motors
        return table[:, : -2 * m], table[:, -2 * m : -m], table[:, -m:]

    def notes(self) -> tuple[str, ...]:
        """Return what to say of a full disk."""
        spool = self._spool
        if spool.lost:
            return (f"the disk took no more rows ({spool.problem}): the last {spool.lost} are lost",)
        return (f"the disk took no more rows ({spool.problem}); they were kept in memory",) if spool.problem else ()


def motion_at(times: Vector, positions: Matrix, cycles: Sequence[int]) -> tuple[Matrix, Matrix]:
    """Return positions [rad] and speeds [rad/s] of the motors at the times of `cycles`, (rows, motors) each.

    A speed is the central difference over the cycles before and after, with an error of h^2/6 of the third derivative,
    and of at most one count over 2 h. NaN if the cycles after it are missing.
    `times`: of all cycles, (cycles,) [s]. `positions`: as read in all cycles, (cycles, motors) [rad]: those of the
    cycle before. `cycles`: indices of the cycles.
    """
    k = np.asarray(cycles, dtype=np.int64)
    here = np.full((k.size, positions.shape[1]), np.nan)
    speed = here.copy()
    known = k + 1 < len(times)
    here[known] = positions[k[known] + 1]
    around = (k >= 1) & (k + 2 < len(times))
    i = k[around]
    speed[around] = (positions[i + 2] - positions[i]) / (times[i + 1] - times[i - 1])[:, None]
    return here, speed


def truths(robot: Robot) -> tuple[str, ...]:
    """Return the channels that only simulated drives have: tensions, and the compression of a neck."""
    return (*(f"tension_{j}" for j in range(1, len(robot.motors.names) + 1)), "compression")


def columns_of(robot: Robot) -> tuple[str, ...]:
    """Return the columns of an experiment: set-points, outputs, their rates, and `truths`."""
    outputs = robot.outputs.names
    return (*robot.set_points, *outputs, *(f"{name}_rate" for name in outputs), *truths(robot))


def experiment_channels(
    table: Matrix, positions: Matrix, speeds: Matrix, robot: Robot = NECK
) -> dict[str, Vector]:  # fmt: skip
    """Return the channels of an experiment: rows of a `SignalLog`, positions and speeds at their times."""
    columns = dict(zip(columns_of(robot), table.T, strict=True))
    moved = dict(zip(robot.motor_positions, positions.T, strict=True))
    moved |= dict(zip(robot.motor_velocities, speeds.T, strict=True))
    maybe = {"compression", *(f"{name}_rate" for name in robot.outputs.names), *robot.motor_velocities}
    return {
        name: values
        for name, values in ({**columns, **moved}).items()
        if name not in maybe or np.isfinite(values).any()
    }


def experiment_table(rows: Sequence[Mapping[str, float]], robot: Robot = NECK) -> Matrix:
    """Return logged rows as the table of a `SignalLog`."""
    names = columns_of(robot)
    return np.array([[row.get(name, math.nan) for name in names] for row in rows]).reshape(-1, len(names))


def experiment_recording(
    columns: Mapping[str, Vector], run: Vector, sample_time: float, robot: Robot = NECK
) -> Recording | None:
    """Return the rows of an experiment without its pauses; None for fewer than two rows, or without angles.

    `columns`: channel -> (rows,). `run`: number of the run of each row, 0 in pauses, (rows,). `sample_time`: [s].
    `robot`: of the run.
    """
    kept = np.flatnonzero(run)
    if kept.size < 2:
        return None
    channels = {name: values[kept] for name, values in columns.items()}
    if not all(np.isfinite(channels[name]).any() for name in robot.outputs.names):
        return None
    return Recording(kept * sample_time, sample_time, channels, run[kept].astype(np.int64), robot)
