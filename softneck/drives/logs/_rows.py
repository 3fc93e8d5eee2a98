"""Rows of an experiment, as they are collected and logged, and the recording that they make.

Where the motors were, and how fast, at the samples of a run follows from the positions of all bus cycles. A drive takes
its position at a SYNC, and the master reads it one cycle later: what was at t_k is known in the cycle after it. Speeds
(606Ch) are not mapped: they would be three more frames in each cycle, and are a difference of counts as well.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording


class Motion:
    """Times and positions of all bus cycles so far."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._times, self._positions = array("d"), array("d")

    def __len__(self) -> int:
        """Number of cycles."""
        return len(self._times)

    def take(self, now: float, positions: Sequence[float]) -> None:
        """Add what the cycle at `now` [s] read [rad]."""
        self._times.append(now)
        self._positions.extend(positions)

    def at(self, cycles: Sequence[int]) -> tuple[Matrix, Matrix]:
        """Return `motion_at` of these cycles."""
        return motion_at(np.array(self._times), np.array(self._positions).reshape(-1, 3), cycles)


def motion_at(times: Vector, positions: Matrix, cycles: Sequence[int]) -> tuple[Matrix, Matrix]:
    """Return positions [rad] and speeds [rad/s] of the motors at the times of `cycles`, (rows, 3) each.

    A speed is the central difference over the cycles before and after: off by h^2/6 of the third derivative, and by at
    most one count over 2 h. NaN where the cycles after it are missing.

    Args:
        times: of all cycles, (cycles,) [s].
        positions: as read in all cycles, (cycles, 3) [rad]: those of the cycle before.
        cycles: which ones.
    """
    k = np.asarray(cycles, dtype=np.int64)
    here, speed = np.full((k.size, 3), np.nan), np.full((k.size, 3), np.nan)
    known = k + 1 < len(times)
    here[known] = positions[k[known] + 1]
    around = (k >= 1) & (k + 2 < len(times))
    i = k[around]
    speed[around] = (positions[i + 2] - positions[i]) / (times[i + 1] - times[i - 1])[:, None]
    return here, speed


def speed_channels(speeds: Matrix) -> dict[str, Vector]:
    """Return speeds (rows, 3) as channels of a recording."""
    return {f"motor_velocity_{j + 1}": speeds[:, j].copy() for j in range(3)}


COLUMNS = (
    *(f"motor_setpoint_{j}" for j in (1, 2, 3)), "pitch", "roll", "pitch_rate", "roll_rate",
    *(f"tension_{j}" for j in (1, 2, 3)), "compression",
)  # fmt: skip
_WHERE_MEASURED = ("pitch_rate", "roll_rate", "compression", *(f"motor_velocity_{j}" for j in (1, 2, 3)))


def experiment_channels(table: Matrix, positions: Matrix, speeds: Matrix) -> dict[str, Vector]:
    """Return the channels of an experiment: rows of a `SignalLog`, positions and speeds at their times."""
    columns = dict(zip(COLUMNS, table.T.copy(), strict=True))
    moved = {f"motor_position_{j + 1}": positions[:, j].copy() for j in range(3)} | speed_channels(speeds)
    return {
        name: values
        for name, values in ({**columns, **moved}).items()
        if name not in _WHERE_MEASURED or np.isfinite(values).any()
    }


def experiment_table(rows: Sequence[Mapping[str, float]]) -> Matrix:
    """Return logged rows as the table of a `SignalLog`."""
    return np.array([[row.get(name, math.nan) for name in COLUMNS] for row in rows]).reshape(-1, len(COLUMNS))


def experiment_recording(columns: Mapping[str, Vector], run: Vector, sample_time: float) -> Recording | None:
    """Return rows of an experiment without its pauses; None where there are fewer than two, or no angles.

    Args:
        columns: channel -> (rows,).
        run: number of the run of each row, 0 in pauses, (rows,).
        sample_time: [s].
    """
    kept = np.flatnonzero(run)
    if kept.size < 2:
        return None
    channels = {name: values[kept] for name, values in columns.items()}
    if not all(np.isfinite(channels[name]).any() for name in ("pitch", "roll")):
        return None
    return Recording(kept * sample_time, sample_time, channels, run[kept].astype(np.int64))
