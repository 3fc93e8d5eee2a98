"""Where the motors were, and how fast, at the samples of a run: from the positions of all bus cycles.

A drive takes its position at a SYNC, and the master reads it one cycle later: what was at t_k is known in the cycle
after it. Speeds (606Ch) are not mapped: they would be three more frames in each cycle, and are a difference of counts
as well.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, Vector


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
