"""Tune a controller to requirements: the search, the certificate of its best, and the result."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    CheckFailedError,
    Progress,
    SettingsError,
    SoftneckError,
    one_blas_thread,
    require_whole,
    shown_progress,
    silent,
)
from softneck.cosim import open_workers, pareto_rows
from softneck.estimation import KalmanSettings, directions_of, robot_of
from softneck.identification import payloads
from softneck.robot import Robot, Scaling, load_for_robot
from softneck.runtime import Block
from softneck.signals import require_same_robot
from softneck.verification import (
    LARGE,
    Drawn,
    Requirement,
    Scale,
    SimulationModel,
    Verdict,
    Verification,
    is_simulation_model,
    judge_loop,
    named_plants,
    round_12_digits,
    sources_of,
    verify,
    with_robot,
)

from ._judge import LEVELS, design_candidate, keep_worse, loop_of, make_observer, prepare, search_draws, told_conditions
from ._requirements import (
    USUAL_RISE,
    TuneRequirements,
    check_feasibility,
    default_rise,
    fastest_rise,
    make_tune_requirements,
    read_tune_requirements,
    relax_limits,
)
from ._search import Candidate, Search, best_of_kinds, ratio
from ._space import KINDS_SEARCHED, UNCERTIFIED, spaces
from ._task import MARGINS, Log, Task, digest_of

#: Default number of judgements of candidates.
BUDGET = 160
# Draws of a family in every loop of a search; final candidates are judged on more, and certificates have others.
_SEARCHED_DRAWS = 4
# Number of the best candidates that are verified until one holds.
_MAX_VERIFICATIONS = 2
# Number of all verifications, if a family has draws for so many.
_MAX_ATTEMPTS = 5
# Where draws fail: the number of them that join the search, of candidates with which it resumes, and its
# share of the budget.
_MORE_DRAWS, _RESUMED, _RESUMED_SHARE = 3, 6, 0.4
# Speeds whose default is relaxed, without another search, where the best misses it by no more than this factor.
_SPEED_METRICS, _NEAR = ("sim.rise_s", "sim.settling_s"), 1.15
# How much longer the rise may take with an observer that a kind does not need.
_SLOWER = 1.1
_UNCERTIFIED_REASON = "beside recordings nothing is certified of it; name it in --kinds to search it all the same"
# Smaller co-contractions, of a neck, set no rule.
_MIN_COCONTRACTION_RAD = 0.05


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Tuned:
    """Result of a search.

    Attributes:
        best: the first of the best candidates whose certificate holds, else the one with the least cost.
        controller: of `best`.
        assumed: values of the paper's neck that its design uses.
        observer: for the loop; None if none can be built on the nominal plant.
        observed: whether the steps meet their requirements with it.
        verification: result of `verify` with the same requirements.
        holds: whether all requirements hold, those of the certificate and those of [track].
        candidates: those judged by all loops, the best first.
        front: Pareto-optimal candidates.
        objectives: the metrics of the front.
        binding: the active requirement, which prevents a solution; None where all hold.
        nearest: the limit of it alone at which all would hold; None if there is none.
        loosened: metric -> default that the best does not meet; `task` has the limit that it meets.
        evaluations: number of judgements.
        dropped: kind -> why it was not searched.
        task: what was tuned.
        own: simulation models.
    """

    best: Candidate
    controller: Any
    assumed: Mapping[str, float]
    observer: Any
    observed: bool
    verification: Verification
    holds: bool
    candidates: list[Candidate]
    front: list[Candidate]
    objectives: list[str]
    binding: str | None
    nearest: float | None
    evaluations: int
    dropped: Mapping[str, str]
    task: Task
    own: Sequence[SimulationModel] = ()
    loosened: Mapping[str, Loosened] = field(default_factory=dict)

    def judged_elsewhere(self) -> dict[str, str]:
        """Return condition -> what was judged instead of it, for each that was asked and not judged as it is."""
        return told_conditions(self.task, self.own, self.controller.block().sample_time)


@one_blas_thread
def tune(
    plants: Any,
    requirements: TuneRequirements | Mapping[str, Any] | str | Path | None = None,
    *,
    kinds: str | Sequence[str] = (),
    budget: int = BUDGET,
    observer: Any = None,
    seed: int = 0,
    workers: int | None = None,
    folder: str | Path | None = None,
    force: bool = False,
    files: Mapping[str, tuple[str, str]] | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Return the best controller of some kinds for plants and requirements.

    The same plants, requirements, kinds, budget and seed give the same result, whatever the number of workers.

    Args:
        plants: families and linear models (at least one; the first is the nominal plant) and simulation models
            (nonlinear models, neck parameters, FMUs, functions that return a part): one, a list, or name -> one,
            objects or files.
        requirements: beside the defaults: a file, a table like one, or flat as in `{"overshoot_pct": 5}`.
        kinds: of controllers, also as "pi,mpc"; default `KINDS_SEARCHED`, beside recordings without `UNCERTIFIED`.
        budget: number of judgements of candidates; 40 % more where draws of a family fail.
        observer: of the loop; default a Kalman filter over the nominal plant.
        seed: of the search and of the noise in its loops.
        workers: processes; default one per core, 0 for this process.
        folder: of the log; the same call continues its search.
        force: replace another search in `folder`.
        files: role -> (path, SHA-256) of the files read, for the certificate.
        progress: called with progress and the best so far; default a bar in a terminal.

    Raises:
        SettingsError: no linear plant, an unknown kind, or requirements that contradict each other or the motors.
        OutputFileError: `folder` holds another search.
        CheckFailedError: the budget ended before any candidate was judged.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> model = softneck.identify("rls", softneck.record("eq22", neck, seed=1))
        >>> softneck.tune(model, {"overshoot_pct": 20}, kinds="pi", budget=12, workers=0).best.kind
        'pi'
    """
    require_whole("budget", budget, 1, 1_000_000)
    require_whole("seed", seed, 0, 2**31 - 2)
    kinds = tuple(kinds.split(",") if isinstance(kinds, str) else kinds)
    folder = None if folder is None else Path(folder)
    task = task_of(plants, requirements, seed)
    dropped = {} if kinds or not task.tested else dict.fromkeys(UNCERTIFIED, _UNCERTIFIED_REASON)
    chosen = tuple(kind for kind in dict.fromkeys(kinds or KINDS_SEARCHED) if kind not in dropped)
    observer = None if observer is None else load_for_robot(observer, "observer")
    if observer is not None:
        require_same_robot(robot_of(observer), task.robot, "the observer and the plants")
    check_feasibility(task.asked, task.plant)
    each = spaces(
        chosen, rise=_target_rise(task), robot=task.robot, least=fastest_rise(task.plant),
        cocontraction=None if task.cocontraction is None else float(f"{task.cocontraction:.4g}"),
    )  # fmt: skip
    task = replace(task, observer=_observer(task) if observer is None else observer)
    task = replace(task, digest=digest_of(task, chosen, files))
    prepare(task)  # report a plant that does not fit before the search
    log = Log(folder, task.digest, force=force)
    with shown_progress("tune", progress) as tell:
        with open_workers(workers, None) as members:
            search = Search(task, each, members, log, budget, lambda done, text: tell(0.9 * done, text))
            search.dropped |= dropped
            search.run()
            search, certified, tried = _certify_search(search, files, lambda done, text: tell(0.9 + 0.1 * done, text))
        return _make_result(search, certified, tried, files, lambda done, text: tell(0.9 + 0.1 * done, text))


