"""Compare candidates: the Pareto front, the active requirement, and the defaults that may be relaxed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.cosim import pareto_rows
from softneck.verification import (
    LARGE,
    Requirement,
    Verdict,
    round_12_digits,
)

from ._requirements import (
    TuneRequirements,
)
from ._search import Candidate

# Objectives of the Pareto front: the first metric of each group that was computed.
_OBJECTIVE_METRICS = (
    ("sim.rise_s", "step.rise_s"), ("sim.overshoot_pct", "step.overshoot_pct"), ("step.load_rms_",),
    ("sim.steady_rms_", "step.steady_rms_"), ("track.circle_rms_",), ("track.variation_",),
    ("axes.sensitivity",), ("axes.gain_margin",),
)  # fmt: skip
# Largest factor by which a default limit is relaxed; beyond it, it would be another requirement.
_MAX_RELAXATION = 2.0
# Defaults of speed and precision, which may be relaxed. Stability margins, slack tendons and load errors never are.
_RELAXABLE_METRICS = ("sim.rise_s", "sim.settling_s", "sim.overshoot_pct", "sim.steady_rms_", "step.rise_s",
             "step.settling_s", "step.overshoot_pct", "step.steady_rms_", "track.")  # fmt: skip
_RELAXATION_MARGIN = 1.05


def objectives(items: Sequence[Candidate]) -> list[str]:
    """Return the objectives that all candidates have."""
    names = set.intersection(*(set(item.metrics) for item in items)) if items else set()
    found = []
    for group in _OBJECTIVE_METRICS:
        match = next((name for start in group for name in sorted(names) if name.startswith(start)), None)
        if match is not None:
            found.append(match)
    return found


def front(items: Sequence[Candidate], names: Sequence[str]) -> list[Candidate]:
    """Return the Pareto-optimal candidates, sorted by the first objective."""
    signs = {name: -1.0 if name.rpartition(".")[2] in LARGE else 1.0 for name in names}
    table = np.array([[signs[name] * item.metrics[name] for name in names] for item in items])
    if not table.size:
        return []
    finite = np.isfinite(table).all(axis=1)
    rows = np.flatnonzero(finite)
    kept = rows[pareto_rows(table[finite])]
    return sorted((items[i] for i in kept), key=lambda item: item.metrics[names[0]])


def active_requirement(
    items: Sequence[Candidate], bounds: Sequence[Requirement], *, tested: bool
) -> tuple[str | None, float | None]:
    """Return the active requirement and the limit of it alone at which a candidate would meet all.

    It is the requirement with the smallest such change. Where one change is not enough, it is the one that the best
    candidate exceeds most, with None as the limit. Both are None where all computed requirements hold.
    """
    factors: dict[str, float] = {}
    for item in items:
        broken = {name: value for name, value in item.ratios(bounds, tested=tested).items() if value > 1.0}
        if not broken:
            return None, None
        name, value = next(iter(broken.items()))
        if len(broken) == 1 and name in item.metrics:
            factors[name] = min(value, factors.get(name, math.inf))
    if factors:
        name = min(factors, key=lambda name: factors[name])
        item = next(bound for bound in bounds if bound.metric == name)
        return name, item.limit / factors[name] if item.bound == "min" else item.limit * factors[name]
    best = min(items, key=lambda item: item.cost(bounds, tested=tested), default=None)
    if best is None:
        return None, None
    found = {name: value for name, value in best.ratios(bounds, tested=tested).items() if name in best.metrics}
    return (max(found, key=lambda name: found[name]) if max(found.values(), default=0.0) > 1.0 else None), None


@dataclass(frozen=True, slots=True)
class Loosened:
    """A default that no candidate meets beside the rest.

    `default`: its limit. `reached`: value of the best candidate. `limit`: certified instead.
    """

    default: float
    reached: float
    limit: float

    def in_words(self, metric: str) -> str:
        """Return a text such as `sim.rise_s: 0.44, by default 0.40 is required`."""
        return f"{metric}: {self.reached:.3g}, by default {self.default:.3g} is required (certified: {self.limit:g})"


def relaxations(item: Candidate, failed: Sequence[Verdict], asked: TuneRequirements) -> dict[str, Loosened]:
    """Return metric -> default that the candidate does not meet, if all others hold.

    Empty if a margin or a stated requirement fails, was not computed, or is missed by more than a factor of 2.
    """
    asked_for = {(b.metric, b.bound): b for b in asked.bounds}  # a verdict may be of a relaxed limit
    broken = {asked_for.get((v.requirement.metric, v.requirement.bound), v.requirement): v.value for v in failed}
    looped = [bound for bound in asked.bounds if bound.metric.startswith(("sim.", "track."))]
    for bound in looped:  # `verify` has no loops with noise
        seen = item.metrics.get(bound.metric)
        if seen is not None and not bound.holds(seen):
            broken[bound] = max(seen, broken.get(bound) or 0.0)
    found = {}
    for bound, value in broken.items():
        free = bound.metric.startswith(_RELAXABLE_METRICS) and bound.metric not in asked.stated and bound.bound == "max"
        kept = math.inf if value is None else _round_up(value)
        if not free or not kept <= _MAX_RELAXATION * bound.limit:
            return {}
        found[bound.metric] = Loosened(bound.limit, value or math.nan, kept)
    return found


def _round_up(value: float) -> float:
    """Return a limit in two digits, 5 % above a value, as other loops have other noise."""
    if not 0.0 < value < math.inf:
        return math.inf
    step = 10.0 ** (math.floor(math.log10(_RELAXATION_MARGIN * value)) - 1)
    return round_12_digits(math.ceil(_RELAXATION_MARGIN * value / step - 1e-9) * step)
