"""Loops over the draws of a family: a controller holds if it holds on every draw, in every condition.

Of N plants drawn independently, none of which fails, a share of at least `d^(1/N)` holds with confidence 1 - d (Wilks
1941, Ann. Math. Stat. 12:91; Tempo, Calafiore and Dabbene 2013, Randomized Algorithms, sec. 8.3): 95 % with 95 % for
N = 59, 99 % for N = 299. At attempt k of several d is divided by k (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from softneck.core import DataError, Progress, Vector, compute_once, side_by_side, worst
from softneck.estimation import directions_of
from softneck.identification import Draws, Model
from softneck.loop import BlockPart, Loop, LoopResult, MotorFault, RobotReference, error_unit, run_loop, shows_settling
from softneck.robot import Robot
from softneck.runtime import Block

from ._experiments import DELAY_SCAN, GAIN_SCAN, Experiment, LoopUnderTest, bisect, scale_loop_gain
from ._neck_loops import (
    AroundMiddle,
    SimulationModel,
    direction,
    make_simulation_model,
    rows_of,
    step_metrics,
    step_time,
    without_lead,
)
from ._requirements import Requirements

_CONFIDENCE = 0.95
# Draws whose margin is searched beyond the required one: those that swing most at this multiple of it.
_BISECTED, _PROBED = 3, 2.0
# Steps may be so much larger than the largest recorded motion.
_BEYOND = 1.1
# Metric -> value and condition of every step of a draw.
_Steps: TypeAlias = dict[str, list[tuple[float, str]]]
_MARGINS = ("axes.gain_margin", "axes.delay_margin_ms")


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Results of the loops over the draws of one family.

    Attributes:
        family: its name.
        draws: of the family.
        attempt: whose draws these are, from 1 on; 0: those that a search may see.
        count: of draws that were run.
        values: metric -> (n,) of all loops that tell it; of margins those of the draws that swing most.
        conditions: metric -> draw and condition of each value.
        failed: numbers of the draws that fail a requirement.
        unreached: metric -> why the recordings do not support it, and what to record.
        noisy: whether the sensor's noise would hide settling, so that steps are judged without it.
    """

    family: str
    draws: Draws
    attempt: int
    count: int
    values: Mapping[str, Vector]
    conditions: Mapping[str, list[dict[str, Any]]]
    failed: tuple[int, ...]
    unreached: Mapping[str, str] = field(default_factory=dict)
    noisy: bool = False

    @property
    def content(self) -> float:
        """Share of such plants that holds with 95 % confidence; 0 if a draw fails."""
        return 0.0 if self.failed else certified_content(self.count, self.attempt)

    def worst(self, metric: str, *, largest: bool) -> int | None:
        """Return the number of the draw with the worst value of a metric; None if no loop tells it."""
        if metric not in self.values:
            return None
        values = np.nan_to_num(self.values[metric], nan=math.inf if largest else -math.inf)
        row = int(np.argmax(values) if largest else np.argmin(values))
        return self.conditions[metric][row]["draw"]

    def model(self, number: int) -> Model:
        """Return a draw."""
        return _models(self.draws, self.attempt)[number]

    def statement(self) -> str:
        """Return what the loops over the draws say."""
        quiet = "; steps are judged without the sensor's noise, which would hide settling" if self.noisy else ""
        if self.failed:
            doubt = f"; {self.draws.doubt}, so they decide little" if self.draws.doubt else ""
            return f"{len(self.failed)} of {self.count} draws of {self.family} fail{doubt}{quiet}"
        tries = "" if self.attempt == 1 else f" (attempt {self.attempt}, which is counted)"
        return (
            f"none of {self.count} draws of {self.family} fails: {100.0 * self.content:.1f} % of such plants hold, "
            f"with {100.0 * _CONFIDENCE:.0f} % confidence{tries}{quiet}"
        )

    def facts(self) -> dict[str, Any]:
        """Return what the certificate says of the draws."""
        return {
            "family": self.family, "count": self.count, "failed": list(self.failed), "attempt": self.attempt,
            "content": self.content, "confidence": _CONFIDENCE, "seed": self.draws.seed, "kind": self.draws.model.kind,
            "coverage": self.draws.coverage, "level": self.draws.level, "statement": self.statement(),
        }  # fmt: skip


