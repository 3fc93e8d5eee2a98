"""Faults on the bus of a loop: copies of the signals that faults change, and their readers sent to the copies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, require_one_of, to_si
from softneck.robot import Robot
from softneck.runtime import Port

from ._faults import Fault, MotorFault, NeckFault, SensorFault, fault_label
from ._faults_runtime import FAULT_ADD, FAULT_DELAY, FAULT_DROPOUT, FAULT_FREEZE, FAULT_SLOW
from ._loop import Part
from ._wiring import BusSignal, Tap, Wiring, measured_names

_NECK = Robot.preset("neck")
# Kind of fault -> its action in the runtime; all other kinds add a value.
_ACTIONS = {
    "dropout": FAULT_DROPOUT, "freeze": FAULT_FREEZE, "stuck": FAULT_FREEZE, "delay": FAULT_DELAY, "slow": FAULT_SLOW,
}  # fmt: skip
# Tolerance, as a share of a step, for a delay or an edge of a window that should be on a sample: rounding of k * step.
_SAME_TIME = 1e-6
# Row of a time without end, and of any beyond it.
_LAST_ROW = 2.0**62


class ActiveFault:
    """One fault with its positions on the bus.

    `what`: its action, see `_faults_runtime`. `slots`, `flags`: positions of its signals, and of their validity flags.
    `first`, `last`: rows of its window. `lag`: number of rows in its memory.
    """

    def __init__(self, fault: Fault, slots: list[int], flags: list[int], scale: Vector, step: float) -> None:
        """Prepare `fault` for a loop with this `step` [s]; `scale` (n,) converts SI to the unit of each signal."""
        self.fault, self.slots, self.flags = fault, slots, flags
        self.first, self.last = (
            math.ceil(min(time / step, _LAST_ROW) - _SAME_TIME) for time in (fault.start, fault.start + fault.duration)
        )
        self._scale, self._step = scale, step
        kind = "add" if isinstance(fault, NeckFault) else fault.kind
        self.what, self.drawn = _ACTIONS.get(kind, FAULT_ADD), kind in ("noise", "outlier")
        self.lag = _lag(fault, step) or 1
        # A normal variable beyond this, of either sign, is an outlier: the given share of the samples.
        self._outlier_quantile = (
            NormalDist().inv_cdf(1.0 - 0.5 * getattr(fault, "share", 0.0)) if kind == "outlier" else 0.0
        )

    def amounts(self, first: int, stop: int) -> np.ndarray:
        """Return what the fault adds at rows `first` to `stop`: (rows, n), or (n,) where it is always the same."""
        fault = self.fault
        if isinstance(fault, NeckFault):
            return self._scale * np.array(list(fault.values.values()))
        size = self._scale * (fault.std if fault.kind == "noise" and isinstance(fault, SensorFault) else fault.size)
        if not self.drawn:
            return size
        rows = _normal_rows(getattr(fault, "seed"), first, stop, len(self.slots))  # noqa: B009
        if fault.kind == "noise":
            return size * rows
        return np.where(np.abs(rows) > self._outlier_quantile, size * np.sign(rows), 0.0)

    @property
    def most(self) -> Vector:
        """The largest move of a slow motor in one step (n,)."""
        return self._scale * getattr(self.fault, "rate", 0.0) * self._step


# Loops of a search and of its certificates have the same few seeds.
@lru_cache(maxsize=32)
def _normal_rows(seed: int, first: int, stop: int, count: int) -> Matrix:
    """Return the normal draws (rows, count); each row depends on seed and row alone, so that there is no state."""
    return np.array([np.random.default_rng([seed, k]).standard_normal(count) for k in range(first, stop)])


class FaultStages:
    """All faults of a loop as `_faults_runtime` reads them: `lists` for interpreted, `arrays` for compiled rows."""

    def __init__(
        self, detours: Sequence[list[int]], sensors: Sequence[ActiveFault], plant: Sequence[ActiveFault], rows: int
    ) -> None:
        """Lay out the faults of outputs (`sensors`) and inputs (`plant`); `detours` as from `_FaultRouting`."""
        self._acting = (*sensors, *plant)
        codes, slots, spans, held = [], [], [], 0
        for i, acting in enumerate(self._acting):
            place, begin, end = int(i >= len(sensors)), len(slots), len(slots) + len(acting.slots)
            slots += [*acting.slots, *acting.flags]
            window = (acting.first, acting.last)
            codes.append([place, acting.what, *window, begin, end, len(slots), held, acting.lag])
            spans.append(slice(begin, end))
            held += acting.lag * (end - begin)
        memory, most = np.zeros(held), np.zeros(len(slots))
        adding = [pair for pair in zip(self._acting, spans, strict=True) if pair[0].what == FAULT_ADD]
        self._added = np.zeros((rows if adding else 0, len(slots)))
        self._drawn = [pair for pair in adding if pair[0].drawn]
        for acting, span in zip(self._acting, spans, strict=True):
            most[span] = acting.most
        for acting, span in adding:
            if not acting.drawn:
                self._added[acting.first : acting.last, span] = acting.amounts(0, 0)
        numbers = (most, self._added, memory)
        self.lists = (tuple(detours), codes, slots, *numbers)
        table = np.array(codes, dtype=np.int64).reshape(-1, 9)
        whole = tuple(np.array(places, dtype=np.int64) for places in (*detours, slots))
        self.arrays = (whole[:4], table, whole[4], *numbers)

    def draw(self, first: int, stop: int) -> None:
        """Draw the random values of rows `first` to `stop`."""
        for acting, span in self._drawn:
            start, end = max(first, acting.first), min(stop, acting.last)
            if start < end:
                self._added[start:end, span] = acting.amounts(start, end)


def place_faults(
    faults: Sequence[Fault], wiring: Wiring, parts: Mapping[str, Part], *, step: float, rows: int, robot: Robot = _NECK
) -> tuple[Wiring, FaultStages]:
    """Return the wiring with the copies that `faults` change, and the faults laid out for `rows` rows of `step` [s]."""
    detours = _FaultRouting(wiring, measured_names(robot))
    sensors, plant = [], []
    for fault in faults:
        if isinstance(fault, SensorFault):
            names = sensor_outputs(fault, parts["plant"], robot)
            slots = [detours.of_output(name) for name in names]
            has_flag = any(port.name == "measurement_valid" for port in parts["plant"].outputs)
            flags = [detours.of_output("measurement_valid")] if fault.kind == "dropout" and has_flag else []
            sensors.append(ActiveFault(fault, slots, flags, _scales(parts["plant"].outputs, names, fault), step))
        else:
            names = _plant_inputs(fault, parts["plant"], robot)
            slots = [detours.of_input(name) for name in names]
            plant.append(ActiveFault(fault, slots, [], _scales(parts["plant"].inputs, names, fault), step))
    return detours.wiring(), FaultStages(detours.places(), sensors, plant, rows)


def sensor_outputs(fault: SensorFault, plant: Part, robot: Robot = _NECK) -> tuple[str, ...]:
    """Return the plant's outputs that a sensor fault acts on."""
    known = {port.name for port in plant.outputs}
    require_one_of("axis", fault.axis, (*robot.outputs.names, "both"))
    axes = robot.outputs.names if fault.axis == "both" else (fault.axis,)
    names = fault.signals or tuple(f"{axis}_measured" if f"{axis}_measured" in known else axis for axis in axes)
    for name in names:
        if name not in known:
            raise SettingsError(f"the {fault_label(fault)} acts on `{name}`, which is not an output of the plant.")
    return names


