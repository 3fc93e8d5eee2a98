"""Faults at work: detours of signals on the bus, and what happens on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from softneck.core import DataError, SettingsError, Vector, to_si
from softneck.runtime import Port

from ._faults import AXES, Fault, MotorFault, NeckFault, SensorFault, with_kind
from ._part import Part
from ._wiring import BusSignal, Tap, Wiring

# Share of a step by which a delay or the edge of a window may miss a sample: rounding of k * step.
_SAME_TIME = 1e-6


class ActiveFault:
    """One fault on its places of the bus.

    Attributes:
        memory: what it remembers between steps, for `LoopState`.
        what: it does: the fault's kind, "add" for a disturbance.
        slots, flags: positions of its signals, and of those of validity.
        first, last: rows of its window.
    """

    def __init__(self, fault: Fault, slots: list[int], flags: list[int], scale: Vector, step: float) -> None:
        """Prepare `fault` on the bus positions `slots`, with `flags` those of validity.

        Args:
            fault: what to do.
            slots: (n,) positions of its signals.
            flags: positions that a dropout sets to zero.
            scale: (n,) SI to the unit of each signal.
            step: of the loop [s].
        """
        self.fault, self.slots, self.flags = fault, np.array(slots, dtype=np.intp), np.array(flags, dtype=np.intp)
        self.first = math.ceil(fault.start / step - _SAME_TIME)
        end = fault.start + fault.duration
        self.last = math.ceil(end / step - _SAME_TIME) if math.isfinite(end) else 2**62
        self._scale, self._step = scale, step
        self.what = "add" if isinstance(fault, NeckFault) else fault.kind
        self._act = getattr(self, f"_{self.what}")
        self._lag = _lag(fault, step)
        self.memory = np.zeros(((self._lag or 1), len(slots)))
        # The two tails of a normal variable: a share of the samples, of either sign.
        self._far = NormalDist().inv_cdf(1.0 - 0.5 * getattr(fault, "share", 0.0)) if self.what == "outlier" else 0.0

    def apply(self, bus: Vector, k: int) -> None:
        """Change the bus at row `k` if the fault is on; remember what it needs in any case."""
        self._act(bus, k, self.first <= k < self.last)

    def _dropout(self, bus: Vector, k: int, on: bool) -> None:  # noqa: ARG002
        if on:
            bus[self.slots] = np.nan
            bus[self.flags] = 0.0

    def _freeze(self, bus: Vector, k: int, on: bool) -> None:
        # At the very first row there is nothing before: that row's own value stays.
        if on and k > 0:
            bus[self.slots] = self.memory[0]
        else:
            self.memory[0] = bus[self.slots]

    _stuck = _freeze

    def _bias(self, bus: Vector, k: int, on: bool) -> None:
        if on:
            bus[self.slots] += self.amount(k)

    _offset = _noise = _outlier = _add = _bias

    def _delay(self, bus: Vector, k: int, on: bool) -> None:
        now = bus[self.slots]
        if k == 0:
            self.memory[:] = now
        old = self.memory[k % self._lag].copy()
        self.memory[k % self._lag] = now
        if on:
            bus[self.slots] = old

    def _slow(self, bus: Vector, k: int, on: bool) -> None:
        wanted = bus[self.slots]
        if on and k > 0:
            wanted = self.memory[0] + np.clip(wanted - self.memory[0], -self.most, self.most)
            bus[self.slots] = wanted
        self.memory[0] = wanted

    def amount(self, k: int) -> Vector:
        """Return what is added at row `k` (n,): bias, offset and disturbance, noise, outliers; zero for the others."""
        fault = self.fault
        if isinstance(fault, NeckFault):
            return self._scale * np.array(list(fault.values.values()))
        if fault.kind in ("bias", "offset"):
            return self._scale * fault.size
        if fault.kind == "noise" and isinstance(fault, SensorFault):
            return self._scale * fault.std * self._draws(k)
        if fault.kind == "outlier":
            draw = self._draws(k)
            return np.where(np.abs(draw) > self._far, self._scale * fault.size * np.sign(draw), 0.0)
        return np.zeros(self.slots.size)

    @property
    def most(self) -> Vector:
        """How far a slow motor gets in one step (n,)."""
        return self._scale * getattr(self.fault, "rate", 0.0) * self._step

    def _draws(self, k: int) -> Vector:
        """Return the normal draws (n,) of row `k`: a function of seed and row, so that nothing must be remembered."""
        return np.random.default_rng([getattr(self.fault, "seed"), k]).standard_normal(self.slots.size)  # noqa: B009


@dataclass(frozen=True, slots=True, eq=False)
class FaultStages:
    """Detours and faults, in the two places of a cycle where they act.

    Attributes:
        sensor_from, sensor_to: positions of the plant's outputs and of their faulty copies.
        plant_from, plant_to: the same of what the plant reads.
        sensors, plant: the faults there, in the file's order.
    """

    sensor_from: np.ndarray
    sensor_to: np.ndarray
    plant_from: np.ndarray
    plant_to: np.ndarray
    sensors: tuple[ActiveFault, ...]
    plant: tuple[ActiveFault, ...]

    def sense(self, bus: Vector, k: int) -> None:
        """Pass the plant's outputs on to their readers."""
        bus[self.sensor_to] = bus[self.sensor_from]
        for acting in self.sensors:
            acting.apply(bus, k)

    def actuate(self, bus: Vector, k: int) -> None:
        """Pass on to the plant what drives and disturbs it."""
        bus[self.plant_to] = bus[self.plant_from]
        for acting in self.plant:
            acting.apply(bus, k)


