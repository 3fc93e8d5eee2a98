"""Judge one candidate: linear checks, loops over simulation models, margins by experiment."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np

from softneck.core import KINDS, DataError, Matrix, SoftneckError, Vector, make_settings, resolve, silent, to_si, worst
from softneck.design import AxisSettings, UncertainPlant, uncertain_plant
from softneck.identification import payloads
from softneck.loop import Loop, LoopResult, Reference, RobotReference, SensorFault, run_loop
from softneck.robot import Robot
from softneck.runtime import Block
from softneck.verification import (
    LARGE,
    SMALL,
    ControllerUnderTest,
    Drawn,
    Plants,
    SimulationModel,
    all_plants,
    controller_under_test,
    crossing_values,
    crossings,
    data_margins,
    direction,
    judge_loop,
    judged_elsewhere,
    loops_under_test,
    make_simulation_model,
    margins,
    oscillating_share,
    run_drawn,
    run_steps,
    run_steps_on_draws,
    sources_of,
    start_of,
    step_loop,
    step_time,
    without_lead,
)

from ._requirements import TuneRequirements, can_follow_circle, default_payloads
from ._task import MARGINS, Judgement, Task, circle_angles, curve_times, has_observer

# Time to reach the circle [s], and turns, of which the last is judged.
_LEAD_IN_S, _TURN_COUNT = 2.0, 2.0
# Draws that lead a search: as many that overshoot most and as many that rise last.
_HARDEST = 4
# Longest preview of a reference [s].
_MAX_PREVIEW_S = 0.8


@dataclass(frozen=True, slots=True)
class Case:
    """One loop over a simulation model.

    `plant`: number of the plant. `payload`: [kg]. `orientation`: of the step [rad]. `part`: share of the step's size.
    `noise`: whether the sensor is noisy. `late`: whether the plant has more delay than modelled. `circle`: a circle
    instead of the step.
    """

    plant: int
    payload: float
    orientation: float = 0.0
    part: float = 1.0
    noise: bool = False
    late: bool = False
    circle: bool = False


def cases(
    own: Sequence[SimulationModel], asked: TuneRequirements, robot: Robot, drawn: Sequence[str] = ()
) -> tuple[Case, ...]:
    """Return all loops of a search; of draws not those that `run_steps_on_draws` makes, but one for the curves."""
    table, small = asked.certificate.sim, asked.track["small_part"]
    payloads = sorted({float(kg) for kg in table["payloads_kg"]})
    angles = [math.radians(a) for a in table["orientations_deg"]] if len(robot.outputs.names) > 1 else [0.0]
    found = []
    for number, plant in enumerate(own):
        for kg in plant.payloads(payloads):
            # Loops of `verify` have no noise, with which the rise looks shorter.
            found += (
                [Case(number, kg, min(angles, key=abs))] if plant.name in drawn
                else [Case(number, kg, angle, noise=noisy) for angle in angles for noisy in (False, True)]
            )  # fmt: skip
            found += [Case(number, kg, angle, part=small, noise=True) for angle in (angles[0], angles[-1])]
            found.append(Case(number, kg, angles[0], noise=True, late=True))
            if can_follow_circle(robot):
                found.append(Case(number, kg, circle=True))
    return tuple(dict.fromkeys(found))


def run_case(
    case: Case, plant: SimulationModel, block: Block, order: str, task: Task, observer: Block | None = None
) -> tuple[dict[str, float], Vector | None]:
    """Return the metrics of a loop, or of a circle the distance for each lead, in the display unit."""
    loop = loop_of(case, plant, block, order, task, observer)
    if case.circle:
        return {}, _distances(loop, task)
    asked = task.asked.certificate
    # A robot is judged by its sensor, whose noise adds to the overshoot.
    values, result = judge_loop(
        loop, compiled=True, angle="measured" if task.asked.shows_settling(case.part) else "true"
    )
    names = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg", "max_rad", "slack_s")
    name_of = asked.scale.name_of
    # Without tension outputs there is no slack to know.
    known = [name for name in names if name != "slack_s" or not math.isnan(values[name])]
    found = {f"sim.{name_of(name)}": values[name] for name in known}
    if case.noise and case.part < 1.0:
        found[f"track.{name_of('variation_rad_s')}"] = math.inf if result is None else variation(result)
    if case.part < 1.0:
        # With friction, percentages of a small step mean little.
        found = {name: value for name, value in found.items() if not name.endswith(("overshoot_pct", "settling_s"))}
    return found, None


def loop_of(
    case: Case, plant: SimulationModel, block: Block, order: str, task: Task, observer: Block | None = None
) -> Loop:
    """Return the loop of a case."""
    asked, track, robot = task.asked.certificate, task.asked.track, task.robot
    time, at = asked.scale.time, step_time(block, asked)
    common = task.cocontraction or 0.0
    pulls = any(port.name == "least_cocontraction" for port in block.parameters)
    together = 0.0 if pulls else common
    if together:
        at = max(at, 3.0 * time)
    size = case.part * asked.scale.si(float(asked.sim["size_deg"]))
    ends = tuple(size * share for share in direction(case.orientation, robot))
    duration = at + float(asked.sim["duration_s"])
    faults = []
    if case.noise and track["noise_deg"] > 0.0:
        faults.append(SensorFault(kind="noise", std=asked.scale.si(track["noise_deg"]), seed=_seed(case, task)))
    Ts = block.sample_time
    if case.late and track["delay_ms"] > 0.0:
        faults.append(SensorFault(kind="delay", delay=judged_delay(track["delay_ms"], Ts)))
    reference = RobotReference(kind="step", values=ends, at=at)
    if case.circle:
        frequency = track["circle_rad_s"] / (2.0 * math.pi)
        led, inclination = _LEAD_IN_S * time, (asked.scale.si(track["circle_deg"]),)
        reference = RobotReference(kind="rotation", values=inclination, frequency=frequency, at=at, rise=led)
        duration = at + led + _TURN_COUNT / frequency
    return step_loop(
        block, plant.quiet(Ts), plant, case.payload, _Together(reference, together), asked, duration=duration,
        order=order, observer=observer, faults=faults,
    )  # fmt: skip


def judged_delay(asked_ms: float, sample_time: float) -> float:
    """Return the additional delay of a loop [s]: the asked one in whole samples, at least one."""
    return sample_time * max(1, round(asked_ms / 1e3 / sample_time))


def told_conditions(task: Task, own: Sequence[SimulationModel], sample_time: float) -> dict[str, str]:
    """Return condition -> what is judged instead of it, for each that was asked and is not judged as it is."""
    found, late = judged_elsewhere(own, task.asked.certificate), task.asked.track["delay_ms"]
    judged = 1e3 * judged_delay(late, sample_time)
    heavy = [kg for kg in default_payloads() if kg > max(task.asked.certificate.sim["payloads_kg"])]
    if task.drawn and heavy and task.robot.neck is not None and "sim.payloads_kg" not in task.asked.stated:
        found[f"payload {max(heavy):g} kg"] = (
            f"judged with at most {max(task.asked.certificate.sim['payloads_kg']):g} kg, as recorded; for more record "
            f"`softneck record mixed --payload {max(heavy):g}` and give both recordings"
        )
    if own and late > 0.0 and not math.isclose(judged, late, rel_tol=1e-6):
        found[f"additional delay {late:g} ms"] = f"judged at {judged:g} ms, whole samples of the loop"
    return found


def _seed(case: Case, task: Task) -> int:
    """Return the seed of the noise: one for each plant and direction, the same for every candidate."""
    return task.seed + 1000 * case.plant + round(math.degrees(case.orientation))


@dataclass(frozen=True, slots=True)
class _Together:
    """A reference with a constant co-contraction."""

    reference: Reference
    cocontraction: float
    repeats: ClassVar[bool] = True  # equal ones have equal samples: `run_loop` keeps them

    def __call__(self, time: float, /) -> tuple[float, ...]:
        return (*self.reference(time)[:-1], self.cocontraction)


def variation(result: LoopResult) -> float:
    """Return the total variation of all set-points per second, in the unit of the motors."""
    P = np.column_stack([result[name] for name in result.robot.set_points]) / to_si(result.robot.motors.unit)[0]
    return float(np.abs(np.diff(P, axis=0)).sum() / result.time[-1])


def _distances(loop: Loop, task: Task) -> Vector:
    """Return the rms distance (leads,) of the last turn to the circle 0, 1, ... samples ago, in the display unit."""
    scale = task.asked.certificate.scale
    leads = round(scale.time * _MAX_PREVIEW_S / loop.controller.sample_time)
    try:
        result = run_loop(loop, compiled=True)
    except DataError:
        return np.full(leads + 1, math.inf)
    turn = round(2.0 * math.pi / task.asked.track["circle_rad_s"] / result.sample_time)
    names = result.robot.outputs.names
    y = np.stack([result.angle(name) for name in names])[:, -turn:]
    r = np.stack([result[f"{name}_reference"] for name in names])
    rows = r.shape[1]
    each = [y - r[:, rows - turn - lead : rows - lead] for lead in range(leads + 1)]
    return scale.shown(np.array([math.sqrt(float((part**2).sum(axis=0).mean())) for part in each]))


#: Levels of judging, from quick to slow.
LEVELS = ("linear", "all", "margins")
# Linear plants of a linear check (nominal, corners, samples); a certificate has hundreds.
_PLANT_COUNT = 48


@dataclass(frozen=True, slots=True, eq=False)
class Ready:
    """Objects that a worker prepares once per task.

    `plants`: linear ones, without the delay that a loop's order adds. `weights`: for each source of plants, those of
    the motors in each axis's input. `uncertain`: plant of the linear designs. `own`: simulation models. `all`: loops of
    the level `all`. `kept`: designs by kind and settings.
    """

    plants: Plants
    weights: list[Matrix]
    uncertain: UncertainPlant
    own: tuple[SimulationModel, ...]
    all: tuple[Case, ...]
    kept: dict[str, Any] = field(default_factory=dict)


def judge_candidate(task: Task, kind: str, settings: Mapping[str, Any], level: str) -> Judgement:
    """Return the metrics of one level, or the error of the candidate."""
    try:
        ready = prepare(task)
        controller = design_candidate(task, ready, kind, settings)
        if level == "linear":
            curves = {} if ready.own else linear_curves(task, ready, controller)
            return Judgement(linear_metrics(task, ready, controller), curves=curves)
        block, order = controller.block(), str(getattr(controller, "order", "sequential"))
        eyes = make_observer(task, kind)
        if level == "margins":
            return Judgement(margin_metrics(task, ready, block, order, eyes))
        found = loop_metrics(task, ready, block, order, ready.all, eyes)
        if task.hardest:
            linear = linear_metrics(task, ready, controller)
            found |= {name: value for name, value in linear.items() if name not in MARGINS}
            found |= drawn_metrics(task, block, order, eyes)
        return Judgement(found, curves=loop_curves(task, ready, block, order, eyes))
    except SoftneckError as error:
        return Judgement({}, " ".join(str(error).split()))


def prepare(task: Task) -> Ready:
    """Return the prepared objects of a task; each process prepares them once."""
    kept = _cache(task.digest)
    if "ready" not in kept:
        certificate = task.asked.certificate
        sources = sources_of(task.linear, certificate)
        plants = all_plants(sources, _PLANT_COUNT, int(certificate.sampling["seed"]))
        own = tuple(make_simulation_model(thing, name, task.robot) for name, thing in task.own.items())
        kept["ready"] = Ready(
            plants, [source.weights for source in sources], uncertain_plant(task.plant), own,
            cases(own, task.asked, task.robot, task.drawn),
        )  # fmt: skip
    return kept["ready"]


@lru_cache(maxsize=4)
def _cache(digest: str) -> dict[str, Ready]:
    del digest
    return {}


def design_candidate(task: Task, ready: Ready, kind: str, settings: Mapping[str, Any]) -> Any:
    """Return the controller of a candidate; each process designs it once."""
    key = json.dumps([kind, dict(settings)], sort_keys=True)
    if key not in ready.kept:
        made = make_settings(resolve(KINDS[kind].settings), settings)
        if task.observer is not None and hasattr(made, "over"):
            made = made.over(task.observer)
        ready.kept[key] = made.design(_plant_for(task, ready, kind, made))
    return ready.kept[key]


def _plant_for(task: Task, ready: Ready, kind: str, made: Any) -> Any:
    """Return the plant that a kind is designed on; `nmpc` prefers a nonlinear model with payloads."""
    if isinstance(made, AxisSettings):
        return ready.uncertain
    if kind == "nmpc":
        models = sorted(task.models, key=lambda model: payloads(model.arrays) is None)
        return models[0] if models else task.plant
    if kind == "adaptive":
        return next(iter(task.linear.values()))
    return task.plant  # these settings read more of a family than its plants


def make_observer(task: Task, kind: str) -> Block | None:
    """Return the observer in the loops of a kind; None for most kinds."""
    return task.observer.block() if task.observer is not None and has_observer(kind) else None


def linear_metrics(task: Task, ready: Ready, controller: Any) -> dict[str, float]:
    """Return margins over the boxes and over the recordings, and steps on the plants of the boxes."""
    asked = task.asked.certificate
    judged_one: ControllerUnderTest = controller_under_test(controller, order=None, observer=False)
    plants = ready.plants.later(judged_one.extra)
    found: dict[str, float] = {}
    steep = float(asked.uncertainty["rolloff_db_per_decade"])
    for law in judged_one.laws.values():
        for name, values in margins(plants, law).items():
            axis, _, last = name.partition(".")
            value = worst(name, values)
            keep_worse(found, name, value)
            if last in (*LARGE, *SMALL) and axis != "mimo":
                keep_worse(found, f"axes.{last}", value)
        # Where draws decide, the weight over all amplitudes at once does not; the box alone leads the search.
        for item in () if task.drawn else data_margins(task.linear, law, plants.axes, judged_one.extra, steep):
            # A loop that may cross outside the recorded band has no certified margin.
            values = item.margins or {**dict.fromkeys(LARGE, 0.0), "sensitivity": math.inf}
            for last, value in values.items():
                for group in (item.axis, "axes", *(("mimo",) if last == "disk_margin" else ())):
                    keep_worse(found, f"{group}.{last}", float(value))
            keep_worse(found, "robust.mu", item.mu)
    steps = run_steps(plants, judged_one.block, asked.step_test(task.seed), robot=task.robot, weights=ready.weights)
    names = {name: f"step.{asked.scale.name_of(name)}" for name in steps.metrics}
    return found | {names[name]: worst(name, values) for name, values in steps.metrics.items()}


def keep_worse(found: dict[str, float], name: str, value: float) -> None:
    """Store a value of a metric where it is worse than the stored one."""
    found[name] = worst(name, [found.get(name, value), value])


def loop_metrics(
    task: Task, ready: Ready, block: Block, order: str, chosen: Sequence[Case], observer: Block | None = None
) -> dict[str, float]:
    """Return the worst metrics over all loops."""
    found: dict[str, float] = {}
    shifts: list[Vector] = []
    for case in chosen:
        values, distances = run_case(case, ready.own[case.plant], block, order, task, observer)
        for name, value in values.items():
            keep_worse(found, name, value)
        if distances is not None:
            shifts.append(distances)
    if shifts:
        # One lead for all plants: the one with the smallest worst distance.
        most = np.nan_to_num(np.max(shifts, axis=0), nan=math.inf, posinf=math.inf)
        best = int(np.argmin(most))
        Ts = block.sample_time
        name_of = task.asked.certificate.scale.name_of
        found |= {f"track.{name_of('ahead_rms_deg')}": float(most[best]), "track.ahead_s": best * Ts,
                  f"track.{name_of('circle_rms_deg')}": float(most[0])}  # fmt: skip
    return found


def drawn_metrics(task: Task, block: Block, order: str, observer: Block | None) -> dict[str, float]:
    """Return the worst metrics of the steps of the hardest draws, and a gain margin.

    It is that which the search aims at if none of them oscillates there, else less.
    """
    found: dict[str, float] = {}
    aims = [item.limit for item in task.aims if item.metric == MARGINS[0] and item.bound == "min"]
    for name, numbers in task.hardest.items():
        where = {"order": order, "observer": observer, "numbers": numbers}
        draws, asked = task.linear[name].draws, task.asked.certificate
        for metric, each in run_steps_on_draws(name, draws, block, asked, **where).items():
            keep_worse(found, metric, worst(metric, each))
        for aim in aims:
            lost = oscillating_share(name, draws, block, asked, gain=aim, **where)
            keep_worse(found, MARGINS[0], aim / (1.0 + lost))
    return found


def hardest_draws(task: Task, kind: str, settings: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return family -> numbers of its draws on which a controller overshoots most or rises last.

    The disturbance of a draw is the same for all controllers, so these are hard for others as well.
    """
    found = {}
    for name, values in steps_on_all_draws(task, kind, settings).items():
        each = [np.argsort(-np.nan_to_num(values[f"sim.{metric}"], nan=np.inf), kind="stable")[:_HARDEST]
                for metric in ("overshoot_pct", "rise_s")]  # fmt: skip
        found[name] = tuple(np.unique(each).tolist())
    return found