def certified_content(count: int, attempt: int = 1) -> float:
    """Return the share of plants that holds with 95 % confidence if none of `count` draws fails at an attempt."""
    return ((1.0 - _CONFIDENCE) / attempt) ** (1.0 / count)


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What all draws share.

    plants: of the draws; limits: metric -> least margin, in its unit; amplitudes: of the steps of margins [SI].
    """

    controller: Block
    asked: Requirements
    order: str
    observer: Block | None
    draws: Draws
    plants: Sequence[SimulationModel]
    limits: Mapping[str, float]
    amplitudes: tuple[float, ...]
    motors: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Margin:
    """One experiment at a required margin: its swing there over the step, whether it oscillates, the swing beyond."""

    number: int
    metric: str
    experiment: Experiment
    floor: float
    limit: float
    swing: float
    oscillates: bool
    beyond: float = 0.0


def run_drawn(
    name: str, draws: Draws, controller: Block, asked: Requirements, *, order: str, observer: Block | None,
    attempt: int, progress: Progress,
) -> Drawn:  # fmt: skip
    """Run all loops over the draws of a family.

    Steps of every required direction at the lightest and the heaviest payload, with the disturbance of the draws, the
    sensor's noise (where it is too loud to show settling, in the loop alone), and a load after the step; and each
    required margin at three amplitudes. Of the draws that swing most there the margin itself is bisected. Attempt 0
    takes the draws that a search may see. Equal loops are run once in a process, as those of a controller that `tune`
    has verified.
    """
    limits = [(b.metric, b.bound, b.limit) for b in asked.bounds if b.metric.startswith("sim.") or b.metric in _MARGINS]

    def compute() -> Drawn:
        return _run_all(name, draws, controller, asked, order, observer, attempt, progress)

    found = compute_once(compute, name, draws, controller, asked.tables, limits, order, observer, attempt)
    size = asked.scale.si(float(asked.sim["size_deg"]))
    return replace(found, unreached=_unreached(draws, asked), noisy=not shows_settling(_noise(draws, asked), size))


def run_steps_on_draws(
    name: str, draws: Draws, controller: Block, asked: Requirements, *, order: str, observer: Block | None,
    numbers: Sequence[int] | None = None,
) -> dict[str, Vector]:  # fmt: skip
    """Return metric -> the worst value in the steps of each of these draws of a search, as `run_drawn` makes them.

    `numbers` None is all of them; `run_drawn` does not make those again.
    """
    task = _task_of(name, draws, controller, asked, order, observer, 0)
    results = _all_steps(task, name, 0) if numbers is None else _steps_side_by_side(task, numbers)
    return {
        metric: np.array([worst(metric, [value for value, _ in found[metric]]) for found in results])
        for metric in results[0]
    }


def oscillating_share(
    name: str, draws: Draws, controller: Block, asked: Requirements, *, order: str, observer: Block | None,
    numbers: Sequence[int], gain: float,
) -> float:  # fmt: skip
    """Return the share of these draws of a search that oscillate with all loop gains times or over `gain`."""
    task = _task_of(name, draws, controller, asked, order, observer, 0)
    task = replace(task, limits={_MARGINS[0]: gain}, amplitudes=task.amplitudes[-1:])
    found = side_by_side([partial(_margins, task, number, whole_only=True) for number in numbers])
    return sum(any(item.oscillates for item in each) for each in found) / len(found)


def _task_of(
    name: str, draws: Draws, controller: Block, asked: Requirements, order: str, observer: Block | None, attempt: int
) -> _Task:
    plants = _plants(name, draws, attempt, asked.robot)
    inverse = asked.robot.redefinition(directions_of(draws.model))[1]
    return _Task(
        controller, asked, order, observer, draws, plants, _required_margins(asked), _amplitudes(draws, asked), inverse
    )


def _run_all(
    name: str, draws: Draws, controller: Block, asked: Requirements, order: str, observer: Block | None, attempt: int,
    progress: Progress,
) -> Drawn:  # fmt: skip
    task = _task_of(name, draws, controller, asked, order, observer, attempt)
    plants, done = task.plants, 0

    def margins_of(number: int) -> list[_Margin]:
        nonlocal done
        found = _margins(task, number)
        done += 1
        progress(0.3 + 0.6 * done / len(plants), f"draw {done} of {len(plants)}")
        return found

    steps = _all_steps(task, name, attempt)
    margins = side_by_side([partial(margins_of, number) for number in range(len(plants))])
    failed = {item.number for each in margins for item in each if item.oscillates}
    values: dict[str, list[float]] = {}
    conditions: dict[str, list[dict[str, Any]]] = {}
    for number, by_metric in enumerate(steps):
        for metric, found in by_metric.items():
            bounds = [item for item in asked.bounds if item.metric == metric]
            for value, condition in found:
                values.setdefault(metric, []).append(value)
                conditions.setdefault(metric, []).append({"name": condition, "draw": number})
                if not all(item.holds(value) for item in bounds):
                    failed.add(number)
    # A gain raised and one lowered are two margins: the slow loop of a lower gain swings longer, and may never fail.
    kinds = dict.fromkeys((item.metric, item.experiment.what) for each in margins for item in each)
    for metric, kind in kinds:
        alike = [[m for m in each if (m.metric, m.experiment.what) == (metric, kind)] for each in margins]
        progress(0.95, f"bisect {metric}")
        for value, item in side_by_side([partial(_least_margin, m) for m in sorted(alike, key=_severity)[:_BISECTED]]):
            values.setdefault(metric, []).append(value)
            conditions.setdefault(metric, []).append(_margin_facts(item, plants[item.number].name, asked))
    return Drawn(
        name, draws, attempt, len(plants), {metric: np.array(found) for metric, found in values.items()}, conditions,
        tuple(sorted(failed)),
    )  # fmt: skip


def _models(draws: Draws, attempt: int) -> list[Model]:
    return draws.for_certificate(attempt) if attempt else draws.for_search()


def _plants(name: str, draws: Draws, attempt: int, robot: Robot) -> list[SimulationModel]:
    """Return the draws as plants; every candidate of a search runs over the same."""

    def make() -> list[SimulationModel]:
        models = _models(draws, attempt)
        return [make_simulation_model(model, f"draw {k + 1} of {name}", robot) for k, model in enumerate(models)]

    return compute_once(make, name, draws, attempt, robot)


def _required_margins(asked: Requirements) -> dict[str, float]:
    return {
        metric: max(item.limit for item in asked.bounds if item.metric == metric and item.bound == "min")
        for metric in _MARGINS if any(item.metric == metric and item.bound == "min" for item in asked.bounds)
    }  # fmt: skip


def _amplitudes(draws: Draws, asked: Requirements) -> tuple[float, ...]:
    """Return three steps, small to large, none beyond the recorded motion."""
    kicks = _under_test(draws, asked).kicks
    most = min(draws.conditions["motion"])
    small, large = min(kicks[0], most), min(kicks[-1], most)
    return tuple(dict.fromkeys((small, math.sqrt(small * large), large)))


def _under_test(draws: Draws, asked: Requirements) -> LoopUnderTest:
    scale, block = asked.scale, draws.model.block()
    return LoopUnderTest(
        name="", plant=lambda: BlockPart(block), controller=block, robot=asked.robot, time=scale.time,
        size=scale.si(scale.size) / math.radians(1.0), noise=scale.si(scale.noise) / math.radians(1.0),
    )  # fmt: skip


def _payloads(plant: SimulationModel, asked: Requirements) -> tuple[float, ...]:
    """Return the lightest and the heaviest payload of a draw [kg]."""
    found = [float(kg) for kg in plant.payloads(asked.sim["payloads_kg"])]
    return tuple(dict.fromkeys((min(found), max(found))))


def _all_steps(task: _Task, name: str, attempt: int) -> list[_Steps]:
    """Return the steps of all draws; a search makes those of its final candidates before their margins."""

    def compute() -> list[_Steps]:
        return _steps_side_by_side(task, range(len(task.plants)))

    given = (task.controller, task.asked.tables, task.order, task.observer)
    return compute_once(compute, name, task.draws, attempt, *given)


def _steps_side_by_side(task: _Task, numbers: Sequence[int]) -> list[_Steps]:
    # The first draw compiles the loop, once instead of in every thread.
    first = _steps(task, numbers[0])
    return [first, *side_by_side([partial(_steps, task, number) for number in numbers[1:]])]


def _steps(task: _Task, number: int) -> _Steps:
    """Return metric -> value and condition, which the draw's name begins, of every step of a draw."""
    asked, plant, robot = task.asked, task.plants[number], task.asked.robot
    several = len(robot.outputs.names) > 1
    angles = asked.sim["orientations_deg"] if several else [0.0]
    found: dict[str, list[tuple[float, str]]] = {}
    for kg, angle in product(_payloads(plant, asked), angles):
        words = [plant.name, *[f"{kg:g} kg"] * bool(plant.payload), *[f"{angle:g} deg"] * several]
        for metric, value in _step(task, plant, number, kg, math.radians(angle)).items():
            found.setdefault(metric, []).append((value, ", ".join(words)))
    return found


