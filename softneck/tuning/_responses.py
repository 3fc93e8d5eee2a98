"""What a candidate does in time, for pictures and for the loop that goes with it: steps on the hardest plant."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from softneck.core import SoftneckError, Vector
from softneck.loop import run_loop
from softneck.loop._result import shown_unit
from softneck.verification._neck_loops import judge_loop
from softneck.verification._requirements import Requirement
from softneck.verification._steps import StepTest, run_steps

from ._cases import Case, loop_of
from ._judge import designed, made_ready, watched
from ._search import Candidate, ratio
from ._task import Task


def step_response(task: Task, item: Candidate) -> tuple[Vector, Vector, Vector]:
    """Return time (n,) [s], output and reference (n,) of the first output, in its display unit: the heaviest payload.

    Without a plant that steps, on the nominal linear one.
    """
    ready = made_ready(task)
    controller = designed(task, ready, item.kind, item.settings)
    block, order = controller.block(), str(getattr(controller, "order", "sequential"))
    name, factor = task.robot.outputs.names[0], shown_unit(task.robot)[1]
    per = math.radians(1.0) if factor is None else factor
    asked = task.asked.certificate
    if not ready.own:
        step = asked.si(asked.step["size_deg"])
        test = StepTest(step=step, duration=float(asked.step["duration_s"]), noise=0.0, load=0.0, seed=task.seed)
        found = run_steps(ready.plants.take(0), block, test, workers=1, robot=task.robot, weights=ready.weights)
        half = found.time.size // 2
        return found.time[:half], found.angles[0, 0, :half] / per, np.full(half, step / per)
    case = Case(len(ready.own) - 1, max(map(float, ready.own[-1].payloads(asked.neck["payloads_kg"]))))
    result = run_loop(loop_of(case, ready.own[case.plant], block, order, task, watched(task, item.kind)), compiled=True)
    reference = result[f"{name}_reference"]
    first = max(0, int(np.argmax(reference != reference[0])) - round(0.1 / result.sample_time))
    return result.time[first:] - result.time[first], result.angle(name)[first:] / per, reference[first:] / per


def kept_with(task: Task, item: Candidate, observer: Any, bounds: tuple[Requirement, ...]) -> bool:
    """Return whether the plain steps keep their requirements with an observer in the loop."""
    ready = made_ready(task)
    controller = designed(task, ready, item.kind, item.settings)
    block, eyes = controller.block(), observer.block()
    order = str(getattr(controller, "order", "sequential"))
    worst: dict[str, float] = {}
    try:
        for case in (case for case in ready.all if not case.circle and not case.late and case.part == 1.0):
            loop = loop_of(case, ready.own[case.plant], block, order, task, eyes)
            worst |= _worst(worst, judge_loop(loop)[0])
    except SoftneckError:
        return False
    named = {f"neck.{task.asked.certificate.name_of(name)}": value for name, value in worst.items()}
    return bool(named) and all(ratio(b, named[b.metric]) <= 1.0 for b in bounds if b.metric in named)


def _worst(before: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    return {name: max(value, before.get(name, -math.inf)) for name, value in values.items() if not math.isnan(value)}