def steps_on_all_draws(task: Task, kind: str, settings: Mapping[str, Any]) -> dict[str, dict[str, Vector]]:
    """Return family -> metric -> the worst value in the steps of each draw that a search may see."""
    controller, asked = design_candidate(task, prepare(task), kind, settings), task.asked.certificate
    where = {"order": str(getattr(controller, "order", "sequential")), "observer": make_observer(task, kind)}
    return {
        name: run_steps_on_draws(name, thing.draws, controller.block(), asked, **where)
        for name, thing in task.linear.items() if getattr(thing, "draws", None) is not None
    }  # fmt: skip


def margin_metrics(
    task: Task, ready: Ready, block: Block, order: str, observer: Block | None = None
) -> dict[str, float]:
    """Return the margins by experiment on the simulation models, and all that loops over the draws of families tell."""
    asked, found = task.asked.certificate, {}
    own = [plant for plant in ready.own if plant.name not in task.drawn]
    loops = loops_under_test(block, own, asked, order=order, observer=observer)
    for name, (values, _) in (crossing_values(crossings(loops, overall=True)) if loops else {}).items():
        if name.startswith("axes."):
            keep_worse(found, name, worst(name, values))
    for drawn in search_draws(task, block, order, observer):
        for metric, values in drawn.values.items():
            keep_worse(found, metric, worst(metric, values))
    return found