def _step(task: _Task, plant: SimulationModel, number: int, kg: float, orientation: float) -> dict[str, float]:
    """Return the metrics of one step, and of the load that comes after it."""
    asked, draws, scale, robot = task.asked, task.draws, task.asked.scale, task.asked.robot
    outputs, at = robot.outputs.names, step_time(task.controller, task.asked)
    half = float(asked.sim["duration_s"])
    size = scale.si(float(asked.sim["size_deg"]))
    shares = direction(orientation, robot)
    step = RobotReference(kind="step", values=tuple(size * s for s in shares), at=at)
    block, connections, wanted = scale_loop_gain(task.controller, task.observer, outputs)
    parameters = {f"share_{axis}": float(s) for axis, s in zip(outputs, draws.share, strict=True)}
    noise = _noise(draws, asked)
    told = "seen" if shows_settling(noise, size) else "without_noise"
    parameters |= {"keep": draws.keep, "noise": noise, "noise_seed": float(number)}
    loop = Loop(
        plant=plant.quiet(task.controller.sample_time), controller=BlockPart(task.controller),
        observer=None if task.observer is None else BlockPart(task.observer),
        reference=AroundMiddle.of(step, task.controller, asked),
        duration=at + half + (half if _has_load(task) else 0.0), order=task.order, robot=robot,
        **plant.carrying(kg), others={"louder": BlockPart(block)}, other_parameters={"louder": parameters},
        connections=connections, faults=tuple(_load(task, int(np.argmax(np.abs(shares))), at + half)),
        other_inputs={"louder": wanted},
    )  # fmt: skip
    name_of = scale.name_of
    try:
        result = _with_disturbance(run_loop(loop, compiled=True), told)
    except DataError:  # numbers overflowed
        result = None
    names = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg", "max_rad", "slack_s")
    rows = 0 if result is None else round((at + half) / result.sample_time)
    values = step_metrics(None if result is None else without_lead(rows_of(result, 0, rows), loop.reference))
    # Without tension outputs there is no slack to know; anything else that is no number fails.
    known = [name for name in names if name != "slack_s" or not math.isnan(values[name])]
    found = {f"sim.{name_of(name)}": values[name] for name in known}
    if _has_load(task):
        found[f"sim.{name_of('load_rms_deg')}"] = math.inf if result is None else _load_rms(result, rows, asked)
    return found


