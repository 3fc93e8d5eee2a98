"""A pilot that plays set-points, and a log of what was sent and measured meanwhile."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from softneck.core import Matrix, Vector

from .master import Frame, Master, Measured, Phase, Tilt

_COLUMNS = 10


class SignalPilot:
    """Plays set-points (rows, 3) [rad], one row each sample."""

    def __init__(self, set_points: Matrix) -> None:
        """Play `set_points` from the first row on."""
        self._rows = [(float(a), float(b), float(c)) for a, b, c in set_points]

    def start(self) -> None:
        """Nothing is kept between samples."""

    def step(self, measured: Measured) -> tuple[float, float, float] | None:
        """Return the set-points of this sample."""
        return self._rows[measured.index]

    def finished(self, index: int) -> bool:
        """Return whether all rows were played."""
        return index >= len(self._rows)


class SignalLog:
    """One row for each sample while the pilot leads; to be called after each cycle (see `Session`).

    Row k holds what was measured at t_k and the set-points that were sent for [t_k, t_k+1), which are those of the
    pilot unless a limit clamped them. An angle that did not come or was not believed is NaN.
    """

    def __init__(self, rows: int) -> None:
        """Make room for `rows`."""
        self._table = np.full((rows, _COLUMNS), np.nan)
        self._cycles = 0
        self._complete = False
        self.index = -1

    def __call__(
        self, now: float, frames_in: Sequence[Frame], frames_out: Sequence[Frame], tilt: Tilt | None, master: Master
    ) -> None:
        """Take what this cycle measured and sent."""
        del now, frames_in, frames_out
        if master.supervisor.phase is not Phase.RUNNING or master.index >= len(self._table):
            return
        if master.index != self.index:
            self.index, self._cycles = master.index, 0
            row = self._table[self.index]
            row[3:6] = master.positions
            if tilt is not None and master.tilt is tilt:
                row[6:] = tilt.pitch, tilt.roll, tilt.pitch_rate, tilt.roll_rate
        self._cycles += 1
        self._complete = self._cycles >= master.settings.sample_cycles
        self._table[self.index, :3] = master.setpoints

    @property
    def rows(self) -> int:
        """Samples whose set-points were sent to their end."""
        return self.index + 1 if self._complete or self.index < 0 else self.index

    def columns(self) -> dict[str, Vector]:
        """Return the channels of a recording; rates only where they were measured."""
        table = self._table[: self.rows]
        names = [f"motor_setpoint_{j}" for j in (1, 2, 3)] + [f"motor_position_{j}" for j in (1, 2, 3)]
        names += ["pitch", "roll", "pitch_rate", "roll_rate"]
        columns = {name: table[:, i].copy() for i, name in enumerate(names)}
        for name in ("pitch_rate", "roll_rate"):
            if not np.isfinite(columns[name]).any():
                del columns[name]
        return columns


def raised_cosine(rows: int) -> Vector:
    """Return a smooth way from 0 to 1 over `rows` samples, (rows,), the last one 1."""
    return 0.5 - 0.5 * np.cos(math.pi * np.arange(1, rows + 1) / rows)