def task_of(plants: Any, requirements: TuneRequirements | Mapping[str, Any] | str | Path | None, seed: int) -> Task:
    """Return the task; all plants must be of one robot."""
    plants = named_plants(plants)
    own = {name: thing for name, thing in plants.items() if is_simulation_model(thing)}
    linear = {name: thing for name, thing in plants.items() if name not in own}
    if not linear:
        raise SettingsError("no linear plant to design on: add a FAMILY (`softneck family`) or a linear MODEL.")
    first = next(iter(linear))
    robot = robot_of(linear[first])
    for name, thing in plants.items():
        if hasattr(thing, "robot"):
            require_same_robot(robot_of(thing), robot, f"{first} and {name}")
    own = {name: with_robot(thing, robot) for name, thing in own.items()}
    drawn = {
        f"{name}, draw {k + 1}": model for name, thing in linear.items() if getattr(thing, "draws", None) is not None
        for k, model in enumerate(thing.draws.for_search(_SEARCHED_DRAWS))
    }  # fmt: skip
    own |= drawn
    asked = _read_requirements(requirements, robot, list(linear.values()), stepping=bool(own))
    return Task(
        digest="", linear=linear, own=own, asked=asked, robot=robot, seed=seed,
        cocontraction=_recorded_cocontraction(linear, robot), drawn=tuple(drawn),
    )  # fmt: skip


def _read_requirements(requirements: Any, robot: Robot, linear: list[Any], *, stepping: bool) -> TuneRequirements:
    """Return the requirements, with a default rise from the robot's slew, range and dead time."""
    if isinstance(requirements, TuneRequirements):
        return requirements
    scale = Scale.of(robot, sources_of({str(k): thing for k, thing in enumerate(linear)}))
    make = make_tune_requirements if isinstance(requirements, Mapping) else read_tune_requirements
    drawn = [thing.draws for thing in linear if getattr(thing, "draws", None) is not None]
    heaviest = min((max(draws.conditions["payload_kg"]) for draws in drawn), default=None)
    read = partial(make, requirements, scale=scale, stepping=stepping, drawn=bool(drawn), payload=heaviest)
    return read(rise=default_rise(linear, read()))


