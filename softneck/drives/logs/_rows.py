"""Rows of an experiment, as they are collected and logged, and the recording that they make."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording

from ._motion import speed_channels

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