def _noise(draws: Draws, asked: Requirements) -> float:
    """Return the standard deviation of the sensor's noise [SI]: a recording that is noisier than asked is believed."""
    return max(asked.scale.si(float(asked.step["noise_deg"])), float(draws.noise.max()))


def _has_load(task: _Task) -> bool:
    return float(task.asked.step["load_rad"]) != 0.0


def _load(task: _Task, axis: int, start: float) -> Iterable[MotorFault]:
    """Yield the faults that add the load of the linear steps to the input of an axis."""
    if not _has_load(task):
        return
    load = task.asked.step_test(0).load * task.motors[:, axis]
    for motor, size in enumerate(load, start=1):
        if abs(size) > 1e-12:
            yield MotorFault(kind="offset", start=start, motor=motor, size=float(size), robot=task.asked.robot)


def _with_disturbance(result: LoopResult, told: str) -> LoopResult:
    """Return a result whose outputs are those of the draw with disturbance: "seen" by the sensor or "without_noise"."""
    own = {}
    for name in result.robot.outputs.names:
        seen = next(key for key in result.signals if key.endswith(f"{name}_measured_{told}"))
        own[name] = result.signals[seen]
    return replace(result, signals={**result.signals, **own})


def _load_rms(result: LoopResult, first: int, asked: Requirements) -> float:
    """Return the rms error of the worst output under the load, in the display unit."""
    errors = [
        float(np.sqrt(np.mean((result[name][first:] - result[f"{name}_reference"][first:]) ** 2)))
        for name in result.robot.outputs.names
    ]
    return float(asked.scale.shown(worst("load_rms", errors)))


