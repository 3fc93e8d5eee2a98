"""Certify the best of a search, and resume the search beside draws on which it fails."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from types import MappingProxyType
from typing import Any

from softneck.core import (
    CheckFailedError,
    Progress,
    SettingsError,
    SoftneckError,
    silent,
)
from softneck.runtime import Block
from softneck.verification import (
    Drawn,
    Requirement,
    Verdict,
    Verification,
    judge_loop,
    verify,
)

from ._compare import Loosened, relaxations
from ._judge import LEVELS, design_candidate, keep_worse, loop_of, make_observer, prepare, search_draws
from ._requirements import relax_limits
from ._search import Candidate, Search, best_of_kinds, ratio
from ._task import MARGINS, Log, Task

# Number of the best candidates that are verified until one holds.
_MAX_VERIFICATIONS = 2
# Number of all verifications, if a family has draws for so many.
_MAX_ATTEMPTS = 5
# Where draws fail: the number of them that join the search, of candidates with which it resumes, and its
# share of the budget.
_MORE_DRAWS, _RESUMED, _RESUMED_SHARE = 3, 6, 0.4
# Speeds whose default is relaxed, without another search, where the best misses it by no more than this factor.
_SPEED_METRICS, _NEAR = ("sim.rise_s", "sim.settling_s"), 1.15


@dataclass(frozen=True, slots=True)
class Certified:
    """A candidate with its controller, whether its loop has the observer, and the verification of that loop.

    `kept`: defaults that the candidate does not meet in its search; it is verified with those that it meets.
    """

    item: Candidate
    controller: Any
    observed: bool
    verification: Verification
    kept: Mapping[str, Loosened] = field(default_factory=dict)


def certify_search(
    search: Search, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> tuple[Search, Certified, int]:
    """Return a search that ended, its certified best and the number of verifications.

    Where draws of the search or of its certificate fail, the worst of them join the plants and the search resumes.
    """
    task, best = search.task, next(iter(search.sort_candidates()), None)
    failed = [] if best is None else _failed_in_search(task, best)
    drawn = _drawn_in_search(task, best) if best and failed else []
    failing = _failing_draws(drawn, failed)
    certified, tried = (None, 0) if failing else _verify_best(search, 0, files, progress)
    if certified is not None:
        verification = certified.verification
        if not (verification.holds or _is_near(certified.item, verification.failed, task)):
            failed = verification.failed
            failing = _failing_draws(verification.evidence.drawn, failed)
        if not failing or tried >= most_attempts(task):
            return search, certified, tried
    digest = hashlib.sha256("\n".join([task.digest, *failing]).encode()).hexdigest()
    more = replace(
        task, own={**task.own, **failing}, drawn=(*task.drawn, *failing), digest=digest,
        asked=replace(task.asked, kept=_more_kept(task.asked.kept, failed)),
    )  # fmt: skip
    prepare(more).kept.update(prepare(task).kept)  # designs need no draws
    again = replace(
        search, task=more, log=Log(None, digest), budget=round(_RESUMED_SHARE * search.budget), candidates={},
        spent=set(), earlier=len(search.spent),
    )  # fmt: skip
    again.resume(best_of_kinds(search.sort_candidates())[:_RESUMED])
    if again.sort_candidates():
        search, certified = again, None
    if certified is None:
        certified, tried = _verify_best(search, tried, files, progress)
    return search, certified, tried


def _is_near(item: Candidate, failed: Sequence[Verdict], task: Task) -> bool:
    """Return whether defaults of speed alone fail, by little: they are relaxed instead."""
    missed = relaxations(item, failed, task.asked)
    return bool(missed) and all(
        metric in _SPEED_METRICS and one.reached <= _NEAR * one.default for metric, one in missed.items()
    )


def _failed_in_search(task: Task, item: Candidate) -> list[Verdict]:
    """Return what a candidate fails on the draws that a search may see; none if it is near."""
    found = item.metrics
    failed = [Verdict(b, found[b.metric], False, {}) for b in task.bounds
              if task.drawn and b.metric in found and not b.holds(found[b.metric])]  # fmt: skip
    return [] if _is_near(item, failed, task) else failed


def _drawn_in_search(task: Task, item: Candidate, observer: Block | None = None) -> list[Drawn]:
    """Return the loops over the draws of the search, with this observer or that of the kind."""
    controller = design_candidate(task, prepare(task), item.kind, item.settings)
    order = str(getattr(controller, "order", "sequential"))
    eyes = make_observer(task, item.kind) if observer is None else observer
    return search_draws(task, controller.block(), order, eyes)


def _more_kept(kept: Mapping[str, float], failed: Sequence[Verdict]) -> dict[str, float]:
    """Return how far a search stays within its limits where draws have smaller margins than the plants that led it."""
    short = {v.requirement.metric: v.requirement.limit - (v.value or 0.0) for v in failed
             if v.requirement.metric in MARGINS}  # fmt: skip
    return {metric: value + short.get(metric, 0.0) for metric, value in kept.items()}


def _failing_draws(drawn: Sequence[Drawn], failed: Sequence[Verdict]) -> dict[str, Any]:
    """Return name -> the draws with the worst values of what fails."""
    found = {}
    for part, verdict in product(drawn, failed):
        bound = verdict.requirement
        number = part.worst(bound.metric, largest=bound.bound != "min")
        if number is not None:  # one that is the worst in several metrics joins once
            found.setdefault((part.family, number), (f"{part.family}, attempt {part.attempt}, {bound.metric}", part))
    joined = list(found.items())[:_MORE_DRAWS]
    return {name: part.model(number) for (_, number), (name, part) in joined}


def most_attempts(task: Task) -> int:
    """Return the number of certificates that the draws of all families allow."""
    drawn = [thing.draws for thing in task.linear.values() if getattr(thing, "draws", None) is not None]
    return min([_MAX_ATTEMPTS, *(draws.attempts for draws in drawn)])


def _verify_best(
    search: Search, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> tuple[Certified, int]:
    """Return the first of the best whose certificate holds, else the best, and the number of verifications so far."""
    compared, found = compared_candidates(search), []
    # Those that hold on all draws of the search come first, then those that hold on the few of every loop; of each kind
    # the best first, as its neighbours miss the same.
    task = search.task
    promising = [
        item for item in best_of_kinds(compared)
        if search.cost(item) <= 1.0 or (item.level == LEVELS[-1] and item.holds(task.bounds, tested=task.tested))
    ][:_MAX_VERIFICATIONS] or compared[:1]  # fmt: skip
    for number, item in zip(range(tried + 1, most_attempts(search.task) + 1), promising, strict=False):
        progress((number - tried - 1) / len(promising), f"verify {item.kind}")
        found.append(certify(search.task, item, files, number, relaxations(item, (), search.task.asked)))
        if found[-1].verification.holds:
            return found[-1], number
    return found[0], tried + len(found)


def compared_candidates(search: Search) -> list[Candidate]:
    """Return the candidates that loops have judged, else all, the best first."""
    ranked = search.sort_candidates()
    if not ranked:
        why = "; ".join(f"{kind}: {text}" for kind, text in search.dropped.items())
        if any(space.kind not in search.dropped for space in search.spaces):
            raise CheckFailedError(f"the budget ended before any candidate was judged ({why}); increase it.")
        raise SettingsError(f"no candidate controller could be designed ({why}).")
    return [item for item in ranked if LEVELS.index(item.level) >= 1] or ranked


def certify(
    task: Task, item: Candidate, files: Mapping[str, tuple[str, str]] | None, attempt: int,
    kept: Mapping[str, Loosened] = MappingProxyType({}),
) -> Certified:  # fmt: skip
    """Return the verification of a candidate's loop, with the observer where its steps hold with it."""
    controller = design_candidate(task, prepare(task), item.kind, item.settings)
    observed = _observed(task, item)
    verification = _verify_loop(relaxed(task, kept), controller, observed, files, attempt)
    return Certified(item, controller, observed, verification, kept)


