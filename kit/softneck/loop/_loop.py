"""The closed loop: reference, observer, controller and plant stepped in one of two orders."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, require_one_of, require_positive

from ._part import Part
from ._references import Reference
from ._result import LoopResult
from ._wiring import Wiring, wire

ORDERS = ("sequential", "jacobi")
# Ratio of two sample times that should be whole; 1e-6 allows 0.02 / 0.01 in binary and nothing else.
_RATIO_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Loop:
    """A closed loop.

    Attributes:
        plant, controller, observer: the parts; without an observer the controller sees the measured angles.
        reference: called with the time [s], returns pitch [rad], roll [rad], co-contraction [rad].
        duration: [s].
        order: "sequential" (as on the hardware: plant outputs at t_k, observer, controller, plant) or "jacobi"
            (all inputs first, then all steps: one sample more in the observer and one in the controller).
        plant_parameters, observer_parameters, controller_parameters: other values by name.
        plant_inputs: constants for plant inputs such as `payload`.
    """

    plant: Part
    controller: Part
    reference: Reference
    duration: float
    observer: Part | None = None
    order: str = "sequential"
    plant_parameters: Mapping[str, float] = field(default_factory=dict)
    observer_parameters: Mapping[str, float] = field(default_factory=dict)
    controller_parameters: Mapping[str, float] = field(default_factory=dict)
    plant_inputs: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_positive("duration", self.duration, "s")
        require_one_of("order", self.order, ORDERS)

    @property
    def parts(self) -> dict[str, Part]:
        """Return name -> part in the order of a cycle: plant, observer (if any), controller."""
        if self.observer is None:
            return {"plant": self.plant, "controller": self.controller}
        return {"plant": self.plant, "observer": self.observer, "controller": self.controller}


def run_loop(loop: Loop, report: Callable[[float], None] | None = None) -> LoopResult:
    """Run `loop` from t = 0 and return its signals, one row for each sample of the fastest part.

    Args:
        loop: what to run.
        report: called now and then with the done fraction, 0 to 1.

    Raises:
        SettingsError: sample times that do not divide, inputs without a source.
        DataError: a part returned NaN or infinity; the message names part, variable and time.
    """
    step, ratios = _schedule(loop.parts)
    wiring = wire(loop.parts, loop.plant_inputs)
    rows = max(1, round(loop.duration / step))
    cycle = _Cycle(loop, wiring, step, ratios)
    try:
        cycle.start()
        table = np.empty((rows, wiring.start.size))
        stride = max(1, rows // 100)
        advance = cycle.sequential if loop.order == "sequential" else cycle.jacobi
        for k in range(rows):
            advance(k, table)
            if report is not None and (k + 1) % stride == 0:
                report((k + 1) / rows)
    finally:
        for part in loop.parts.values():
            part.close()
    return _result(wiring, table, step)


class _Cycle:
    """One run: the bus, and the plant's outputs that are computed but not yet valid."""

    def __init__(self, loop: Loop, wiring: Wiring, step: float, ratios: Mapping[str, int]) -> None:
        self.loop, self.parts, self.wiring = loop, loop.parts, wiring
        self.step, self.ratios = step, ratios
        self.bus = wiring.start.copy()
        self.pending = np.zeros(0)
        # Where NaN means "not measured" and is no fault.
        self.gaps = {name: np.array([p.missing for p in part.outputs], dtype=bool) for name, part in self.parts.items()}

    def start(self) -> None:
        loop = self.loop
        parameters = {
            "plant": loop.plant_parameters,
            "observer": loop.observer_parameters,
            "controller": loop.controller_parameters,
        }
        for name, part in self.parts.items():
            outputs = self._checked(name, part.start(0.0, parameters[name]), 0.0)
            self.bus[self.wiring.spans[name]] = outputs
        self.pending = self.bus[self.wiring.spans["plant"]].copy()

    def sequential(self, k: int, table: Matrix) -> None:
        """Read the plant at t_k, step observer, then controller, then plant."""
        time = self._arrive(k)
        for name in self.parts:
            if name != "plant" and k % self.ratios[name] == 0:
                self.bus[self.wiring.spans[name]] = self._advance(name, time)
        table[k] = self.bus
        if k % self.ratios["plant"] == 0:
            self.pending = self._advance("plant", time)

    def jacobi(self, k: int, table: Matrix) -> None:
        """Set the inputs of all from what is on the bus at t_k, step all; the outputs are seen at t_k+1."""
        time = self._arrive(k)
        table[k] = self.bus
        due = [name for name in self.parts if k % self.ratios[name] == 0]
        outputs = {name: self._advance(name, time) for name in due}
        self.pending = outputs.pop("plant", self.pending)
        for name, values in outputs.items():
            self.bus[self.wiring.spans[name]] = values

    def _arrive(self, k: int) -> float:
        """Put on the bus what becomes valid at t_k: the plant's outputs and the reference."""
        time = k * self.step
        if k % self.ratios["plant"] == 0:
            self.bus[self.wiring.spans["plant"]] = self.pending
        reference = np.array([*self.loop.reference(time), 1.0])
        if not np.isfinite(reference).all():
            raise DataError(f"the reference is {reference[:3].tolist()} at t = {time:g} s; it must be finite.")
        self.bus[self.wiring.spans["reference"]] = reference
        return time

    def _advance(self, name: str, time: float) -> Vector:
        inputs = self.wiring.taps[name].read(self.bus, time)
        return self._checked(name, self.parts[name].advance(time, inputs), time)

    def _checked(self, name: str, outputs: Vector, time: float) -> Vector:
        bad = ~np.isfinite(outputs)
        if bad.any():
            bad &= ~(self.gaps[name] & np.isnan(outputs))
            if bad.any():
                i = int(np.argmax(bad))
                variable = self.parts[name].outputs[i].name
                raise DataError(f"output `{variable}` of the {name} became {outputs[i]} in the step at t = {time:g} s.")
        return outputs


def _schedule(parts: Mapping[str, Part]) -> tuple[float, dict[str, int]]:
    """Return the base step [s] (the shortest sample time) and each part's multiple of it."""
    step = min(part.sample_time for part in parts.values())
    ratios = {}
    for name, part in parts.items():
        ratio = part.sample_time / step
        if not math.isclose(ratio, round(ratio), rel_tol=_RATIO_TOLERANCE):
            listed = ", ".join(f"{other} {item.sample_time:g} s" for other, item in parts.items())
            raise SettingsError(f"the sample times do not divide: {listed}; each must be a multiple of the shortest.")
        ratios[name] = round(ratio)
    return step, ratios


def _result(wiring: Wiring, table: Matrix, step: float) -> LoopResult:
    signals, units = {}, {}
    for i, (part, port) in enumerate(wiring.ports):
        name = _signal_name(part, port.name, signals)
        signals[name], units[name] = table[:, i].copy(), port.unit
    return LoopResult(np.arange(len(table)) * step, signals, units, step)


def _signal_name(part: str, name: str, taken: Mapping[str, Vector]) -> str:
    if part == "observer" and name not in ("innovation", "healthy"):
        return f"{name}_estimate"
    return name if name not in taken else f"{part}_{name}"
