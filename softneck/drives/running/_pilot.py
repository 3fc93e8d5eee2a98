"""Observer, controller and reference of a loop as the master's pilot: the same parts, wiring, and cycle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.loop import Loop, LoopResult, LoopRows, row_actions, wire
from softneck.loop._rows_runtime import ROWS_RECORD, ROWS_REFER, ROWS_SHOW, ROWS_STEP
from softneck.robot import Robot
from softneck.signals import NECK, require_same_robot

from ..bus._link import VirtualLink
from ..bus._robot import count_word
from ..logs._result import signal_units
from ..logs._rows import Rows, columns_of, experiment_channels, truths
from ..master import Frame, Master, Phase
from ..master._gate import Reading, sample_of
from ..master._master import Measurement, Motors

if TYPE_CHECKING:
    from ._bus_loop import Session

# Nothing is recorded here: the master's log does that.
_NO_TABLE = np.zeros((0, 0))


class LoopPilot:
    """The parts of a loop but its plant, which is hardware here.

    Attributes:
        robot: whose motors and outputs they are.
    """

    def __init__(self, loop: Loop, robot: Robot = NECK) -> None:
        """Wire observer, controller and further parts as `softneck simulate` does; the plant gives ports only.

        Raises:
            DataError: the loop is of another robot.
            SettingsError: a Jacobi loop, sample times that differ, a plant without motor positions and angles.
        """
        if loop.order != "sequential":
            raise SettingsError('drives run in the order "sequential"; the loop has order = "jacobi".')
        self._loop, self._parts, self.robot = loop, loop.parts, robot
        steps = {name: part.sample_time for name, part in self._parts.items()}
        if max(steps.values()) > min(steps.values()) * (1.0 + 1e-6):
            listed = ", ".join(f"{name} {step:g} s" for name, step in steps.items())
            raise SettingsError(f"on drives all parts of a loop need one sample time; it has {listed}.")
        self.sample_time = loop.controller.sample_time
        require_same_robot(robot, loop.robot, "loop and drives")
        wiring = wire(self._parts, loop.constants, loop.connections, loop.robot)
        self._wiring = wiring
        # As in a simulation, but that the plant is hardware, and the reference is not known ahead.
        actions = row_actions(
            self._parts, wiring.taps, dict.fromkeys(self._parts, 1), order=loop.order, disturbed=False
        )
        self._plant = tuple(self._parts).index("plant")
        self._cycle = [
            (ROWS_SHOW if what == ROWS_REFER else what, part, every)
            for what, part, every in actions
            if what != ROWS_RECORD and (what, part) != (ROWS_STEP, self._plant)
        ]
        self._places = {port.name: i for i, port in enumerate(loop.plant.outputs)}
        names = [port.name for port in loop.controller.outputs]
        try:
            first = wiring.spans["controller"].start
            self._chosen = np.array([first + names.index(name) for name in robot.set_points])
        except ValueError as error:
            word = count_word(len(robot.set_points))
            raise SettingsError(f"the controller does not give {word} motor set-points: {', '.join(names)}.") from error
        # Where the plant would say each output and each rate, by their number in a sample.
        outputs = [*robot.outputs.names, *(f"{name}_rate" for name in robot.outputs.names)]
        self._tilts = [(i, self._places[f"{name}{end}"]) for i, name in enumerate(outputs) for end in ("_measured", "")
                       if f"{name}{end}" in self._places]  # fmt: skip
        self._rows = round(loop.duration / self.sample_time)
        self._running = self._start_rows({})
        self._asked = [self.slot("reference", f"{name}_reference") for name in robot.outputs.names]

    def start(self) -> None:
        """Start all parts but the plant."""
        parameters = self._loop.parameters
        others = {name: part for name, part in self._parts.items() if name != "plant"}
        self._running = self._start_rows({n: part.start(0.0, parameters.get(n, {})) for n, part in others.items()})

    def _start_rows(self, starts: Mapping[str, Vector]) -> LoopRows:
        # What is no number is the master's to judge: it stops the drives where set-points become so.
        return LoopRows(self._parts, self._wiring, self._cycle, step=self.sample_time, starts=starts, checked=False)

    def warm(self) -> None:
        """Step all parts once at rest, so that compilation and loading happen before a run."""
        self.start()
        rest = sample_of((0.0,) * len(self.robot.outputs.names))
        self.step(Measurement(0, rest, True, (0.0,) * len(self.robot.motors.names)))

    def step(self, measured: Measurement) -> Motors | None:
        """Step observer and controller with the new measurements."""
        running, index = self._running, measured.index
        self._measure(measured, running.held[self._plant])
        if "reference" not in self._parts:
            running.held[-1][:-1] = self._loop.reference(index * self.sample_time)  # pyright: ignore[reportCallIssue]
        problem, part = running.run(index, index + 1, _NO_TABLE)
        if problem:
            self._wiring.taps[running.names[part]].read(running.bus, index * self.sample_time)
        set_points = running.bus[self._chosen]
        return tuple(set_points.tolist())

    def is_finished(self, index: int) -> bool:
        """Return whether the loop's duration is over."""
        return index >= self._rows

    def close(self) -> None:
        """Release the parts."""
        self._loop.close()

    def slot(self, part: str, port: str) -> int | None:
        """Return the index of a signal in `signals`."""
        for item in self._wiring.named:
            if item.part == part and item.port.name == port:
                return item.slot
        return None

    @property
    def reference(self) -> tuple[float, ...]:
        """References of the outputs at the last step [rad]."""
        return tuple(math.nan if slot is None else float(self._running.bus[slot]) for slot in self._asked)

    @property
    def signals(self) -> Vector:
        """All signals of the last step, at the places that `slot` tells."""
        return self._running.bus

    def _measure(self, measured: Measurement, outputs: Vector) -> None:
        """Write the measurements to the plant's `outputs`."""
        places = self._places
        said = (*measured.tilt.values, *measured.tilt.rates)
        for i, place in self._tilts:
            outputs[place] = said[i] if math.isfinite(said[i]) else 0.0
        for name, position in zip(self.robot.motor_positions, measured.positions, strict=True):
            place = places.get(name)
            if place is not None:
                outputs[place] = position
        place = places.get("measurement_valid")
        if place is not None:
            outputs[place] = 1.0 if measured.fresh else 0.0


