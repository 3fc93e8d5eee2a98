"""The loops over simulation models: steps of several sizes and directions, noise, delay, and a circle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Vector, to_si
from softneck.loop import Loop, LoopResult, Reference, RobotReference, SensorFault, run_loop
from softneck.robot import Robot
from softneck.runtime import Block
from softneck.verification import OwnPlant, direction, judge_loop, step_at, step_loop

from ._requirements import Task, TuneRequirements, circles

# The circle is led in over so long [s], then goes round so often, of which the last turn is judged.
_LED, _TURNS = 2.0, 2.0
# A reference is known so much earlier at most [s].
_AHEAD = 0.8


@dataclass(frozen=True, slots=True)
class Case:
    """One loop.

    Attributes:
        plant: number of the plant.
        payload: [kg].
        orientation: of the step [rad].
        part: of the step's size.
        noise: whether the sensor is noisy.
        late: whether the plant is later than it says.
        circle: a circle instead of the step.
    """

    plant: int
    payload: float
    orientation: float = 0.0
    part: float = 1.0
    noise: bool = False
    late: bool = False
    circle: bool = False


def cases(own: Sequence[OwnPlant], asked: TuneRequirements, robot: Robot) -> tuple[Case, ...]:
    """Return all loops."""
    table, small = asked.certificate.sim, asked.track["small_part"]
    payloads = sorted({float(kg) for kg in table["payloads_kg"]})
    angles = [math.radians(a) for a in table["orientations_deg"]] if len(robot.outputs.names) > 1 else [0.0]
    found = []
    for number, plant in enumerate(own):
        for kg in plant.payloads(payloads):
            # Those of `verify` have no noise, which crosses 90 % sooner than the angle does.
            found += [Case(number, kg, angle, noise=noisy) for angle in angles for noisy in (False, True)]
            found += [Case(number, kg, angle, part=small, noise=True) for angle in (angles[0], angles[-1])]
            found.append(Case(number, kg, angles[0], noise=True, late=True))
            if circles(robot):
                found.append(Case(number, kg, circle=True))
    return tuple(dict.fromkeys(found))


def run_case(
    case: Case, plant: OwnPlant, block: Block, order: str, task: Task, observer: Block | None = None
) -> tuple[dict[str, float], Vector | None]:
    """Return the metrics of a loop by the names of requirements; of a circle its distance for each lead, as shown."""
    loop = loop_of(case, plant, block, order, task, observer)
    if case.circle:
        return {}, _distances(loop, task)
    asked = task.asked.certificate
    # What is asked of a robot is seen by its sensor: a quiet output overshoots less.
    values, result = judge_loop(loop, compiled=True, angle="measured" if task.asked.told(case.part) else "true")
    names = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg", "max_rad", "slack_s")
    name_of = asked.scale.name_of
    found = {f"sim.{name_of(name)}": values[name] for name in names if not math.isnan(values[name])}
    if case.noise and case.part < 1.0:
        found[f"track.{name_of('variation_rad_s')}"] = math.inf if result is None else variation(result)
    if case.part < 1.0:
        # A small step of a neck with friction is judged by where it goes, not by percent of little.
        found = {name: value for name, value in found.items() if not name.endswith(("overshoot_pct", "settling_s"))}
    return found, None


def loop_of(case: Case, plant: OwnPlant, block: Block, order: str, task: Task, observer: Block | None = None) -> Loop:
    """Return the loop of a case."""
    asked, track, robot = task.asked.certificate, task.asked.track, task.robot
    time, at = asked.scale.time, step_at(block, asked)
    common = task.cocontraction or 0.0
    pulls = any(port.name == "least_cocontraction" for port in block.parameters)
    together = 0.0 if pulls else common
    if together:
        at = max(at, 3.0 * time)
    size = case.part * asked.si(float(asked.sim["size_deg"]))
    ends = tuple(size * share for share in direction(case.orientation, robot))
    duration = at + float(asked.sim["duration_s"])
    faults = []
    if case.noise and track["noise_deg"] > 0.0:
        faults.append(SensorFault(kind="noise", std=asked.si(track["noise_deg"]), seed=_seed(case, task)))
    Ts = block.sample_time
    if case.late and round(track["delay_ms"] / 1e3 / Ts):
        faults.append(SensorFault(kind="delay", delay=Ts * round(track["delay_ms"] / 1e3 / Ts)))
    reference = RobotReference(kind="step", values=ends, at=at)
    if case.circle:
        frequency = track["circle_rad_s"] / (2.0 * math.pi)
        led, inclination = _LED * time, (asked.si(track["circle_deg"]),)
        reference = RobotReference(kind="rotation", values=inclination, frequency=frequency, at=at, rise=led)
        duration = at + led + _TURNS / frequency
    return step_loop(
        block, plant.quiet(Ts), plant, case.payload, _Together(reference, together), asked, duration=duration,
        order=order, observer=observer, faults=faults,
    )  # fmt: skip


def _seed(case: Case, task: Task) -> int:
    """Return that of the noise: another for each plant and direction, the same for every candidate."""
    return task.seed + 1000 * case.plant + round(math.degrees(case.orientation))


@dataclass(frozen=True, slots=True)
class _Together:
    """A reference with a co-contraction that is there from the start."""

    reference: Reference
    cocontraction: float

    def __call__(self, time: float, /) -> tuple[float, ...]:
        return (*self.reference(time)[:-1], self.cocontraction)


def variation(result: LoopResult) -> float:
    """Return by how much all set-points move in a second, in the unit of the motors."""
    P = np.column_stack([result[name] for name in result.robot.set_points]) / to_si(result.robot.motors.unit)[0]
    return float(np.abs(np.diff(P, axis=0)).sum() / result.time[-1])


def _distances(loop: Loop, task: Task) -> Vector:
    """Return the rms distance of the last turn to where the circle was 0, 1, ... samples ago (leads,), as shown."""
    scale = task.asked.certificate.scale
    leads = round(scale.time * _AHEAD / loop.controller.sample_time)
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