def _plant_inputs(fault: MotorFault | NeckFault, plant: Part, robot: Robot) -> tuple[str, ...]:
    if isinstance(fault, MotorFault):
        if fault.motor > len(robot.set_points):
            count = len(robot.set_points)
            raise SettingsError(f"the {fault_label(fault)} is of motor {fault.motor}; {robot.label()} has {count}.")
        return (robot.set_points[fault.motor - 1],) if fault.motor else robot.set_points
    known = [port.name for port in plant.inputs]
    for name in fault.values:
        if name not in known:
            listed = ", ".join(known)
            raise SettingsError(f"the {fault_label(fault)} needs the plant's input `{name}`; the plant has {listed}.")
    return tuple(fault.values)


def _scales(ports: Sequence[Port], names: Sequence[str], fault: Fault) -> Vector:
    """Return the factors (n,) from SI to the unit of each signal; a plant from another tool may measure in degrees."""
    units = {port.name: port.unit for port in ports}
    factors = []
    for name in names:
        try:
            factors.append(1.0 / to_si(units[name] or "1")[0])
        except DataError as error:
            raise SettingsError(f"the {fault_label(fault)} acts on `{name}`: {error}") from error
    return np.array(factors)


def _lag(fault: Fault, step: float) -> int:
    if not isinstance(fault, SensorFault) or fault.kind != "delay":
        return 0
    lag = round(fault.delay / step)
    if lag < 1 or abs(fault.delay / step - lag) > _SAME_TIME * lag:
        raise SettingsError(f"the sensor delay of {fault.delay:g} s is not a multiple of the loop's step {step:g} s.")
    return lag


class _FaultRouting:
    """Adds positions on the bus for signals that faults change, and lets the other parts read them."""

    def __init__(self, wiring: Wiring, measured: tuple[str, ...]) -> None:
        self._wiring, self._measured = wiring, measured
        self._start = wiring.start.tolist()
        self._named = list(wiring.named)
        self._taps = dict(wiring.taps)
        self._outputs: dict[str, tuple[int, int]] = {}
        self._inputs: dict[str, tuple[int, int]] = {}

    def of_output(self, name: str) -> int:
        """Return the position where all parts but the plant itself read the plant's output `name`."""
        if name not in self._outputs:
            old, port = next((n.slot, n.port) for n in self._named if n.part == "plant" and n.port.name == name)
            new = self._add(old, "sensor", replace(port, name=f"{name}_measured" if name in self._measured else name))
            for part, tap in self._taps.items():
                if part != "plant":
                    self._taps[part] = _redirect(tap, old, new, fragile=not port.boolean)
            self._outputs[name] = (old, new)
        return self._outputs[name][1]

    def of_input(self, name: str) -> int:
        """Return the position that the plant's input `name` now reads."""
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

    def places(self) -> list[list[int]]:
        """Return the positions of outputs and of their copies, then of inputs and their copies."""
        return [[pair[i] for pair in table.values()] for table in (self._outputs, self._inputs) for i in (0, 1)]


def _redirect(tap: Tap, old: int, new: int, *, fragile: bool) -> Tap:
    hit = np.flatnonzero(tap.slots == old)
    if not hit.size:
        return tap
    slots = tap.slots.copy()
    slots[hit] = new
    weak = set(tap.fragile.tolist())
    if fragile:
        weak |= {int(i) for i in hit if not tap.ports[i].missing}
    return replace(tap, slots=slots, fragile=np.array(sorted(weak), dtype=np.intp))
