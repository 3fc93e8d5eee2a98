"""What a search found: the front, what binds, and what each requirement costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from softneck.cosim.studies._store import pareto_rows
from softneck.verification._linear import LARGE
from softneck.verification._requirements import Requirement
from softneck.verification._verify import Verdict

from ._requirements import TuneRequirements
from ._search import Candidate, ratio

# What is traded, the first of each that was found; of the least ones the reciprocal counts.
_OBJECTIVES = (
    ("neck.rise_s", "step.rise_s"), ("neck.overshoot_pct", "step.overshoot_pct"), ("step.load_rms_",),
    ("neck.steady_rms_", "step.steady_rms_"), ("track.circle_rms_deg",), ("track.variation_rad_s",),
    ("axes.sensitivity",), ("axes.gain_margin",),
)  # fmt: skip
# Limits at which the price of a requirement is told, in parts of its own, and that of the best candidate.
_LOOSER = (1.0, 1.25, 1.5, 2.0)
# Whoever breaks any limit by more is nothing that somebody would trade for: half and double are what is asked, a little
# loosened, and beyond it is another requirement ("disk_margin 0.0151 costs sensitivity 66.7").
_NEAR = 2.0
# Of these a default is a wish about speed and precision: what the best reaches is told instead. Margins of stability,
# slack tendons and what a load may do are never loosened.
_LOOSENED = ("neck.rise_s", "neck.settling_s", "neck.overshoot_pct", "neck.steady_rms_", "step.rise_s",
             "step.settling_s", "step.overshoot_pct", "step.steady_rms_", "track.")  # fmt: skip
_ROOM = 1.05


@dataclass(frozen=True, slots=True)
class Price:
    """What one requirement costs another: with all others held and this one at `limit`, the other is `least`.

    Attributes:
        metric: what binds.
        limit: to which it is loosened.
        other: the metric that is paid with.
        least: its best value; None where no candidate keeps all others.
        held: whether all others are held; else they are no worse than in the best candidate.
    """

    metric: str
    limit: float
    other: str
    least: float | None
    held: bool = True


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
        """Return it as a clause for people: `neck.rise_s: 0.44, by default 0.40 is required`."""
        return f"{metric}: {self.reached:.3g}, by default {self.default:.3g} is required (certified: {self.limit:g})"


def nearest(item: Candidate, failed: Sequence[Verdict], asked: TuneRequirements) -> dict[str, Loosened]:
    """Return metric -> the default that the candidate does not keep, where it keeps all the rest.

    Nothing where anything else fails: a margin of stability, what somebody asked for, what was not computed, or what is
    missed by more than a factor of two.
    """
    broken = {verdict.requirement: verdict.value for verdict in failed}
    looped = [bound for bound in asked.bounds if bound.metric.startswith(("neck.", "track."))]
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
    return round(math.ceil(_ROOM * value / step - 1e-9) * step, 9)


def prices(items: Sequence[Candidate], bounds: Sequence[Requirement], metric: str, *, tested: bool) -> list[Price]:
    """Return the curve of what the requirement on `metric` costs: of the other that is broken most when it is held.

    Where no candidate keeps all the others, they are to be no worse than in the best one. Only candidates within a
    factor of two of every limit are compared.
    """
    item = next((bound for bound in bounds if bound.metric == metric), None)
    items = [one for one in items if max(one.ratios(bounds, tested=tested).values(), default=math.inf) <= _NEAR]
    best = min(items, key=lambda one: one.cost(bounds, tested=tested), default=None)
    if item is None or best is None:
        return []
    now = best.ratios(bounds, tested=tested)
    paid = _paid_with(items, bounds, item, tested=tested)
    for other, rest in ((paid, {}), (_broken_beside(bounds, item, now), now)):
        if other is None:
            continue
        found = []
        for part in sorted({*_LOOSER, max(1.0, now.get(metric, 1.0))}):
            least = _least(items, bounds, {metric: part, other.metric: math.inf}, rest, other, tested=tested)
            limit = item.limit / part if item.bound == "min" else item.limit * part
            found.append(Price(metric, limit, other.metric, least, held=not rest))
        if any(price.least is not None for price in found):
            return found
    return []


def _least(
    items: Sequence[Candidate], bounds: Sequence[Requirement], allowed: Mapping[str, float], now: Mapping[str, float],
    other: Requirement, *, tested: bool,
) -> float | None:  # fmt: skip
    """Return the best value of `other` of the candidates that keep what is allowed, and all else or what is now."""
    kept = [
        one.metrics[other.metric]
        for one in items
        if other.metric in one.metrics
        and all(
            value <= allowed.get(name, max(1.0, now.get(name, 1.0)))
            for name, value in one.ratios(bounds, tested=tested).items()
        )
    ]
    return (max(kept) if other.bound == "min" else min(kept)) if kept else None


def _broken_beside(bounds: Sequence[Requirement], item: Requirement, now: Mapping[str, float]) -> Requirement | None:
    """Return the requirement that the best candidate breaks most beside `item`, or its rise: speed pays for all."""
    others = {name: value for name, value in now.items() if name != item.metric and 1.0 < value < math.inf}
    rises = [name for name in ("neck.rise_s", "step.rise_s") if name in now and name != item.metric]
    name = max(others, key=lambda key: others[key]) if others else next(iter(rises), None)
    return next((bound for bound in bounds if bound.metric == name), None)


def _paid_with(
    items: Sequence[Candidate], bounds: Sequence[Requirement], item: Requirement, *, tested: bool
) -> Requirement | None:
    """Return the requirement that is broken least when `item` is held, alone if that can be."""
    best: tuple[int, float, Requirement] | None = None
    for one in items:
        found = one.ratios(bounds, tested=tested)
        if found.get(item.metric, math.inf) > 1.0:
            continue
        broken = {name: value for name, value in found.items() if value > 1.0}
        if not broken:
            continue
        name = max(broken, key=lambda key: broken[key])
        bound = next(bound for bound in bounds if bound.metric == name)
        rank = (len(broken), broken[name])
        if name in one.metrics and (best is None or rank < best[:2]):
            best = (*rank, bound)
    return None if best is None else best[2]


def in_words(prices: Sequence[Price]) -> str:
    """Return prices as a sentence, one clause for all that are paid with the same; "" where none is known."""
    told = []
    for (metric, other, held), alike in groupby(
        (price for price in prices if price.least is not None),
        key=lambda price: (price.metric, price.other, price.held),
    ):
        items = list(alike)
        limits, least = (", ".join(f"{value:.3g}" for value in part if value is not None)
                         for part in ([p.limit for p in items], [p.least for p in items]))  # fmt: skip
        told.append(f"{metric} {limits} costs {other} {least}" + ("" if held else ", all else as it is"))
    return "; ".join(told)


def _small(name: str, value: float) -> float:
    return -value if name.rpartition(".")[2] in LARGE else value


def ratio_of(item: Candidate, bound: Requirement) -> float | None:
    """Return how far a candidate is from a bound; None where it is not known."""
    value = item.metrics.get(bound.metric)
    return None if value is None or math.isnan(value) else ratio(bound, value)