def _margins(task: _Task, number: int, *, whole_only: bool = False) -> list[_Margin]:
    """Run a draw at each required margin: of each axis at the lightest payload, of all at once at the heaviest too.

    `whole_only`: of all axes at once alone.
    """
    plant, asked, found = task.plants[number], task.asked, []
    names, kg = asked.robot.outputs.names, _payloads(plant, asked)
    whole = names if len(names) == 1 else (*names, "both")
    for weight in kg:
        test = replace(
            _under_test(task.draws, asked), name=f"{plant.name}, {weight:g} kg" if plant.payload else plant.name,
            plant=lambda: plant.quiet(task.controller.sample_time), controller=task.controller, observer=task.observer,
            order=task.order, constants=plant.carrying(weight),
        )  # fmt: skip
        # Postures take turns: the draws are many.
        posture = tuple(test.size * angle for angle in test.postures()[number % 3])
        for amplitude in task.amplitudes:
            floor = Experiment(test, whole[-1], "gain_up", amplitude, posture).floor()
            for axes in whole if weight == kg[0] and not whole_only else whole[-1:]:
                for metric, limit in task.limits.items():
                    found += _at_limit(
                        Experiment(test, axes, "", amplitude, posture), floor, metric, limit, number,
                        whole=axes == whole[-1],
                        ranks=not whole_only and axes == whole[-1] and amplitude != task.amplitudes[0],
                    )  # fmt: skip
    return found


def _at_limit(
    case: Experiment, floor: float, metric: str, limit: float, number: int, *, whole: bool, ranks: bool
) -> list[_Margin]:
    """Return one axis at a required margin; a gain margin is one up and, of all axes at once, one down."""
    kinds = ("delay",) if metric == _MARGINS[1] else ("gain_up", "gain_down") if whole else ("gain_up",)
    value, found = limit / 1e3 if metric == _MARGINS[1] else limit, []
    for kind in kinds:
        tried = replace(case, what=kind)
        if not tried.comes_to_rest(floor):
            found.append(_Margin(number, metric, tried, floor, limit, math.inf, True))
            continue
        oscillates, swing = tried.try_at(value, floor)
        # What ranks the draws: at the required margin most are calm, and alike.
        beyond = tried.try_at(_PROBED * value, floor)[1] / case.amplitude if ranks else 0.0
        found.append(_Margin(number, metric, tried, floor, limit, swing / case.amplitude, oscillates, beyond))
    return found