def relaxed(task: Task, kept: Mapping[str, Loosened]) -> Task:
    """Return the task with the limits that a candidate meets."""
    limits = {metric: one.limit for metric, one in kept.items()}
    return replace(task, asked=relax_limits(task.asked, limits)) if limits else task


def certify_again(task: Task, made: Certified, files: Mapping[str, tuple[str, str]] | None, attempt: int) -> Certified:
    """Return the same loop, verified with the requirements of this task."""
    return replace(made, verification=_verify_loop(task, made.controller, made.observed, files, attempt))


def _verify_loop(
    task: Task, controller: Any, observed: bool, files: Mapping[str, tuple[str, str]] | None, attempt: int
) -> Verification:
    plants = {**task.linear, **{name: thing for name, thing in task.own.items() if name not in task.drawn}}
    return verify(
        controller, plants, task.asked.certificate, files=files, progress=silent, attempt=attempt,
        observer=task.observer if observed else None,
    )  # fmt: skip


def _observed(task: Task, item: Candidate) -> bool:
    """Return whether steps, and the draws of the search, hold with the observer and rise as soon as without it."""
    eyes = task.observer
    if make_observer(task, item.kind) is not None:
        return True
    if eyes is None or not task.own or not holds_with_observer(task, item, eyes, task.bounds):
        return False
    rise = item.metrics.get("sim.rise_s", math.inf)
    drawn = _drawn_in_search(task, item, eyes.block())
    return all(not part.failed and part.values["sim.rise_s"].max() <= rise for part in drawn)


def holds_with_observer(task: Task, item: Candidate, observer: Any, bounds: tuple[Requirement, ...]) -> bool:
    """Return whether the full-size steps meet their requirements with an observer in the loop, and rise as soon."""
    ready = prepare(task)
    controller = design_candidate(task, ready, item.kind, item.settings)
    block, eyes = controller.block(), observer.block()
    order = str(getattr(controller, "order", "sequential"))
    worst: dict[str, float] = {}
    try:
        for case in (case for case in ready.all if not case.circle and not case.late and case.part == 1.0):
            loop = loop_of(case, ready.own[case.plant], block, order, task, eyes)
            for name, value in judge_loop(loop)[0].items():
                # Without tension outputs there is no slack to know.
                if name != "slack_s" or not math.isnan(value):
                    keep_worse(worst, name, value)
    except SoftneckError:
        return False
    named = {f"sim.{task.asked.certificate.scale.name_of(name)}": value for name, value in worst.items()}
    if not named or not named["sim.rise_s"] <= item.metrics.get("sim.rise_s", math.inf):
        return False
    return all(ratio(b, named[b.metric]) <= 1.0 for b in bounds if b.metric in named)
