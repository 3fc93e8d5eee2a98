"""Tune a controller to requirements: read them, search, certify the best, and return the result."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from softneck.core import (
    Progress,
    SettingsError,
    core_count,
    one_blas_thread,
    require_whole,
    shown_progress,
)
from softneck.cosim import open_workers
from softneck.estimation import KalmanSettings, directions_of, robot_of
from softneck.identification import payloads
from softneck.robot import Robot, Scaling, load_for_robot
from softneck.signals import require_same_robot
from softneck.verification import (
    Scale,
    SimulationModel,
    Verification,
    is_simulation_model,
    named_plants,
    sources_of,
    with_robot,
)

from ._certify import (
    Certified,
    certify,
    certify_again,
    certify_search,
    compared_candidates,
    most_attempts,
    relaxed,
)
from ._compare import Loosened, active_requirement, front, objectives, relaxations
from ._judge import LEVELS, prepare, told_conditions
from ._requirements import (
    USUAL_RISE,
    TuneRequirements,
    check_feasibility,
    default_rise,
    fastest_rise,
    make_tune_requirements,
    read_tune_requirements,
)
from ._search import Candidate, Search
from ._space import KINDS_SEARCHED, UNCERTIFIED, spaces
from ._task import Log, Task, digest_of

# More hardly have work, as a generation has six candidates of a kind, and each takes 250 MB.
_MOST_WORKERS = 7
#: Default number of judgements of candidates.
BUDGET = 160
# Draws of a family in every loop of a search; final candidates are judged on more, and certificates have others.
_SEARCHED_DRAWS = 4
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
        workers: processes beside this one; default one for each further core, at most 7.
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
        chosen, rise=_target_rise(task), robot=task.robot, least=fastest_rise(task.plant), drawn=bool(task.drawn),
        cocontraction=None if task.cocontraction is None else float(f"{task.cocontraction:.4g}"),
    )  # fmt: skip
    task = replace(task, observer=_observer(task) if observer is None else observer)
    task = replace(task, digest=digest_of(task, chosen, files))
    prepare(task)  # report a plant that does not fit before the search
    log = Log(folder, task.digest, force=force)
    with shown_progress("tune", progress) as tell:
        beside = min(core_count() - 1, _MOST_WORKERS) if workers is None else workers
        with open_workers(beside, None) if beside else contextlib.nullcontext() as pool:
            search = Search(task, each, pool, log, budget, lambda done, text: tell(0.75 * done, text))
            search.dropped |= dropped
            search.run()
            late = lambda done, text: tell(0.75 + 0.25 * done, text)  # noqa: E731
            search, certified, tried = certify_search(search, files, late)
        return _make_result(search, certified, tried, files, late)


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


def _make_result(
    search: Search, certified: Certified, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> Tuned:
    """Return the result of a search; where its best does not hold, relax defaults."""
    task, compared = search.task, compared_candidates(search)
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
    return found if holds or not closed else _relax(found, certified, tried, files, progress)


def _relax(
    found: Tuned, best: Certified, tried: int, files: Mapping[str, tuple[str, str]] | None, progress: Progress
) -> Tuned:
    """Return the result with defaults of speed and precision relaxed to those of a candidate, if all others hold.

    Candidates are the best, then the best of each other kind that the search has failed in nothing else. Stated
    requirements and stability margins are not relaxed. Each verification has draws that none of the `tried` has seen.
    """
    task, most = found.task, most_attempts(found.task)
    for item in _relaxable(found):
        certified, kept = best, best.kept
        if item is not found.best:
            if tried + 2 > most:
                break
            tried += 1
            progress(0.9, f"verify {item.kind}")
            certified = certify(task, item, files, tried)
        if certified is not best or not (kept and best.verification.holds):
            kept = relaxations(item, certified.verification.failed, task.asked)
            if item is found.best and (not kept or tried >= most):
                continue
            while kept and tried < most:
                tried += 1
                progress(0.9, "verify what holds")
                certified = certify_again(relaxed(task, kept), certified, files, tried)
                # The draws of another certificate may miss another default.
                more = relaxations(item, certified.verification.failed, task.asked)
                if certified.verification.holds or not more or kept == {**kept, **more}:
                    break
                kept = {**kept, **more}
        if certified.verification.holds:
            return replace(
                found, best=item, controller=certified.controller, observed=certified.observed, loosened=kept,
                assumed=_assumed(certified.controller), verification=certified.verification, holds=True,
                task=relaxed(task, kept),
            )  # fmt: skip
    return replace(found, verification=certify_again(task, best, files, tried).verification) if best.kept else found


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


def _observer(task: Task) -> Any:
    """Return the Kalman filter over a model with payloads, else over the nominal plant, or None."""
    several = [model for model in task.models if payloads(model.arrays) is not None]
    for model in (*several, next(iter(task.linear.values()))):
        with contextlib.suppress(SettingsError):
            return KalmanSettings().design(model)
    return None
