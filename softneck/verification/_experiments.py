"""Margins by experiment: raise gain or delay of a simulated loop until it oscillates, per axis and jointly.

Gain and delay act on the control error. The loop moves to a posture and gets a step of its reference. An oscillation
is sustained if it is as large in the last window as in the one before, and larger than at gain 1. Only the first
crossing is bisected, as stability need not be monotone in the gain.
Times and sizes are those of the neck, scaled to the robot; postures lie around the middle of its outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any, ClassVar

import numpy as np

from softneck.core import DataError, Progress, Vector, side_by_side, silent
from softneck.loop import BlockPart, Loop, LoopResult, Part, error_unit, run_loop
from softneck.robot import Robot
from softneck.runtime import Block, Port

from ._steps import middle_motors, middle_of

_LOOP_GAIN_RUNTIME = "softneck.verification._louder_runtime"
_NECK = Robot.preset()
_BUFFER_SAMPLES = 34
# The experiment [s]: time to reach the posture, time of the step, a transient, and each of two windows.
LEAD_IN_S, REST_S, _TRANSIENT_S, _WINDOW_S = 1.0, 3.0, 2.0, 4.0
# Steps and lean of a posture, within reach of every neck with a payload.
_SMALL_RAD, _LARGE_RAD = math.radians(1.0), math.radians(8.0)
_LEAN_RAD = math.radians(5.0)
_ALL_AXES = "both"
# Unit of the scanned delays.
_NECK_SAMPLE_TIME_S = 0.02
# Sustained: at least this ratio of the last window to the one before, or a swing above that of an undamped step;
# and above this share of the step, and this multiple of the motion at gain 1.
_SUSTAINED_RATIO, _AUDIBLE_SHARE, _ABOVE_FLOOR = 0.97, 0.1, 2.0
# With a lower gain friction delays the axes and they move each other by less than the step.
_AUDIBLE_SHARE_DOWN = 1.0
# Largest limit cycle by friction at gain 1, peak to peak.
_HUNTING_RAD = math.radians(1.0)
# Shares of the step: smallest response of a loop, and smallest limit cycle that is reported.
_RESPONSE_SHARE, _REPORTED_SHARE = 1e-3, 0.01
# Scanned factors on the gain and samples of delay, and the relative tolerance of the bisection.
GAIN_SCAN = tuple(2.0 ** (k / 4.0) for k in range(1, 17))
_COARSE_GAINS = tuple(2.0 ** (k / 2.0) for k in range(1, 9))
DELAY_SCAN = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
_BISECTION_TOLERANCE = 0.005
# Peak to peak over the step: a linear loop at its stability limit swings by two, and more with overshoot.
_MAX_SWING = 3.0
# Scans whose end a crossing bounds: a gain margin is the smaller of both directions.
_BOUNDED_SCANS = {"gain_up": ("gain_up", "gain_down"), "delay": ("delay",)}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopUnderTest:
    """A loop for margins by experiment.

    Attributes:
        name: of the plant.
        plant: returns a new part.
        controller, observer: blocks.
        order: of the loop.
        constants: `plant_inputs` or `plant_parameters` of its `Loop`, such as a payload.
        compiled: as one function if all parts are blocks: ten seconds once, then a tenth of the time per run.
        axes: whose gain or delay is raised.
        robot: of the loop.
        time, size: time scale of the robot, and output in SI per rad of the neck.
        noise: of the sensor over the neck's, in the unit of `size`.
    """

    name: str
    plant: Callable[[], Part]
    controller: Block
    observer: Block | None = None
    order: str = "sequential"
    constants: Mapping[str, Any] = field(default_factory=dict)
    compiled: bool = True
    axes: tuple[str, ...] = ("pitch", "roll", "both")
    robot: Robot = _NECK
    time: float = 1.0
    size: float = 1.0
    noise: float = 1.0

    @property
    def kicks(self) -> tuple[float, ...]:
        """Steps of the reference, small before large, above the sensor noise."""
        large = self.size * _LARGE_RAD
        return tuple(dict.fromkeys((min(max(self.size, self.noise) * _SMALL_RAD, large), large)))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.robot.outputs.names

    @property
    def samples(self) -> int:
        """Samples per unit of the scanned delays."""
        return max(1, round(self.time * _NECK_SAMPLE_TIME_S / self.controller.sample_time))

    def postures(self) -> tuple[tuple[float, ...], ...]:
        """Return the postures, in rad of the neck: upright, and leaning to either side."""
        rest = (0.0,) * (len(self.outputs) - 1)
        return ((0.0, *rest), (_LEAN_RAD, *rest), (*rest, -_LEAN_RAD))


@dataclass(frozen=True, slots=True)
class Crossing:
    """The first crossing of one scan; [rad] is the SI unit of the outputs.

    Attributes:
        plant: its name.
        axes: name of an axis, or "both" for all.
        what: "gain_up", "gain_down" or "delay".
        amplitude: of the step [rad].
        posture: outputs [rad] relative to their middle.
        value: factor on the gain (above 1 in both directions) or delay [s]; inf where none was found.
        hunts: limit cycle at gain 1, peak to peak [rad]; inf if the loop diverges or does not respond to the step.
        robot: of the outputs.
    """

    plant: str
    axes: str
    what: str
    amplitude: float
    posture: tuple[float, ...]
    value: float
    hunts: float
    robot: Robot = _NECK


def crossings(loops: Sequence[LoopUnderTest], *, overall: bool = False, progress: Progress = silent) -> list[Crossing]:
    """Return the crossings of every loop over axes, gain and delay, step size and posture.

    A scan ends at the crossing of an earlier one of the same plant, axes and kind, and then gives inf. `loops`: over
    each plant. `overall`: find only the smallest gain and delay margin of all loops: the last loop with all axes at
    once, the hardest test, bounds the scans of all others, which take every other step. `progress`: called now and
    then.
    """
    kinds = ("gain_up", "gain_down", "delay")
    groups = [(loop, axes, what) for loop in loops for axes in loop.axes for what in kinds]
    # The first run compiles the loop, once instead of in every thread.
    leaders = groups[:1]
    if overall:
        last = loops[-1]
        leaders = [job for job in groups if job[0] is last and job[1] == last.axes[-1] and job[2] in _BOUNDED_SCANS]
    others = [job for job in groups if job not in leaders]
    least: dict[str, float] = dict.fromkeys(kinds, math.inf)
    done = 0

    def group(job: tuple[LoopUnderTest, str, str]) -> list[Crossing]:
        nonlocal done
        found = _scan_group(*job, least[job[2]])
        done += 1
        progress(done / len(groups), f"{job[0].name}: {job[2].replace('_', ' ')} of {job[1]}")
        return found

    first = [found for job in leaders for found in group(job)]
    if overall:
        least |= {
            kind: min(x.value for x in first if x.what == by) for by, led in _BOUNDED_SCANS.items() for kind in led
        }
    return first + [found for part in side_by_side([partial(group, job) for job in others]) for found in part]


def _scan_group(loop: LoopUnderTest, axes: str, what: str, least: float) -> list[Crossing]:
    """Return the crossings of one kind; scans end at `least` or at an earlier crossing."""
    found: list[Crossing] = []
    sparse = math.isfinite(least)
    # A posture changes the gain of a plant, not whether a loop is conditionally stable.
    postures = loop.postures()[:1] if what == "gain_down" else loop.postures()
    for lean, amplitude in product(postures, loop.kicks):
        posture = tuple(loop.size * angle for angle in lean)
        case = Experiment(loop, axes, what, amplitude, posture)
        none = 1.0 if what != "delay" else 0.0
        if least <= none:
            break  # no smaller value exists
        floor, value = case.floor(), none
        if case.comes_to_rest(floor):
            value = _first_crossing(case, floor, least, sparse)
        hunts = floor if floor > _REPORTED_SHARE * amplitude else 0.0
        found.append(Crossing(loop.name, axes, what, amplitude, posture, value, hunts, loop.robot))
        least = min(least, value)
    return found


def _first_crossing(case: Experiment, floor: float, least: float, sparse: bool) -> float:
    """Return the smallest scanned value with an oscillation, bisected; inf if there is none below `least`."""
    calm = 0.0 if case.what == "delay" else 1.0
    for scanned in _scan_values(case, sparse):
        value = min(scanned, least)
        if case.oscillates(value, floor):
            return bisect(case, calm, value, floor)
        if value >= least:
            break
        calm = value
    return math.inf


def _scan_values(case: Experiment, sparse: bool) -> Iterator[float]:
    if case.what == "delay":
        unit = case.loop.samples * case.sample_time
        yield from (samples * unit for samples in (DELAY_SCAN[1::2] if sparse else DELAY_SCAN))
    else:
        # Down to a quarter: a loop with an unstable plant fails before, others never.
        yield from _COARSE_GAINS[:4] if case.what == "gain_down" else _COARSE_GAINS if sparse else GAIN_SCAN


def bisect(case: Experiment, calm: float, loud: float, floor: float) -> float:
    """Return the largest value without oscillation between a calm and an oscillating one."""
    if case.what == "delay":
        while loud - calm > max(_BISECTION_TOLERANCE * loud, 0.02 * case.sample_time):
            middle = 0.5 * (calm + loud)
            calm, loud = (calm, middle) if case.oscillates(middle, floor) else (middle, loud)
        return calm
    while loud / calm > 1.0 + _BISECTION_TOLERANCE:
        middle = math.sqrt(calm * loud)
        calm, loud = (calm, middle) if case.oscillates(middle, floor) else (middle, loud)
    return calm


@dataclass(frozen=True, slots=True)
class Experiment:
    """One scan: axes, raised quantity, step and posture."""

    loop: LoopUnderTest
    axes: str
    what: str
    amplitude: float
    posture: tuple[float, ...]

    @property
    def sample_time(self) -> float:
        """Sample time [s]."""
        return self.loop.controller.sample_time

    def floor(self) -> float:
        """Return the final motion at gain 1, peak to peak [rad]; inf if the loop does not respond."""
        return self._windows(1.0, 0.0)[1]

    def comes_to_rest(self, floor: float) -> bool:
        """Return whether a loop with this final motion at gain 1 has a margin that can be found."""
        return floor <= self.loop.size * _HUNTING_RAD

    def oscillates(self, value: float, floor: float) -> bool:
        """Return whether the oscillation is sustained at a gain, its reciprocal, or a delay [s]."""
        return self.try_at(value, floor)[0]

    def try_at(self, value: float, floor: float) -> tuple[bool, float]:
        """Return whether the oscillation is sustained, and its swing in the last window [rad]."""
        gain = {"gain_up": value, "gain_down": 1.0 / value, "delay": 1.0}[self.what]
        before, last = self._windows(gain, value / self.sample_time if self.what == "delay" else 0.0)
        sustained = last >= _SUSTAINED_RATIO * before or last >= _MAX_SWING * self.amplitude
        heard = (_AUDIBLE_SHARE_DOWN if self.what == "gain_down" else _AUDIBLE_SHARE) * self.amplitude
        return sustained and last > max(heard, _ABOVE_FLOOR * floor), last

    def _windows(self, gain: float, delay: float) -> tuple[float, float]:
        """Return the largest oscillation [rad] in the last two windows."""
        try:
            result = self._run(gain, delay)
        except DataError:  # numbers overflowed
            return 0.0, math.inf
        rows = round(_WINDOW_S * self.loop.time / result.sample_time)
        angles = np.stack([result[name] for name in self.loop.outputs])
        if not np.isfinite(angles).all():
            return 0.0, math.inf  # an output that a plant did not tell is not calm
        kicked = angles[:, result.time >= self.loop.time * REST_S]
        if (gain, delay) == (1.0, 0.0) and np.ptp(kicked, axis=1).max() <= _RESPONSE_SHARE * self.amplitude:
            return 0.0, math.inf  # no response, such as with motors at their limits: no margin can be found
        parts = angles[:, -2 * rows : -rows], angles[:, -rows:]
        before, last = (max(_oscillation(angle, _MAX_SWING * self.amplitude) for angle in part) for part in parts)
        return before, last

    def _run(self, gain: float, delay: float) -> LoopResult:
        loop = self.loop
        chosen = [self.axes in (axis, _ALL_AXES) for axis in loop.outputs]
        parameters = {f"gain_{axis}": gain if on else 1.0 for axis, on in zip(loop.outputs, chosen, strict=True)}
        parameters |= {f"delay_{axis}": delay if on else 0.0 for axis, on in zip(loop.outputs, chosen, strict=True)}
        block, connections, wanted = scale_loop_gain(loop.controller, loop.observer, loop.outputs, loop.samples)
        # Step towards upright, so that no neck leaves its reach.
        kick = np.array([-self.amplitude if p > 0.0 else self.amplitude for p in self.posture]) * chosen
        posture = tuple(float(a + b) for a, b in zip(middle_of(loop.robot), self.posture, strict=True))
        middle = float(middle_motors(loop.robot, loop.controller).mean())
        return run_loop(
            Loop(
                plant=loop.plant(), controller=BlockPart(loop.controller),
                observer=None if loop.observer is None else BlockPart(loop.observer),
                reference=_Kicked(posture, tuple(float(v) for v in kick), loop.time, middle), robot=loop.robot,
                duration=loop.time * (REST_S + _TRANSIENT_S + 2.0 * _WINDOW_S), order=loop.order,
                **loop.constants, other_parameters={"louder": parameters},
                others={"louder": BlockPart(block)}, connections=connections,
                other_inputs={"louder": wanted},
            ),
            compiled=loop.compiled,
        )  # fmt: skip


def _oscillation(angle: Vector, away: float) -> float:
    """Return the oscillation of an angle (time,): the smaller of largest rise and fall, as creep is none.

    A motion of at least `away` counts in full.
    """
    far = float(np.ptp(angle))
    rise = float((angle - np.minimum.accumulate(angle)).max())
    fall = float((np.maximum.accumulate(angle) - angle).max())
    return far if far >= away else min(rise, fall)


def smooth_rise(time: float, seconds: float) -> float:
    """Return the part of a motion from 0 to 1 in `seconds` that is done at `time` [s]."""
    return 0.5 - 0.5 * math.cos(math.pi * min(1.0, time / seconds))


@dataclass(frozen=True, slots=True)
class _Kicked:
    """A smooth motion to a posture, then a step."""

    posture: tuple[float, ...]
    kick: tuple[float, ...]
    slower: float = 1.0
    together: float = 0.0
    repeats: ClassVar[bool] = True  # equal ones have equal samples: `run_loop` keeps them

    def __call__(self, time: float) -> tuple[float, ...]:
        led = smooth_rise(time / self.slower, LEAD_IN_S)
        on = float(time >= self.slower * REST_S)
        return *(
            led * there + on * away for there, away in zip(self.posture, self.kick, strict=True)
        ), led * self.together


@lru_cache(maxsize=16)
def scale_loop_gain(
    controller: Block, observer: Block | None, outputs: tuple[str, ...] = _NECK.outputs.names, samples: int = 1
) -> tuple[Block, dict[str, str], dict[str, float]]:
    """Return a block after the sensor that scales the loop gain or adds delay, its connections and constants.

    `samples` is the number of samples per unit of delay.
    """
    reader, role = (controller, "controller") if observer is None else (observer, "observer")
    kept = (_BUFFER_SAMPLES - 2) * samples + 2
    names = [f"{axis}{what}" for what in ("", "_rate") for axis in outputs]
    seen = {name: name if observer is None else f"{name}_measured" for name in names}
    ports = {port.name: port for port in reader.inputs}
    read = [name for name in names if seen[name] in ports]
    used = [ports[seen[name]] for name in read]
    inputs = [Port(name=f"{name}_measured", unit=p.unit, missing=p.missing) for name, p in zip(read, used, strict=True)]
    references = [
        Port(name=f"{name}_reference", unit=ports[seen[name]].unit) if name in outputs else Port(name=f"{name}_wanted")
        for name in read
    ]
    block = Block(
        kind="louder", role="filter", runtime=_LOOP_GAIN_RUNTIME, sample_time=controller.sample_time,
        arrays=(np.array([float(outputs.index(name.removesuffix("_rate"))) for name in read]), np.array([float(kept)])),  # pyright: ignore[reportArgumentType]
        inputs=(*inputs, *references),
        outputs=tuple(replace(p, name=f"{p.name}_{what}") for what in ("seen", "without_noise") for p in inputs),
        parameters=(
            *(Port(name=f"gain_{axis}", start=1.0, minimum=0.0) for axis in outputs),
            *(Port(name=f"delay_{axis}", minimum=0.0, maximum=kept - 2.0) for axis in outputs),
            *(Port(name=f"share_{axis}", minimum=0.0) for axis in outputs),
            Port(name="keep", minimum=0.0, maximum=1.0), Port(name="noise", minimum=0.0),
            Port(name="noise_seed", integer=True),
        ),
    )  # fmt: skip
    connections = {f"{role}.{seen[name]}": f"louder.{name}_measured_seen" for name in read}
    # At rest, where these loops end, the reference of a rate is zero.
    wanted = {port.name: 0.0 for port in references if port.name.endswith("_wanted")}
    return block, connections | connections_without_preview(controller), wanted


def connections_without_preview(controller: Block) -> dict[str, str]:
    """Return connections by which a predictive controller sees the present reference as the future one."""
    names = [port.name for port in controller.inputs if port.name.endswith("_reference_ahead")]
    return {f"controller.{name}": f"reference.{name.removesuffix('_ahead')}" for name in names}


def crossing_facts(item: Crossing) -> dict[str, Any]:
    """Return the facts on a crossing as JSON values."""
    unit, factor = error_unit(item.robot)
    per = math.radians(1.0) if factor is None else factor
    name = item.plant
    if item.hunts == math.inf:  # motors at their limits, for one
        at = ", ".join(f"{(a + b) / per:.3g}" for a, b in zip(middle_of(item.robot), item.posture, strict=True))
        name += f" diverges or does not respond around {at} {unit} (`rest` of outputs and motors)"
    return {
        "kind": "experiment", "name": name, "axis": item.axes, "raised": item.what,
        f"kick_{unit}": item.amplitude / per, f"posture_{unit}": [x / per for x in item.posture],
        f"hunts_{unit}": item.hunts / per,
    }  # fmt: skip


def crossing_values(found: Sequence[Crossing]) -> dict[str, tuple[Vector, list[Crossing]]]:
    """Return gain and delay margins [ms]: metric -> values and their crossings."""
    table: dict[str, tuple[Vector, list[Crossing]]] = {}
    for name, kinds, factor in (("gain_margin", ("gain_up", "gain_down"), 1.0), ("delay_margin_ms", ("delay",), 1e3)):
        names = found[0].robot.outputs.names if found else ()
        for group, axes in (*((axis, (axis,)) for axis in names), ("axes", (*names, _ALL_AXES))):
            chosen = [item for item in found if item.what in kinds and item.axes in axes]
            if chosen:
                table[f"{group}.{name}"] = (factor * np.array([item.value for item in chosen]), chosen)
    return table
