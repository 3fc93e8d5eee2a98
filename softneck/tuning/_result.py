"""What a search found: the front, what binds, defaults that are nearly kept, and what candidates do in time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import SoftneckError, Vector
from softneck.cosim import pareto_rows
from softneck.loop import run_loop
from softneck.verification import LARGE, Requirement, Verdict, digits, judge_loop, run_steps

from ._cases import Case, loop_of
from ._judge import designed, made_ready, watched
from ._requirements import Task, TuneRequirements
from ._search import Candidate, ratio

# What is traded, the first of each that was found; of the least ones the reciprocal counts.
_OBJECTIVES = (
    ("sim.rise_s", "step.rise_s"), ("sim.overshoot_pct", "step.overshoot_pct"), ("step.load_rms_",),
    ("sim.steady_rms_", "step.steady_rms_"), ("track.circle_rms_",), ("track.variation_",),
    ("axes.sensitivity",), ("axes.gain_margin",),
)  # fmt: skip
# Whoever breaks any limit by more is nothing that somebody would trade for: half and double are what is asked, a little
# loosened, and beyond it is another requirement ("disk_margin 0.0151 costs sensitivity 66.7").
_NEAR = 2.0
# Of these a default is a wish about speed and precision: what the best reaches is told instead. Margins of stability,
# slack tendons and what a load may do are never loosened.
_LOOSENED = ("sim.rise_s", "sim.settling_s", "sim.overshoot_pct", "sim.steady_rms_", "step.rise_s",
             "step.settling_s", "step.overshoot_pct", "step.steady_rms_", "track.")  # fmt: skip
_ROOM = 1.05


def objectives(items: Sequence[Candidate]) -> list[str]:
    """Return the metrics that are traded, of those that all candidates of the last level have."""
    names = set.intersection(*(set(item.metrics) for item in items)) if items else set()
    found = []
    for group in _OBJECTIVES:
        match = next((name for start in group for name in sorted(names) if name.startswith(start)), None)
        if match is not None:
            found.append(match)
    return found


def front(items: Sequence[Candidate], names: Sequence[str]) -> list[Candidate]:
    """Return the candidates that none beats in one objective without losing in another, by the first objective."""
    table = np.array([[_small(name, item.metrics[name]) for name in names] for item in items])
    if not table.size:
        return []
    finite = np.isfinite(table).all(axis=1)
    rows = np.flatnonzero(finite)
    kept = rows[pareto_rows(table[finite])]
    return sorted((items[i] for i in kept), key=lambda item: item.metrics[names[0]])


def binding(
    items: Sequence[Candidate], bounds: Sequence[Requirement], *, tested: bool
) -> tuple[str | None, float | None]:
    """Return the requirement that stands in the way, None where a candidate keeps all that were computed of it.

    And the value to which it alone would have to be loosened; None where that does not do.

    It is the one that must be loosened least, alone, for some candidate to keep the rest; where none does, the one
    that the best candidate breaks most. What was not computed is broken all the same, but nothing is known to bind.
    """
    loosened: dict[str, float] = {}
    for item in items:
        broken = {name: value for name, value in item.ratios(bounds, tested=tested).items() if value > 1.0}
        if not broken:
            return None, None
        name, value = next(iter(broken.items()))
        if len(broken) == 1 and name in item.metrics:
            loosened[name] = min(value, loosened.get(name, math.inf))
    if loosened:
        name = min(loosened, key=lambda name: loosened[name])
        item = next(bound for bound in bounds if bound.metric == name)
        return name, item.limit / loosened[name] if item.bound == "min" else item.limit * loosened[name]
    best = min(items, key=lambda item: item.cost(bounds, tested=tested), default=None)
    if best is None:
        return None, None
    found = {name: value for name, value in best.ratios(bounds, tested=tested).items() if name in best.metrics}
    return (max(found, key=lambda name: found[name]) if max(found.values(), default=0.0) > 1.0 else None), None


@dataclass(frozen=True, slots=True)
class Loosened:
    """A default that no candidate keeps beside the rest.

    Attributes:
        default: what it asks.
        reached: by the best candidate.
        limit: what is certified instead.
    """

    default: float
    reached: float
    limit: float

    def in_words(self, metric: str) -> str:
        """Return it as a clause for people: `sim.rise_s: 0.44, by default 0.40 is required`."""
        return f"{metric}: {self.reached:.3g}, by default {self.default:.3g} is required (certified: {self.limit:g})"


def nearest(item: Candidate, failed: Sequence[Verdict], asked: TuneRequirements) -> dict[str, Loosened]:
    """Return metric -> the default that the candidate does not keep, where it keeps all the rest.

    Nothing where anything else fails: a margin of stability, what somebody asked for, what was not computed, or what is
    missed by more than a factor of two.
    """
    broken = {verdict.requirement: verdict.value for verdict in failed}
    looped = [bound for bound in asked.bounds if bound.metric.startswith(("sim.", "track."))]
    for bound in looped:  # in loops with noise, which `verify` does not close
        seen = item.metrics.get(bound.metric)
        if seen is not None and not bound.holds(seen):
            broken[bound] = max(seen, broken.get(bound) or 0.0)
    found = {}
    for bound, value in broken.items():
        free = bound.metric.startswith(_LOOSENED) and bound.metric not in asked.stated and bound.bound == "max"
        kept = math.inf if value is None else _above(value)
        if not free or not kept <= _NEAR * bound.limit:
            return {}
        found[bound.metric] = Loosened(bound.limit, value or math.nan, kept)
    return found


def _above(value: float) -> float:
    """Return a limit that a value keeps with some room, in two digits: the next loop has other noise."""
    if not 0.0 < value < math.inf:
        return math.inf
    step = 10.0 ** (math.floor(math.log10(_ROOM * value)) - 1)
    return digits(math.ceil(_ROOM * value / step - 1e-9) * step)


def _small(name: str, value: float) -> float:
    return -value if name.rpartition(".")[2] in LARGE else value


def step_response(task: Task, item: Candidate) -> tuple[Vector, Vector, Vector]:
    """Return time (n,) [s], output and reference (n,) of the first output, in its display unit: the heaviest payload.

    Without a simulation model, on the nominal linear one.
    """
    ready = made_ready(task)
    controller = designed(task, ready, item.kind, item.settings)
    block, order = controller.block(), str(getattr(controller, "order", "sequential"))
    name, asked = task.robot.outputs.names[0], task.asked.certificate
    shown = asked.scale.shown
    if not ready.own:
        test = replace(asked.step_test(task.seed), noise=0.0, load=0.0)
        found = run_steps(ready.plants.take(0), block, test, workers=1, robot=task.robot, weights=ready.weights)
        half = found.time.size // 2
        return found.time[:half], shown(found.angles[0, 0, :half]), np.full(half, shown(test.step))
    case = Case(len(ready.own) - 1, max(map(float, ready.own[-1].payloads(asked.sim["payloads_kg"]))))
    result = run_loop(loop_of(case, ready.own[case.plant], block, order, task, watched(task, item.kind)), compiled=True)
    reference = result[f"{name}_reference"]
    first = max(0, int(np.argmax(reference != reference[0])) - round(0.1 / result.sample_time))
    return result.time[first:] - result.time[first], shown(result.angle(name)[first:]), shown(reference[first:])


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
    named = {f"sim.{task.asked.certificate.scale.name_of(name)}": value for name, value in worst.items()}
    return bool(named) and all(ratio(b, named[b.metric]) <= 1.0 for b in bounds if b.metric in named)


def _worst(before: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    return {name: max(value, before.get(name, -math.inf)) for name, value in values.items() if not math.isnan(value)}