def _severity(items: Sequence[_Margin]) -> tuple[bool, float]:
    """Return the rank of a draw: those that fail first, then those that swing most at twice the required margin."""
    return not any(item.oscillates for item in items), -max(item.beyond for item in items)


def _least_margin(items: Sequence[_Margin]) -> tuple[float, _Margin]:
    """Return the least margin of a draw over its experiments, in the unit of its metric, and which has it.

    It is inf where the scan of none finds an end. An experiment that is calm at the least margin so far is done.
    """
    least, found = math.inf, items[0]
    for item in sorted(items, key=lambda item: (not item.oscillates, -item.beyond, -item.swing)):
        value = _margin(item, least)
        if value < least:
            least, found = value, item
    return least * (1e3 if found.experiment.what == "delay" else 1.0), found


def _margin(item: _Margin, least: float) -> float:
    """Return the margin of one experiment [s or 1]; inf where it is not below `least`."""
    case, delay = item.experiment, item.experiment.what == "delay"
    none, limit = (0.0, item.limit / 1e3) if delay else (1.0, item.limit)
    if least <= none:  # another experiment never comes to rest: no margin is smaller
        return math.inf
    if not case.comes_to_rest(item.floor):
        return none
    if item.oscillates:
        return bisect(case, none, limit, item.floor)
    unit = case.loop.samples * case.sample_time
    scan: Sequence[float] = [unit * samples for samples in DELAY_SCAN] if delay else GAIN_SCAN
    scan = [v for v in scan if limit < v < least] if math.isinf(least) else [least]
    calm = limit
    for tried in scan:
        if case.try_at(tried, item.floor)[0]:
            return bisect(case, calm, tried, item.floor)
        calm = tried
    return math.inf


def _margin_facts(item: _Margin, name: str, asked: Requirements) -> dict[str, Any]:
    unit, factor = error_unit(asked.robot)
    per = math.radians(1.0) if factor is None else factor
    case = item.experiment
    return {
        "name": name, "draw": item.number, "axis": case.axes, "raised": case.what, f"kick_{unit}": case.amplitude / per,
        f"posture_{unit}": [x / per for x in case.posture], "worst_of": _BISECTED,
    }  # fmt: skip


def _unreached(draws: Draws, asked: Requirements) -> dict[str, str]:
    """Return "sim" -> why the recordings do not reach the steps, and what to record."""
    size, most = asked.scale.si(float(asked.sim["size_deg"])), min(draws.conditions["motion"])
    shown, unit = asked.scale.shown, error_unit(asked.robot)[0]
    ours = asked.robot.tendon_angles is not None  # of which `softneck record` has experiments
    found = []
    if size > _BEYOND * most:
        command = " (`softneck record eq22`, or `multisine` with a larger --amplitude)" if ours else ""
        found.append(
            f"steps of {shown(size):.3g} {unit}, the recordings move {shown(most):.3g} {unit}; record larger "
            f"motions{command}, or set `[sim] {asked.scale.name_of('size_deg')}`"
        )
    heavy, heaviest = max(draws.conditions["payload_kg"]), max(asked.sim["payloads_kg"])
    if asked.own.get("sim", {}).get("payloads_kg") and heaviest > heavy + 1e-9:
        command = f" (`softneck record eq22 --payload {heaviest:g}`)" if ours else ""
        found.append(f"a payload of {heaviest:g} kg, recorded up to {heavy:g} kg; record with it{command}")
    return {"sim": f"not supported by the data: {'; '.join(found)}"} if found else {}


def draws_of(families: Mapping[str, Any]) -> dict[str, Draws]:
    """Return name -> draws of the families that have them."""
    return {name: thing.draws for name, thing in families.items() if getattr(thing, "draws", None) is not None}
