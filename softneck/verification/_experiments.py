"""Margins by experiment: the loop over a plant is made louder or later until it oscillates, axis by axis and jointly.

Gain and delay act on the error between what is measured and the reference. The loop is led to a posture, kicked, and
listened to: what is still as large in the last window as in the one before, and above what the loop does at gain 1, is
sustained. Only the first crossing is bisected: stability need not be monotone in the gain.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from softneck.core import DataError, Progress, Vector, silent
from softneck.loop import BlockPart, Loop, LoopResult, Part, run_loop
from softneck.runtime import Block, Port

_RUNTIME = "softneck.verification._louder_runtime"
_KEPT = 34
# The experiment [s]: led there, at rest, kicked; a moment that does not count, and two windows.
_LED, _REST, _FORGOTTEN, _WINDOW = 1.0, 3.0, 2.0, 4.0
# Kicks [rad], small before large, and postures (pitch, roll) [rad]: within what every neck can lean under a payload.
_SMALL, _LARGE = math.radians(1.0), math.radians(8.0)
_LEAN = math.radians(5.0)
_POSTURES = ((0.0, 0.0), (_LEAN, 0.0), (0.0, -_LEAN))
# Sustained: the last window has this part of the one before, so what decays by less counts as if it did not; above this
# part of the kick, and this many times what the loop does at gain 1.
_KEEPS, _HEARD, _ABOVE_FLOOR = 0.97, 0.01, 2.0
# At gain 1 a loop may hunt by friction; by more than this [rad] peak to peak it oscillates.
_HUNTS = math.radians(1.0)
# What is scanned: factors on the gain, up and down, and samples of delay; and to which part a crossing is bisected.
_GAINS = tuple(2.0 ** (k / 4.0) for k in range(1, 17))
_COARSE_GAINS = tuple(2.0 ** (k / 2.0) for k in range(1, 9))
_DELAYS = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
_FINE = 0.005


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopUnderTest:
    """What is closed around a plant.

    Attributes:
        name: of the plant.
        plant: returns a new part.
        controller, observer: blocks.
        order: of the loop.
        inputs: constants of the plant, such as `payload`.
        compiled: as one function where all parts are blocks; that takes some ten seconds once, and each run a tenth.
    """

    name: str
    plant: Callable[[], Part]
    controller: Block
    observer: Block | None = None
    order: str = "sequential"
    inputs: Mapping[str, float] | None = None
    compiled: bool = True


@dataclass(frozen=True, slots=True)
class Crossing:
    """The first crossing of one scan.

    Attributes:
        plant: its name.
        axes: "pitch", "roll" or "both".
        what: "gain_up", "gain_down" or "delay".
        amplitude: of the kick [rad].
        posture: (pitch, roll) [rad].
        value: the factor on the gain (above 1 in both ways), or the delay [s]; inf where none was found.
        hunts: peak to peak at gain 1 [rad], where the loop does not come to rest.
    """

    plant: str
    axes: str
    what: str
    amplitude: float
    posture: tuple[float, float]
    value: float
    hunts: float


def crossings(loops: Sequence[LoopUnderTest], *, coarse: bool = False, progress: Progress = silent) -> list[Crossing]:
    """Return the crossings of every loop: each axis and both, up, down and later, small and large, leaning and not.

    A scan ends where an earlier one of the same plant, axes and kind has crossed: only the least is looked for, and
    later ones say inf there.

    Args:
        loops: over each plant.
        coarse: one posture, both axes at once, coarse gains, nothing bisected: the last value without oscillation.
        progress: called now and then.
    """
    axes = ("both",) if coarse else ("pitch", "roll", "both")
    groups = list(product(loops, axes, ("gain_up", "gain_down", "delay")))
    done = 0

    def group(job: tuple[LoopUnderTest, str, str]) -> list[Crossing]:
        nonlocal done
        found = _group(*job, coarse)
        done += 1
        progress(done / len(groups), f"{job[0].name}: {job[2].replace('_', ' ')} of {job[1]}")
        return found

    # The first compiles the loop; several threads would do that several times.
    first = [found for job in groups[:1] for found in group(job)]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return first + [found for part in pool.map(group, groups[1:]) for found in part]


def _group(loop: LoopUnderTest, axes: str, what: str, coarse: bool) -> list[Crossing]:
    found: list[Crossing] = []
    least = math.inf
    for posture, amplitude in product(_POSTURES[:1] if coarse else _POSTURES, (_SMALL, _LARGE)):
        case = _Case(loop, axes, what, amplitude, posture)
        floor = case.floor()
        value = 1.0 if what != "delay" else 0.0
        if floor <= _HUNTS:
            value = _first_crossing(case, floor, least, coarse)
        hunts = floor if floor > _HEARD * amplitude else 0.0
        found.append(Crossing(loop.name, axes, what, amplitude, posture, value, hunts))
        least = min(least, value)
    return found


def _first_crossing(case: _Case, floor: float, least: float, coarse: bool) -> float:
    """Return the least value scanned at which the loop oscillates, bisected; inf where none below `least` does."""
    calm = 0.0 if case.what == "delay" else 1.0
    for value in _scanned(case, coarse):
        if calm >= least:
            return math.inf
        if case.oscillates(value, floor):
            return calm if coarse else _bisected(case, calm, value, floor)
        calm = value
    return math.inf


def _scanned(case: _Case, coarse: bool) -> Iterator[float]:
    if case.what == "delay":
        yield from (samples * case.sample_time for samples in _DELAYS)
    else:
        yield from _COARSE_GAINS if coarse or case.what == "gain_down" else _GAINS


def _bisected(case: _Case, calm: float, loud: float, floor: float) -> float:
    """Return the largest value found without oscillation between a calm one and a loud one."""
    if case.what == "delay":
        while loud - calm > max(_FINE * loud, 0.02 * case.sample_time):
            middle = 0.5 * (calm + loud)
            calm, loud = (calm, middle) if case.oscillates(middle, floor) else (middle, loud)
        return calm
    while loud / calm > 1.0 + _FINE:
        middle = math.sqrt(calm * loud)
        calm, loud = (calm, middle) if case.oscillates(middle, floor) else (middle, loud)
    return calm


@dataclass(frozen=True, slots=True)
class _Case:
    """One scan: which axes, what is raised, how hard the loop is kicked, and where."""

    loop: LoopUnderTest
    axes: str
    what: str
    amplitude: float
    posture: tuple[float, float]

    @property
    def sample_time(self) -> float:
        """[s]."""
        return self.loop.controller.sample_time

    def floor(self) -> float:
        """Return what the loop does at gain 1 and without delay, peak to peak at the end [rad]."""
        return self._windows(1.0, 0.0)[1]

    def oscillates(self, value: float, floor: float) -> bool:
        """Return whether the loop goes on moving at a gain, its reciprocal, or a delay [s]."""
        gain = {"gain_up": value, "gain_down": 1.0 / value, "delay": 1.0}[self.what]
        before, last = self._windows(gain, value / self.sample_time if self.what == "delay" else 0.0)
        return last >= _KEEPS * before and last > max(_HEARD * self.amplitude, _ABOVE_FLOOR * floor)

    def _windows(self, gain: float, delay: float) -> tuple[float, float]:
        """Return the largest motion, peak to peak [rad], in the last window but one and in the last."""
        try:
            result = self._run(gain, delay)
        except DataError:  # numbers overflowed
            return 0.0, math.inf
        rows = round(_WINDOW / result.sample_time)
        angles = np.stack([result["pitch"], result["roll"]])
        parts = angles[:, -2 * rows : -rows], angles[:, -rows:]
        before, last = (float(np.ptp(part, axis=1).max()) for part in parts)
        return before, last

    def _run(self, gain: float, delay: float) -> LoopResult:
        chosen = [self.axes in (axis, "both") for axis in ("pitch", "roll")]
        parameters = {f"gain_{axis}": gain if on else 1.0 for axis, on in zip(("pitch", "roll"), chosen, strict=True)}
        parameters |= {
            f"delay_{axis}": delay if on else 0.0 for axis, on in zip(("pitch", "roll"), chosen, strict=True)
        }
        block, connections = louder(self.loop.controller, self.loop.observer)
        # Towards upright: no neck is led further than its posture.
        kick = np.array([-self.amplitude if p > 0.0 else self.amplitude for p in self.posture]) * chosen
        loop = self.loop
        return run_loop(
            Loop(
                plant=loop.plant(), controller=BlockPart(loop.controller),
                observer=None if loop.observer is None else BlockPart(loop.observer),
                reference=_Kicked(self.posture, (float(kick[0]), float(kick[1]))),
                duration=_REST + _FORGOTTEN + 2.0 * _WINDOW, order=loop.order, plant_inputs=dict(loop.inputs or {}),
                others={"louder": BlockPart(block)}, other_parameters={"louder": parameters}, connections=connections,
                # A rate has no reference: it is wanted to be zero.
                other_inputs={"louder": {p.name: 0.0 for p in block.inputs if p.name.endswith("_wanted")}},
            ),
            compiled=loop.compiled,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Kicked:
    """A posture that is reached smoothly, and a step away from it."""

    posture: tuple[float, float]
    kick: tuple[float, float]

    def __call__(self, time: float) -> tuple[float, ...]:
        led = 0.5 - 0.5 * math.cos(math.pi * min(1.0, time / _LED))
        on = float(time >= _REST)
        return led * self.posture[0] + on * self.kick[0], led * self.posture[1] + on * self.kick[1], 0.0


def louder(controller: Block, observer: Block | None) -> tuple[Block, dict[str, str]]:
    """Return what makes a loop louder or later, and its connections: it stands behind the sensor.

    Args:
        controller: sees the observer's angles, or without one those of the sensor.
        observer: sees the sensor.
    """
    reader, role = (controller, "controller") if observer is None else (observer, "observer")
    names = [f"{axis}{what}" for what in ("", "_rate") for axis in ("pitch", "roll")]
    seen = {name: name if observer is None else f"{name}_measured" for name in names}
    ports = {port.name: port for port in reader.inputs}
    read = [name for name in names if seen[name] in ports]
    missing = [ports[seen[name]].missing for name in read]
    inputs = [
        Port(name=f"{name}_measured", unit=ports[seen[name]].unit, missing=gone)
        for name, gone in zip(read, missing, strict=True)
    ]
    references = [
        Port(name=f"{name}_reference", unit="rad") if name in ("pitch", "roll") else Port(name=f"{name}_wanted")
        for name in read
    ]
    block = Block(
        kind="louder", role="filter", runtime=_RUNTIME, sample_time=controller.sample_time,
        arrays=(np.array([float(name.startswith("roll")) for name in read]), np.array([float(_KEPT)])),  # pyright: ignore[reportArgumentType]
        inputs=(*inputs, *references),
        outputs=tuple(replace(port, name=f"{port.name}_seen") for port in inputs),
        parameters=(
            *(Port(name=f"gain_{axis}", start=1.0, minimum=0.0) for axis in ("pitch", "roll")),
            *(Port(name=f"delay_{axis}", minimum=0.0, maximum=_KEPT - 2.0) for axis in ("pitch", "roll")),
        ),
    )  # fmt: skip
    connections = {f"{role}.{seen[name]}": f"louder.{name}_measured_seen" for name in read}
    # Nobody knows the kick before it comes.
    connections |= {
        f"controller.{port.name}": f"reference.{port.name.removesuffix('_ahead')}"
        for port in controller.inputs
        if port.name.endswith("_reference_ahead")
    }
    return block, connections


def crossing_facts(item: Crossing) -> dict[str, Any]:
    """Return a crossing as JSON values."""
    return {
        "kind": "experiment", "name": item.plant, "axis": item.axes, "raised": item.what,
        "kick_deg": math.degrees(item.amplitude), "posture_deg": [math.degrees(x) for x in item.posture],
        "hunts_deg": math.degrees(item.hunts),
    }  # fmt: skip


def crossing_values(found: Sequence[Crossing]) -> dict[str, tuple[Vector, list[Crossing]]]:
    """Return metric -> values and the crossings behind them: gain margins, and delay margins [ms]."""
    table: dict[str, tuple[Vector, list[Crossing]]] = {}
    for name, kinds, factor in (("gain_margin", ("gain_up", "gain_down"), 1.0), ("delay_margin_ms", ("delay",), 1e3)):
        for group, axes in (("pitch", ("pitch",)), ("roll", ("roll",)), ("axes", ("pitch", "roll", "both"))):
            chosen = [item for item in found if item.what in kinds and item.axes in axes]
            if chosen:
                table[f"{group}.{name}"] = (factor * np.array([item.value for item in chosen]), chosen)
    return table
