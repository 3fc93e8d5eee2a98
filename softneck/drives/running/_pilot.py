"""Observer, controller and reference of a loop as the master's pilot: the same parts, wiring, and cycle."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.loop import Loop
from softneck.loop._rows import Rows, cycle
from softneck.loop._rows_runtime import ROWS_RECORD, ROWS_REFER, ROWS_SHOW, ROWS_STEP
from softneck.loop._wiring import wire
from softneck.robot import Robot
from softneck.signals.recording._channels import NECK
from softneck.signals.recording._recording import require_same_robot

from ..master._gate import sample_of
from ..master._measured import Measurement, Motors

# Nothing is recorded here: the master's log does that.
_NO_TABLE = np.zeros((0, 0))
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


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
        # As in a simulation, but that the plant is hardware, and nobody knows the reference's rows ahead.
        actions = cycle(self._parts, wiring.taps, dict.fromkeys(self._parts, 1), order=loop.order, disturbed=False)
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
            word = _NUMBERS[len(robot.set_points)]
            raise SettingsError(f"the controller does not give {word} motor set-points: {', '.join(names)}.") from error
        # Where the plant would say each output and each rate, by their number in a sample.
        outputs = [*robot.outputs.names, *(f"{name}_rate" for name in robot.outputs.names)]
        self._tilts = [(i, self._places[f"{name}{end}"]) for i, name in enumerate(outputs) for end in ("_measured", "")
                       if f"{name}{end}" in self._places]  # fmt: skip
        self._rows = round(loop.duration / self.sample_time)
        self._running = self._begun({})
        self._asked = [self.slot("reference", f"{name}_reference") for name in robot.outputs.names]

    def start(self) -> None:
        """Start all parts but the plant."""
        parameters = self._loop.parameters
        others = {name: part for name, part in self._parts.items() if name != "plant"}
        self._running = self._begun({n: part.start(0.0, parameters.get(n, {})) for n, part in others.items()})

    def _begun(self, starts: Mapping[str, Vector]) -> Rows:
        # What is no number is the master's to judge: it stops the drives where set-points become so.
        return Rows(self._parts, self._wiring, self._cycle, step=self.sample_time, starts=starts, checked=False)

    def warm(self) -> None:
        """Step all parts once with the neck at rest: what compiles or loads at its first call does so before a run."""
        self.start()
        rest = sample_of((0.0,) * len(self.robot.outputs.names))
        self.step(Measurement(0, rest, True, (0.0,) * len(self.robot.motors.names)))

    def step(self, measured: Measurement) -> Motors | None:
        """Step observer and controller with what was measured now."""
        running, index = self._running, measured.index
        self._measure(measured, running.held[self._plant])
        if "reference" not in self._parts:
            running.held[-1][:-1] = self._loop.reference(index * self.sample_time)  # pyright: ignore[reportCallIssue]
        problem, part = running.run(index, index + 1, _NO_TABLE)
        if problem:
            self._wiring.taps[running.names[part]].read(running.bus, index * self.sample_time)
        set_points = running.bus[self._chosen]
        return tuple(set_points.tolist())

    def finished(self, index: int) -> bool:
        """Return whether the loop's duration is over."""
        return index >= self._rows

    def close(self) -> None:
        """Release the parts."""
        self._loop.close()

    def slot(self, part: str, port: str) -> int | None:
        """Return where a signal lies in `signals`."""
        for item in self._wiring.named:
            if item.part == part and item.port.name == port:
                return item.slot
        return None

    @property
    def reference(self) -> tuple[float, ...]:
        """What the outputs were wanted to be at the last step [rad]."""
        return tuple(math.nan if slot is None else float(self._running.bus[slot]) for slot in self._asked)

    @property
    def signals(self) -> Vector:
        """All signals of the last step, at the places that `slot` tells."""
        return self._running.bus

    def _measure(self, measured: Measurement, outputs: Vector) -> None:
        """Write to the plant's `outputs` what hardware says."""
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