def _recorded_cocontraction(linear: Mapping[str, Any], robot: Robot) -> float | None:
    """Return the co-contraction [SI] of the recordings with the heaviest load, or None."""
    made = [part for thing in linear.values()
            for part in getattr(thing, "findings", {}).get("tested", {}).get("conditions", [])]  # fmt: skip
    if not made or not robot.redefinition(directions_of(next(iter(linear.values()))))[1][:, -1].any():
        return None
    heaviest, unit = max(max(part["payload_kg"]) for part in made), Scaling.of(robot).motor_unit
    middles = [sum(part["cocontraction"]) / 2.0 for part in made if max(part["payload_kg"]) >= heaviest]
    common = round(sorted(middles)[len(middles) // 2] / unit, 3)
    return common * unit if common > _MIN_COCONTRACTION_RAD else None


def _target_rise(task: Task) -> float:
    """Return the longest allowed rise [s], or a default for the plant."""
    limits = [limit for name in ("sim.rise_s", "step.rise_s") if (limit := task.asked.limit(name)) is not None]
    if limits:
        return min(limits)
    source = sources_of(task.linear, task.asked.certificate)[0]
    return USUAL_RISE / min(float(box.nominal[1]) for box in source.axes)


def _certify_search(
    search: Search, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> tuple[Search, _Certified, int]:
    """Return a search that ended, its certified best and the number of verifications.

    Where draws of the search or of its certificate fail, the worst of them join the plants and the search resumes.
    """
    task, best = search.task, search.sort_candidates()[:1]
    failed = _failed_in_search(task, best[0]) if best else []
    drawn = _drawn_in_search(task, best[0]) if failed else []
    failing = _failing_draws(drawn, failed)
    certified, tried = (None, 0) if failing else _verify_best(search, 0, files, progress)
    if certified is not None:
        verification = certified.verification
        if not (verification.holds or _is_near(certified.item, verification.failed, task)):
            failed = verification.failed
            failing = _failing_draws(verification.evidence.drawn, failed)
        if not failing or tried >= _most_attempts(task):
            return search, certified, tried
    digest = hashlib.sha256("\n".join([task.digest, *failing]).encode()).hexdigest()
    more = replace(
        task, own={**task.own, **failing}, drawn=(*task.drawn, *failing), digest=digest,
        asked=replace(task.asked, kept=_more_kept(task.asked.kept, failed)),
    )  # fmt: skip
    prepare(more)
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


def _most_attempts(task: Task) -> int:
    """Return the number of certificates that the draws of all families allow."""
    drawn = [thing.draws for thing in task.linear.values() if getattr(thing, "draws", None) is not None]
    return min([_MAX_ATTEMPTS, *(draws.attempts for draws in drawn)])


def _make_result(
    search: Search, certified: _Certified, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> Tuned:
    """Return the result of a search; where its best does not hold, relax defaults."""
    task, compared = search.task, _compared(search)
    best, verification = certified.item, certified.verification
    bounds = task.bounds
    names = objectives(compared)
    # Loops of tuning have noise and additional delay, those of `verify` do not.
    looped = [b for b in bounds if b.metric.startswith(("sim.", "track."))]
    unlooped = not looped or not task.own
    closed = unlooped or LEVELS.index(best.level) >= 1
    holds = verification.holds and closed and (unlooped or best.holds(looped, tested=False))
    stuck, nearest = (None, None) if holds else active_requirement(compared, bounds, tested=task.tested)
    known = [verdict for verdict in verification.failed if verdict.value is not None]
    if not holds and stuck is None and known:
        # The certificate covers more plants than the search.
        stuck = known[0].requirement.metric
        nearest = known[0].value if len(verification.failed) == 1 else None
    found = Tuned(
        best=best, controller=certified.controller, observer=task.observer, observed=certified.observed,
        assumed=_assumed(certified.controller), own=prepare(task).own, verification=verification, holds=holds,
        candidates=compared, front=front(compared, names), objectives=names, binding=stuck, nearest=nearest,
        evaluations=search.earlier + len(search.spent), dropped=search.dropped, task=task,
    )  # fmt: skip
    return found if holds or not closed else _relax(found, tried, files, progress)


def _compared(search: Search) -> list[Candidate]:
    """Return the candidates that loops have judged, else all, the best first."""
    ranked = search.sort_candidates()
    if not ranked:
        why = "; ".join(f"{kind}: {text}" for kind, text in search.dropped.items())
        if any(space.kind not in search.dropped for space in search.spaces):
            raise CheckFailedError(f"the budget ended before any candidate was judged ({why}); increase it.")
        raise SettingsError(f"no candidate controller could be designed ({why}).")
    return [item for item in ranked if LEVELS.index(item.level) >= 1] or ranked


def _relax(found: Tuned, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress) -> Tuned:
    """Return the result with defaults of speed and precision relaxed to those of a candidate, if all others hold.

    Candidates are the best, then the best of each other kind that the search has failed in nothing else. Stated
    requirements and stability margins are not relaxed. Each verification has draws that none of the `tried` has seen.
    """
    task, most = found.task, _most_attempts(found.task)
    best = _Certified(found.best, found.controller, found.observed, found.verification)
    for item in _relaxable(found):
        certified = best
        if item is not found.best:
            if tried + 2 > most:
                break
            tried += 1
            progress(0.9, f"verify {item.kind}")
            certified = _certify(task, item, files, tried)
        kept = relaxations(item, certified.verification.failed, task.asked)
        asked = task.asked
        if item is found.best and (not kept or tried >= most):
            continue
        if kept:
            tried += 1
            progress(0.9, "verify what holds")
            asked = relax_limits(asked, {metric: one.limit for metric, one in kept.items()})
            certified = _certify_again(replace(task, asked=asked), certified, files, tried)
        if certified.verification.holds:
            return replace(
                found, best=item, controller=certified.controller, observed=certified.observed, loosened=kept,
                assumed=_assumed(certified.controller), verification=certified.verification, holds=True,
                task=replace(task, asked=asked),
            )  # fmt: skip
    return found


def _relaxable(found: Tuned) -> list[Candidate]:
    """Return the best, and the best of each other kind that fails in its search by relaxable defaults alone."""
    task, first = found.task, {found.best.kind: found.best}
    for item in found.candidates:
        broken = {name for name, value in item.ratios(task.bounds, tested=task.tested).items() if value > 1.0}
        if not item.error and broken <= relaxations(item, (), task.asked).keys():
            first.setdefault(item.kind, item)
    return list(first.values())


def _assumed(controller: Any) -> dict[str, float]:
    return dict(getattr(controller, "design", {}).get("assumed", {}))


def _observed(task: Task, item: Candidate) -> bool:
    """Return whether steps, and all that the draws of the search tell, keep their requirements with the observer."""
    eyes = task.observer
    if make_observer(task, item.kind) is not None:
        return True
    if eyes is None or not task.own or not holds_with_observer(task, item, eyes, task.bounds):
        return False
    return not any(part.failed for part in _drawn_in_search(task, item, eyes.block()))


@dataclass(frozen=True, slots=True)
class _Certified:
    """A candidate with its controller, whether its loop has the observer, and the verification of that loop."""

    item: Candidate
    controller: Any
    observed: bool
    verification: Verification


def _verify_best(
    search: Search, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> tuple[_Certified, int]:
    """Return the first of the best whose certificate holds, else the best, and the number of verifications so far."""
    compared, found = _compared(search), []
    promising = [item for item in compared if search.cost(item) <= 1.0][:_MAX_VERIFICATIONS] or compared[:1]
    for number, item in zip(range(tried + 1, _most_attempts(search.task) + 1), promising, strict=False):
        progress((number - tried - 1) / len(promising), f"verify {item.kind}")
        found.append(_certify(search.task, item, files, number))
        if found[-1].verification.holds:
            return found[-1], number
    return found[0], tried + len(found)


def _certify(task: Task, item: Candidate, files: Mapping[str, tuple[str, str]] | None, attempt: int) -> _Certified:
    """Return the verification of a candidate's loop, with the observer where its steps hold with it."""
    controller = design_candidate(task, prepare(task), item.kind, item.settings)
    observed = _observed(task, item)
    return _Certified(item, controller, observed, _verify_loop(task, controller, observed, files, attempt))


def _certify_again(
    task: Task, made: _Certified, files: Mapping[str, tuple[str, str]] | None, attempt: int
) -> _Certified:
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


def _observer(task: Task) -> Any:
    """Return the Kalman filter over a model with payloads, else over the nominal plant, or None."""
    several = [model for model in task.models if payloads(model.arrays) is not None]
    for model in (*several, next(iter(task.linear.values()))):
        with contextlib.suppress(SettingsError):
            return KalmanSettings().design(model)
    return None


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
    broken = {verdict.requirement: verdict.value for verdict in failed}
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


def holds_with_observer(task: Task, item: Candidate, observer: Any, bounds: tuple[Requirement, ...]) -> bool:
    """Return whether the full-size steps meet their requirements with an observer in the loop, hardly more slowly."""
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
    if not named or not named["sim.rise_s"] <= _SLOWER * item.metrics.get("sim.rise_s", math.inf):
        return False
    return all(ratio(b, named[b.metric]) <= 1.0 for b in bounds if b.metric in named)