def place_faults(
    faults: Sequence[Fault], wiring: Wiring, parts: Mapping[str, Part], step: float
) -> tuple[Wiring, FaultStages]:
    """Put `faults` between the parts and return the wiring with their detours.

    Raises:
        SettingsError: the plant lacks what a fault acts on, or a delay is not a multiple of the step.
    """
    detours = _FaultRouting(wiring)
    sensors, plant = [], []
    for fault in faults:
        if isinstance(fault, SensorFault):
            names = sensor_outputs(fault, parts["plant"])
            slots = [detours.of_output(name) for name in names]
            flags = [detours.of_output("measurement_valid")] if _drops(fault, parts["plant"]) else []
            sensors.append(ActiveFault(fault, slots, flags, _scales(parts["plant"].outputs, names, fault), step))
        else:
            names = _plant_inputs(fault, parts["plant"])
            slots = [detours.of_input(name) for name in names]
            plant.append(ActiveFault(fault, slots, [], _scales(parts["plant"].inputs, names, fault), step))
    return detours.wiring(), detours.stages(sensors, plant)


def sensor_outputs(fault: SensorFault, plant: Part) -> tuple[str, ...]:
    """Return the plant's outputs that a sensor fault acts on."""
    known = {port.name for port in plant.outputs}
    names = fault.signals or tuple(
        f"{axis}_measured" if f"{axis}_measured" in known else axis for axis in AXES[fault.axis]
    )
    for name in names:
        if name not in known:
            raise SettingsError(f"the {with_kind(fault)} acts on `{name}`, which is not an output of the plant.")
    return names


def _drops(fault: SensorFault, plant: Part) -> bool:
    return fault.kind == "dropout" and any(port.name == "measurement_valid" for port in plant.outputs)


def _plant_inputs(fault: MotorFault | NeckFault, plant: Part) -> tuple[str, ...]:
    if isinstance(fault, MotorFault):
        return tuple(f"motor_setpoint_{j}" for j in ((fault.motor,) if fault.motor else (1, 2, 3)))
    known = [port.name for port in plant.inputs]
    for name in fault.values:
        if name not in known:
            raise SettingsError(
                f"the {with_kind(fault)} needs the plant's input `{name}`; this plant's inputs are {', '.join(known)}."
            )
    return tuple(fault.values)


