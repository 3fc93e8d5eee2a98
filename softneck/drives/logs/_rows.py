"""Rows of an experiment, as collected and logged, and the recording made from them.

Positions and speeds of the motors at the samples of a run are computed from the positions of all bus cycles. A drive
samples its position at a SYNC, and the master reads it one cycle later: the position at t_k is known in the next cycle.
Speeds (606Ch) are not mapped: they would need three more frames in each cycle, and are also differences of counts.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence

import numpy as np

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.signals import NECK, Recording


class Motion:
    """Times and positions of all bus cycles so far."""

    def __init__(self, motors: int = 3) -> None:
        """Start empty."""
        self._times, self._positions, self._motors = array("d"), array("d"), motors

    def __len__(self) -> int:
        """Number of cycles."""
        return len(self._times)

    def take(self, now: float, positions: Sequence[float]) -> None:
        """Add the positions [rad] read in the cycle at `now` [s]."""
        self._times.append(now)
        self._positions.extend(positions)

    def at(self, cycles: Sequence[int]) -> tuple[Matrix, Matrix]:
        """Return `motion_at` of these cycles."""
        return motion_at(np.array(self._times), np.array(self._positions).reshape(-1, self._motors), cycles)


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
    columns = dict(zip(columns_of(robot), table.T.copy(), strict=True))
    moved = dict(zip(robot.motor_positions, positions.T.copy(), strict=True))
    moved |= dict(zip(robot.motor_velocities, speeds.T.copy(), strict=True))
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