def search_draws(task: Task, block: Block, order: str, observer: Block | None) -> list[Drawn]:
    """Return the loops over the draws of each family that a search may see."""
    drawn = {name: family.draws for name, family in task.linear.items() if getattr(family, "draws", None) is not None}
    run = partial(run_drawn, order=order, observer=observer, attempt=0, progress=silent)
    return [run(name, draws, block, task.asked.certificate) for name, draws in drawn.items()]


def loop_curves(
    task: Task, ready: Ready, block: Block, order: str, observer: Block | None = None
) -> dict[str, list[float]]:
    """Return curves of the steps and circles over all simulation models and payloads; empty if a loop diverges.

    `low`, `high`: ends of the stepped output over all plants, in its display unit. `value`, `set_point_1`, ..: of the
    last plant with its heaviest payload. `circle_low`, `circle_high`, `circle`: radius of the last turn at
    `circle_angles`.
    """
    steps, circles = [], []
    along = min((case.orientation for case in ready.all), key=abs)
    try:
        for case in ready.all:
            plain = not (case.noise or case.late) and case.part == 1.0 and case.orientation == along
            if case.circle or plain:
                loop = loop_of(case, ready.own[case.plant], block, order, task, observer)
                result = without_lead(run_loop(loop, compiled=True), loop.reference)
                (circles if case.circle else steps).append(result)
    except DataError:
        return {}
    shown, time = task.asked.certificate.scale.shown, curve_times(task)
    name = task.robot.outputs.names[0]
    reference = steps[-1][f"{name}_reference"]
    before = float(reference[0])
    after = [result.time - result.time[np.argmax(result[f"{name}_reference"] != result[f"{name}_reference"][0])]
             for result in steps]  # fmt: skip
    y = np.array(
        [np.interp(time, t, shown(result.angle(name) - before)) for t, result in zip(after, steps, strict=True)]
    )
    P = np.column_stack([steps[-1][motor] for motor in task.robot.set_points])
    # A set-point is held until the next sample.
    rows = np.searchsorted(after[-1], time + 1e-9, side="right") - 1
    found = _step_curves(task, ready, y, P[rows]) | {"reference": [_rounded(shown(reference[-1] - before))]}
    if circles:
        r = np.array([_radius(result, task) for result in circles])
        found |= {"circle_low": r.min(axis=0), "circle_high": r.max(axis=0), "circle": r[-1]}
    return _finite_curves(found)