def _scales(ports: Sequence[Port], names: Sequence[str], fault: Fault) -> Vector:
    """Return (n,) the factors from SI to the unit of each signal; a foreign plant may measure in degrees."""
    units = {port.name: port.unit for port in ports}
    factors = []
    for name in names:
        try:
            factors.append(1.0 / to_si(units[name] or "1")[0])
        except DataError as error:
            raise SettingsError(f"the {with_kind(fault)} acts on `{name}`: {error}") from error
    return np.array(factors)


def _lag(fault: Fault, step: float) -> int:
    if not isinstance(fault, SensorFault) or fault.kind != "delay":
        return 0
    lag = round(fault.delay / step)
    if lag < 1 or abs(fault.delay / step - lag) > _SAME_TIME * lag:
        raise SettingsError(f"the sensor delay of {fault.delay:g} s is not a multiple of the loop's step {step:g} s.")
    return lag


class _FaultRouting:
    """New places on the bus for signals that faults change, and readers sent there."""

    def __init__(self, wiring: Wiring) -> None:
        self._wiring = wiring
        self._start = wiring.start.tolist()
        self._named = list(wiring.named)
        self._taps = dict(wiring.taps)
        self._outputs: dict[str, tuple[int, int]] = {}
        self._inputs: dict[str, tuple[int, int]] = {}

    def of_output(self, name: str) -> int:
        """Return the place where all readers but the plant itself now find the plant's output `name`."""
        if name not in self._outputs:
            old, port = next((n.slot, n.port) for n in self._named if n.part == "plant" and n.port.name == name)
            new = self._add(old, "sensor", replace(port, name=_measured(name)))
            for part, tap in self._taps.items():
                if part != "plant":
                    self._taps[part] = _redirected(tap, old, new, fragile=not port.boolean)
            self._outputs[name] = (old, new)
        return self._outputs[name][1]

    def of_input(self, name: str) -> int:
        """Return the place that the plant's input `name` now reads."""
        if name not in self._inputs:
            tap = self._taps["plant"]
            i = tap.names.index(name)
            old, port = int(tap.slots[i]), next(port for port in tap.ports if port.name == name)
            shown = name.replace("setpoint", "setpoint_applied")
            new = self._add(old, "fault", replace(port, name=shown, missing=False))
            slots = tap.slots.copy()
            slots[i] = new
            self._taps["plant"] = replace(tap, slots=slots)
            self._inputs[name] = (old, new)
        return self._inputs[name][1]

    def _add(self, old: int, part: str, port: Port) -> int:
        self._start.append(self._start[old])
        self._named.append(BusSignal(len(self._start) - 1, part, port))
        return len(self._start) - 1

    def wiring(self) -> Wiring:
        """Return the wiring with the detours."""
        return replace(self._wiring, start=np.array(self._start), named=tuple(self._named), taps=self._taps)

    def stages(self, sensors: list[ActiveFault], plant: list[ActiveFault]) -> FaultStages:
        """Return the copies and the faults."""
        places = [
            np.array([pair[i] for pair in table.values()], dtype=np.intp)
            for table in (self._outputs, self._inputs)
            for i in (0, 1)
        ]
        return FaultStages(places[0], places[1], places[2], places[3], tuple(sensors), tuple(plant))


def _measured(name: str) -> str:
    """Return how a result names what the sensor says: a plant's `pitch` becomes `pitch_measured`."""
    return f"{name}_measured" if name in ("pitch", "roll", "pitch_rate", "roll_rate") else name


def _redirected(tap: Tap, old: int, new: int, *, fragile: bool) -> Tap:
    hit = np.flatnonzero(tap.slots == old)
    if not hit.size:
        return tap
    slots = tap.slots.copy()
    slots[hit] = new
    weak = set(tap.fragile.tolist())
    if fragile:
        weak |= {int(i) for i in hit if not tap.ports[i].missing}
    return replace(tap, slots=slots, fragile=np.array(sorted(weak), dtype=np.intp))
