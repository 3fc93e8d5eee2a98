"""One candidate, judged so far as its rank deserves: linear checks, loops, margins by experiment."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from softneck.core import KINDS, SoftneckError, Vector, make_settings, resolve
from softneck.design import AxisSettings, UncertainPlant, uncertain_plant
from softneck.identification import payloads
from softneck.runtime import Block
from softneck.verification import (
    LARGE,
    SMALL,
    ControllerUnderTest,
    OwnPlant,
    Plants,
    all_plants,
    crossing_values,
    crossings,
    judged,
    loops_under_test,
    margins,
    own_plant,
    run_steps,
    sources_of,
    tested_axes,
)
from softneck.verification import judge as under_test

from ._cases import Case, cases, run_case
from ._requirements import Task, has_observer

#: From quick to slow; each includes what those before it found.
LEVELS = ("linear", "all", "margins")
# Plants of the boxes on which linear checks are made: nominal, corners, samples; a certificate takes hundreds.
_PLANTS = 48
# The worse of two values of a metric is the smaller one of these.
_BETTER_LARGE = LARGE


@dataclass(frozen=True, slots=True, eq=False)
class Ready:
    """What a worker makes once of a task.

    Attributes:
        plants: linear ones, without the delay that a loop's order adds.
        frequency: on which they are judged [rad/s].
        weights: of the motors in each axis's input.
        uncertain: what linear designs make of the task's plant, made once.
        own: simulation models.
        all: the loops.
        kept: designs by kind and settings.
    """

    plants: Plants
    frequency: Vector
    weights: Any
    uncertain: UncertainPlant
    own: tuple[OwnPlant, ...]
    all: tuple[Case, ...]
    kept: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Judgement:
    """What came of a candidate at one level.

    Attributes:
        metrics: name -> value; inf where a level is never reached.
        error: why there is none; "" where there is.
    """

    metrics: Mapping[str, float]
    error: str = ""


def judge_candidate(task: Task, kind: str, settings: Mapping[str, Any], level: str) -> Judgement:
    """Return the metrics of the level alone; an error of ours about the candidate is its result."""
    try:
        ready = made_ready(task)
        controller = designed(task, ready, kind, settings)
        if level == "linear":
            return Judgement(linear_metrics(task, ready, controller))
        block, order = controller.block(), str(getattr(controller, "order", "sequential"))
        eyes = watched(task, kind)
        if level == "margins":
            return Judgement(margin_metrics(task, ready, block, order, eyes))
        return Judgement(loop_metrics(task, ready, block, order, ready.all, eyes))
    except SoftneckError as error:
        return Judgement({}, " ".join(str(error).split()))


def made_ready(task: Task) -> Ready:
    """Return what is made once of a task, in this process."""
    kept = _kept(task.digest)
    if "ready" not in kept:
        certificate = task.asked.certificate
        sources = sources_of(task.linear, certificate)
        plants = all_plants(sources, _PLANTS, int(certificate.sampling["seed"]))
        own = tuple(own_plant(thing, name, task.robot) for name, thing in task.own.items())
        kept["ready"] = Ready(
            plants, judged(plants.sample_time, certificate.scale.time), sources[0].weights,
            uncertain_plant(task.plant), own,
            cases(own, task.asked, task.robot),
        )  # fmt: skip
    return kept["ready"]


@lru_cache(maxsize=4)
def _kept(digest: str) -> dict[str, Ready]:
    del digest
    return {}


def designed(task: Task, ready: Ready, kind: str, settings: Mapping[str, Any]) -> Any:
    """Return the controller, or the one that this process has designed before."""
    key = json.dumps([kind, dict(settings)], sort_keys=True)
    if key not in ready.kept:
        made = make_settings(resolve(KINDS[kind].settings), settings)
        if task.observer is not None and hasattr(made, "over"):
            made = made.over(task.observer)
        ready.kept[key] = made.design(_plant_for(task, ready, kind, made))
    return ready.kept[key]


def _plant_for(task: Task, ready: Ready, kind: str, made: Any) -> Any:
    """Return what a kind designs on: all linear plants, or the one that it begins from.

    Of several nonlinear models the first that knows payloads.
    """
    if isinstance(made, AxisSettings):
        return ready.uncertain
    if kind == "nmpc":
        models = sorted(task.models, key=lambda model: payloads(model.arrays) is None)
        return models[0] if models else task.plant
    if kind == "adaptive":
        return next(iter(task.linear.values()))
    return task.plant  # more of a family is read than its plants


def watched(task: Task, kind: str) -> Block | None:
    """Return the observer that loops of a kind have; None for most kinds."""
    return task.observer.block() if task.observer is not None and has_observer(kind) else None


def linear_metrics(task: Task, ready: Ready, controller: Any) -> dict[str, float]:
    """Return margins over the boxes and over what the recordings show, and steps on the plants of the boxes."""
    asked = task.asked.certificate
    judged_one: ControllerUnderTest = under_test(controller, order=None, observer=False)
    plants = ready.plants.later(judged_one.extra)
    found: dict[str, float] = {}
    steep = float(asked.uncertainty["rolloff_db_per_decade"])
    for law in judged_one.laws.values():
        for name, values in margins(plants, law, ready.frequency).items():
            axis, _, last = name.partition(".")
            value = float(values.min() if last in _BETTER_LARGE else values.max())
            worse(found, name, value)
            if last in (*LARGE, *SMALL) and axis != "mimo":
                worse(found, f"axes.{last}", value)
        for item in tested_axes(task.linear, law, plants.axes, judged_one.extra, steep):
            # Nothing is certified of a loop that may cross where nobody recorded.
            values = item.margins or {**dict.fromkeys(LARGE, 0.0), "sensitivity": math.inf}
            for last, value in values.items():
                for group in (item.axis, "axes", *(("mimo",) if last == "disk_margin" else ())):
                    worse(found, f"{group}.{last}", float(value))
            worse(found, "robust.mu", item.mu)
    steps = run_steps(
        plants, judged_one.block, asked.step_test(task.seed), workers=1, robot=task.robot, weights=ready.weights
    )
    return found | {f"step.{asked.scale.name_of(name)}": float(values.max()) for name, values in steps.metrics.items()}


def worse(found: dict[str, float], name: str, value: float) -> None:
    """Note a value of a metric where it is worse than what is there."""
    pick = min if name.rpartition(".")[2] in _BETTER_LARGE else max
    found[name] = pick(found[name], value) if name in found else value


def loop_metrics(
    task: Task, ready: Ready, block: Block, order: str, chosen: Sequence[Case], observer: Block | None = None
) -> dict[str, float]:
    """Return the worst of all loops."""
    found: dict[str, float] = {}
    shifts: list[Vector] = []
    for case in chosen:
        values, distances = run_case(case, ready.own[case.plant], block, order, task, observer)
        for name, value in values.items():
            worse(found, name, value)
        if distances is not None:
            shifts.append(distances)
    if shifts:
        # One lead for all plants: the one whose worst distance is least.
        most = np.max(shifts, axis=0)
        best = int(np.argmin(most))
        Ts = block.sample_time
        name_of = task.asked.certificate.scale.name_of
        found |= {f"track.{name_of('ahead_rms_deg')}": float(most[best]), "track.ahead_s": best * Ts,
                  f"track.{name_of('circle_rms_deg')}": float(most[0])}  # fmt: skip
    return found


def margin_metrics(
    task: Task, ready: Ready, block: Block, order: str, observer: Block | None = None
) -> dict[str, float]:
    """Return the margins by experiment on the simulation models."""
    loops = loops_under_test(block, ready.own, task.asked.certificate, order=order, observer=observer)
    found = crossing_values(crossings(loops, overall=True)) if loops else {}
    return {name: float(values.min()) for name, (values, _) in found.items() if name.startswith("axes.")}