def linear_curves(task: Task, ready: Ready, controller: Any) -> dict[str, list[float]]:
    """Return curves of the steps of the first output over the linear plants, as `loop_curves` does; no circle."""
    judged_one: ControllerUnderTest = controller_under_test(controller, order=None, observer=False)
    test = replace(task.asked.certificate.step_test(task.seed), noise=0.0, load=0.0)
    found = run_steps(
        ready.plants.later(judged_one.extra), judged_one.block, test, robot=task.robot, weights=ready.weights
    )
    shown, time = task.asked.certificate.scale.shown, curve_times(task)
    half = found.time.size // 2
    # The nominal plant, the first, is moved to the end.
    y = np.array([np.interp(time, found.time[:half], each[:half]) for each in found.angles[0, ::-1]])
    rows = np.searchsorted(found.time[:half], time + 1e-9, side="right") - 1
    curves = _step_curves(task, ready, shown(y), found.motors[0, 0, rows])
    return _finite_curves(curves | {"reference": [_rounded(float(shown(test.step)))]})


def _step_curves(task: Task, ready: Ready, y: np.ndarray, P: np.ndarray) -> dict[str, Any]:
    """Return the curves of outputs `y` (plants, n) and of set-points `P` (n, motors) over the last plant."""
    unit = to_si(task.robot.motors.unit)[0]
    T, inverse = task.robot.redefinition(ready.weights[0])
    found = {"low": y.min(axis=0), "high": y.max(axis=0), "value": y[-1]}
    found |= {f"set_point_{j}": values / unit for j, values in enumerate(P.T, start=1)}
    return found | ({"tautness": P @ T[-1] / unit} if inverse[:, -1].any() else {})


def _radius(result: LoopResult, task: Task) -> Vector:
    """Return the radius of the last turn at `circle_angles`, in the display unit."""
    turn = round(2.0 * math.pi / task.asked.track["circle_rad_s"] / result.sample_time)
    x, y = (task.asked.certificate.scale.shown(result.angle(name)[-turn:] - there)
            for name, there in zip(task.robot.outputs.names, start_of(task.robot), strict=True))  # fmt: skip
    return np.interp(circle_angles(), np.arctan2(y, x), np.hypot(x, y), period=2.0 * math.pi)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def _finite_curves(found: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return curves in four digits; none if a number overflowed."""
    if not all(np.isfinite(values).all() for values in found.values()):
        return {}
    return {name: [_rounded(float(value)) for value in values] for name, values in found.items()}
