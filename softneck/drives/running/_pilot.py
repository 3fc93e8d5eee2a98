"""Observer, controller and reference of a loop as the master's pilot: the same parts, wired and ordered the same."""

from __future__ import annotations

import math

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.loop import Loop
from softneck.loop._order import step_order
from softneck.loop._wiring import wire

from ..master import Tilt
from ..master._measured import Measurement

_ANGLES = ("pitch", "roll", "pitch_rate", "roll_rate")


class LoopPilot:
    """The parts of a loop but its plant, which is hardware here.

    Attributes:
        columns: names of what `row` returns.
    """

    def __init__(self, loop: Loop) -> None:
        """Wire observer, controller and further parts as `softneck simulate` does; the plant gives ports only.

        Raises:
            SettingsError: a Jacobi loop, sample times that differ, a plant without motor positions and angles.
        """
        if loop.order != "sequential":
            raise SettingsError('drives run in the order "sequential"; the loop has order = "jacobi".')
        self._loop, self._parts = loop, loop.parts
        steps = {name: part.sample_time for name, part in self._parts.items()}
        if max(steps.values()) > min(steps.values()) * (1.0 + 1e-6):
            listed = ", ".join(f"{name} {step:g} s" for name, step in steps.items())
            raise SettingsError(f"on drives all parts of a loop need one sample time; it has {listed}.")
        self.sample_time = loop.controller.sample_time
        wiring = wire(self._parts, loop.constants, loop.connections)
        self._wiring, self._order = wiring, step_order(self._parts, wiring.taps)
        self._late_reference = "reference" in self._parts
        span = wiring.spans["plant"]
        self._places = {port.name: span.start + i for i, port in enumerate(loop.plant.outputs)}
        self._setpoints = wiring.spans["controller"]
        names = [port.name for port in loop.controller.outputs]
        try:
            self._chosen = np.array([self._setpoints.start + names.index(f"motor_setpoint_{j}") for j in (1, 2, 3)])
        except ValueError as error:
            raise SettingsError(f"the controller does not give three motor set-points: {', '.join(names)}.") from error
        self._tilts = [(name, self._places[f"{name}{end}"]) for name in _ANGLES for end in ("_measured", "")
                       if f"{name}{end}" in self._places]  # fmt: skip
        self._rows = round(loop.duration / self.sample_time)
        self._bus: Vector = wiring.start.copy()
        self._next_reference: Vector | None = None
        self._started = False
        self.columns = tuple(dict.fromkeys(f"{item.part}.{item.port.name}" for item in wiring.named))

    def start(self) -> None:
        """Start all parts but the plant."""
        self._bus = self._wiring.start.copy()
        for name, part in self._parts.items():
            if name != "plant":
                outputs = part.start(0.0, self._loop.parameters.get(name, {}))
                self._bus[self._wiring.spans[name]] = outputs
                if name == "reference":
                    self._next_reference = outputs
        self._started = True

    def warm(self) -> None:
        """Step all parts once with the neck at rest: what compiles or loads at its first call does so before a run."""
        self.start()
        self.step(Measurement(0, Tilt(0.0, 0.0), True, (0.0, 0.0, 0.0)))

    def step(self, measured: Measurement) -> tuple[float, float, float] | None:
        """Step observer and controller with what was measured now."""
        time = measured.index * self.sample_time
        bus = self._bus
        self._measure(measured)
        self._refer(time)
        for name in self._order:
            bus[self._wiring.spans[name]] = self._parts[name].advance(time, self._wiring.taps[name].read(bus, time))
        if self._late_reference:
            tap = self._wiring.taps["reference"]
            self._next_reference = self._parts["reference"].advance(time, tap.read(bus, time))
        a, b, c = bus[self._chosen].tolist()
        return a, b, c

    def finished(self, index: int) -> bool:
        """Return whether the loop's duration is over."""
        return index >= self._rows

    def close(self) -> None:
        """Release the parts."""
        self._started = False
        self._loop.close()

    def value(self, name: str) -> float:
        """Return a signal `part.port` as it is now; NaN where the loop has none."""
        part, _, port = name.partition(".")
        for item in self._wiring.named:
            if item.part == part and item.port.name == port:
                return float(self._bus[item.slot])
        return math.nan

    def slot(self, part: str, port: str) -> int | None:
        """Return where a signal lies in `signals`."""
        for item in self._wiring.named:
            if item.part == part and item.port.name == port:
                return item.slot
        return None

    @property
    def signals(self) -> Vector:
        """All signals of the last step, at the places that `slot` tells."""
        return self._bus

    def _measure(self, measured: Measurement) -> None:
        tilt, bus, places = measured.tilt, self._bus, self._places
        for name, place in self._tilts:
            value = getattr(tilt, name)
            bus[place] = value if math.isfinite(value) else 0.0
        for j in (1, 2, 3):
            place = places.get(f"motor_position_{j}")
            if place is not None:
                bus[place] = measured.positions[j - 1]
        place = places.get("measurement_valid")
        if place is not None:
            bus[place] = 1.0 if measured.fresh else 0.0

    def _refer(self, time: float) -> None:
        span = self._wiring.spans["reference"]
        if self._next_reference is not None:
            self._bus[span] = self._next_reference
            return
        reference = self._loop.reference
        pitch, roll, common = reference(time)  # pyright: ignore[reportCallIssue]
        self._bus[span] = (pitch, roll, common, 1.0)
