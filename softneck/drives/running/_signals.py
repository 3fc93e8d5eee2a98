"""The signals of a run on drives, row by row: of a controller's run, and of set-points that are played."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, Vector
from softneck.loop import LoopResult
from softneck.signals.recording._channels import NECK

from ..bus._link import VirtualLink
from ..logs._result import signal_units
from ..logs._rows import Motion, columns_of, experiment_channels, truths
from ..master import Frame, Master, Phase
from ..master._gate import Reading
from ..master._measured import Measurement, Motors
from ._pilot import LoopPilot

if TYPE_CHECKING:
    from ._bus_loop import Session


class RunLog:
    """Collects one row for each sample while the controller runs."""

    def __init__(self, pilot: LoopPilot) -> None:
        """Prepare the columns."""
        self._pilot, self._robot = pilot, pilot.robot
        outputs = pilot.robot.outputs.names
        places = {}
        for name in (*outputs, "cocontraction"):
            places[f"{name}_reference"] = pilot.slot("reference", f"{name}_reference")
        for name in pilot.robot.set_points:
            places[name] = pilot.slot("controller", name)
        for name in outputs:
            places[f"{name}_estimate"] = pilot.slot("observer", name)
        places["healthy"] = pilot.slot("observer", "healthy")
        self._places = {name: place for name, place in places.items() if place is not None}
        self._rows: list[list[float]] = []
        self._index = -1
        self._motion, self._cycles = Motion(len(pilot.robot.motors.names)), list[int]()

    def take(self, now: float, master: Master, truth: Mapping[str, float] | None) -> dict[str, float] | None:
        """Take the cycle at `now` [s]; add the row of its sample, once, and return it by name."""
        self._motion.take(now, master.positions)
        if not master.ran or master.index <= self._index:
            return None
        self._index = master.index
        self._cycles.append(len(self._motion) - 1)
        signals = self._pilot.signals
        row = [float(signals[place]) for place in self._places.values()]
        tilt = master.tilt
        row += [*master.positions, *master.tensions]
        nothing = [math.nan] * (2 * len(self._robot.outputs.names))
        row += nothing if tilt is None else [*tilt.values, *tilt.rates]
        if truth is not None:
            row += [truth.get(name, math.nan) for name in self._truths]
        self._rows.append(row)
        return dict(zip(self._names(truth is not None), row, strict=True))

    def _names(self, truth: bool) -> list[str]:
        robot = self._robot
        names = [*self._places, *robot.motor_positions]
        names += [f"tension_estimate_{j}" for j in range(1, len(robot.motors.names) + 1)]
        names += [f"{name}{what}_measured" for what in ("", "_rate") for name in robot.outputs.names]
        return names + (list(self._truths) if truth else [])

    @property
    def _truths(self) -> tuple[str, ...]:
        names = (*self._robot.outputs.names, *truths(self._robot))
        return names if self._robot.is_neck else names[:-1]

    def speeds(self) -> Matrix:
        """Return the motors' speeds at all rows, (rows, motors) [rad/s]."""
        return self._motion.at(self._cycles)[1]

    def result(self, sample_time: float, *, truth: bool) -> LoopResult:
        """Return all rows."""
        names = self._names(truth)
        table = np.array(self._rows) if self._rows else np.zeros((0, len(names)))
        signals: dict[str, Vector] = {name: table[:, i].copy() for i, name in enumerate(names)}
        time = np.arange(len(table)) * sample_time
        return LoopResult(time, signals, signal_units(names), sample_time, self._robot)


class SignalPilot:
    """Plays set-points (rows, motors) [rad], one row each sample."""

    def __init__(self, set_points: Matrix) -> None:
        """Play `set_points` from the first row on."""
        self._rows = [tuple(row) for row in np.asarray(set_points, dtype=np.float64).tolist()]

    def start(self) -> None:
        """Nothing is kept between samples."""

    def step(self, measured: Measurement) -> Motors | None:
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

    def __init__(self, rows: int, *, run: Vector | None = None, session: Session | None = None) -> None:
        """Make room for `rows`; with a `session` each row goes into its log too, with its number in `run`."""
        self._robot = NECK if session is None else session.file.moves
        self._names = columns_of(self._robot)
        self._motors, self._outputs = len(self._robot.motors.names), len(self._robot.outputs.names)
        self._table = np.full((rows, len(self._names)), np.nan)
        self._first: list[int] = []
        self._motion = Motion(self._motors)
        self._run = run
        self._log = None if session is None else session.log
        link = None if session is None else session.link
        self._truth = link.neck.truth if isinstance(link, VirtualLink) else None
        self._cycles = 0
        self._complete = False
        self.index = -1

    def __call__(
        self, now: float, frames_in: Sequence[Frame], frames_out: Sequence[Frame], tilt: Reading | None,
        master: Master,
    ) -> None:  # fmt: skip
        """Take what this cycle measured and sent."""
        del frames_in, frames_out
        self._motion.take(now, master.positions)
        if master.supervisor.phase is not Phase.RUNNING or master.index >= len(self._table):
            return
        if master.index != self.index:
            self.index, self._cycles = master.index, 0
            self._first.append(len(self._motion) - 1)
            self._measure(self._table[self.index], tilt, master)
        self._cycles += 1
        self._complete = self._cycles == master.settings.sample_cycles
        self._table[self.index, : self._motors] = master.setpoints
        if self._complete and self._log is not None:
            row = dict(zip(self._names, self._table[self.index].tolist(), strict=True))
            self._log.signals({**row, "run": 1.0 if self._run is None else float(self._run[self.index])})

    def _measure(self, row: Vector, tilt: Reading | None, master: Master) -> None:
        known = self._motors + 2 * self._outputs
        if tilt is not None and master.tilt is tilt:
            row[self._motors : known] = (*tilt.values, *tilt.rates)
        if self._truth is None:
            row[known : known + self._motors] = master.tensions
        else:
            truth = self._truth()
            row[known:] = [truth.get(name, math.nan) for name in self._names[known:]]

    @property
    def rows(self) -> int:
        """Samples whose set-points were sent to their end."""
        return self.index + 1 if self._complete or self.index < 0 else self.index

    def columns(self) -> dict[str, Vector]:
        """Return the channels of a recording; those only that were measured."""
        return experiment_channels(self._table[: self.rows], *self._motion.at(self._first[: self.rows]), self._robot)


def raised_cosine(rows: int) -> Vector:
    """Return a smooth way from 0 to 1 over `rows` samples, (rows,), the last one 1."""
    return 0.5 - 0.5 * np.cos(math.pi * np.arange(1, rows + 1) / rows)