class RunLog:
    """Collects one row for each sample while the controller runs."""

    def __init__(self, pilot: LoopPilot, *, truth: bool, folder: Path | None = None) -> None:
        """Prepare the columns, with those of simulated drives where `truth`; rows are kept on disk in `folder`."""
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
        true = (*pilot.robot.outputs.names, *truths(pilot.robot))
        self._truths = () if not truth else true if pilot.robot.neck is not None else true[:-1]
        self._names = self._column_names()
        self._rows = Rows(len(self._names), len(pilot.robot.motors.names), folder)
        self._index = -1

    def take(self, now: float, master: Master, truth: Mapping[str, float] | None) -> dict[str, float] | None:
        """Take the cycle at `now` [s]; add the row of its sample, once, and return it by name."""
        self._rows.take(now, master.positions)
        if not master.ran or master.index <= self._index:
            return None
        self._index = master.index
        signals = self._pilot.signals
        row = [float(signals[place]) for place in self._places.values()]
        tilt = master.tilt
        row += [*master.positions, *master.tensions]
        nothing = [math.nan] * (2 * len(self._robot.outputs.names))
        row += nothing if tilt is None else [*tilt.values, *tilt.rates]
        if truth is not None:
            row += [truth.get(name, math.nan) for name in self._truths]
        self._rows.add(row)
        return dict(zip(self._names, row, strict=True))

    def _column_names(self) -> list[str]:
        robot = self._robot
        names = [*self._places, *robot.motor_positions]
        names += [f"tension_estimate_{j}" for j in range(1, len(robot.motors.names) + 1)]
        names += [f"{name}{what}_measured" for what in ("", "_rate") for name in robot.outputs.names]
        return [*names, *self._truths]

    def finish(self, sample_time: float) -> tuple[LoopResult, Matrix, tuple[str, ...]]:
        """Return all rows, the motors' speeds at them, (rows, motors) [rad/s], and notes on the disk."""
        table, _, speeds = self._rows.finish()
        signals = dict(zip(self._names, table.T, strict=True))
        time = np.arange(len(table)) * sample_time
        units = signal_units(self._names)
        return LoopResult(time, signals, units, sample_time, self._robot), speeds, self._rows.notes()


class SignalPilot:
    """Plays set-points (rows, motors) [rad], one row each sample."""

    def __init__(self, set_points: Matrix) -> None:
        """Play `set_points` from the first row on."""
        self._rows = np.asarray(set_points, dtype=np.float64)

    def start(self) -> None:
        """Do nothing: there is no state between samples."""

    def step(self, measured: Measurement) -> Motors | None:
        """Return the set-points of this sample."""
        return tuple(self._rows[measured.index].tolist())

    def is_finished(self, index: int) -> bool:
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
        self._planned, self._run = rows, run
        self._log = None if session is None else session.log
        self._rows = Rows(len(self._names), self._motors, None if session is None else session.folder)
        self._row: list[float] = []
        link = None if session is None else session.link
        self._truth = link.neck.truth if isinstance(link, VirtualLink) else None
        self._cycles = 0
        self._complete = False
        self.index = -1

    def __call__(
        self, now: float, frames_in: Sequence[Frame], frames_out: Sequence[Frame], tilt: Reading | None,
        master: Master,
    ) -> None:  # fmt: skip
        """Store the measurements and set-points of this cycle."""
        del frames_in, frames_out
        self._rows.take(now, master.positions)
        if master.supervisor.phase is not Phase.RUNNING or master.index >= self._planned:
            return
        if master.index != self.index:
            self.index, self._cycles = master.index, 0
            self._row = self._rows.add([math.nan] * len(self._names))
            self._measure(self._row, tilt, master)
        self._cycles += 1
        self._complete = self._cycles == master.settings.sample_cycles
        self._row[: self._motors] = master.setpoints
        if self._complete and self._log is not None:
            row = dict(zip(self._names, self._row, strict=False))  # without what later cycles tell
            self._log.signals({**row, "run": 1.0 if self._run is None else float(self._run[self.index])})

    def _measure(self, row: list[float], tilt: Reading | None, master: Master) -> None:
        known = self._motors + 2 * self._outputs
        if tilt is not None and master.tilt is tilt:
            row[self._motors : known] = (*tilt.values, *tilt.rates)
        if self._truth is None:
            row[known : known + self._motors] = master.tensions
        else:
            truth = self._truth()
            row[known : len(self._names)] = [truth.get(name, math.nan) for name in self._names[known:]]

    @property
    def rows(self) -> int:
        """Samples whose set-points were sent to their end."""
        return self.index + 1 if self._complete or self.index < 0 else self.index

    def finish(self) -> tuple[dict[str, Vector], tuple[str, ...]]:
        """Return the channels of a recording, those only that were measured, and notes on the disk."""
        table, positions, speeds = (part[: self.rows] for part in self._rows.finish())
        return experiment_channels(table, positions, speeds, self._robot), self._rows.notes()


def raised_cosine(rows: int) -> Vector:
    """Return a smooth way from 0 to 1 over `rows` samples, (rows,), the last one 1."""
    return 0.5 - 0.5 * np.cos(math.pi * np.arange(1, rows + 1) / rows)
