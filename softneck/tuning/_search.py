"""Search over kinds and settings by successive halving and CMA-ES.

Each kind starts with the largest bound on Ms that its margins allow, found by bisection, and is judged there by loops.
Where draws of a family decide, the hardest of them lead, and a kind begins at its start or at a smaller bound.
After the start and each round the better third of the kinds continues (successive halving: Jamieson and Talwalkar
2016, AISTATS). Each kind has its own CMA-ES over its unit cube (Hansen and Ostermeier 2001, Evolutionary Computation
9:159). It uses ranks alone, so candidates of different levels can be mixed. At least half of the candidates continue
to the next level. Finally, neighbours of the best are searched. The number of workers does not change the result.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from softneck.core import Progress, SoftneckError, cores_taken, worst
from softneck.cosim import WorkerPool
from softneck.verification import Requirement

from ._judge import LEVELS, hardest_draws, judge_candidate, steps_on_all_draws
from ._space import COSTLY, Space
from ._task import Job, Judgement, Log, Task

# 4 + 3 ln n, the default of CMA-ES, for two to four settings, made even.
_POPULATION_SIZE = 6
#: Initial step of CMA-ES, as a share of each range.
STEP = 0.15
# First step of the bound on Ms, as a share of its range, and number of steps, each half the last.
_START_STEP, _START_STEPS = 0.24, 3
# Share of the budget for neighbours of the best, and their first and last distance.
_REFINED_SHARE, _FIRST_DISTANCE, _LAST_DISTANCE = 0.3, 0.08, 0.005
# Kinds that always continue, and final candidates with margins by experiment.
_MIN_KINDS, _FINAL_COUNT = 2, 4
# One kind in three continues to the next round.
_HALVING_RATE = 3
# Weight of the mean ratio beside the largest one, which breaks ties.
_TIE_WEIGHT = 0.02
# Largest penalty of one requirement, so that an unknown or unreachable one does not outweigh the rest.
_MAX_PENALTY = 4.0
# Groups that need a linear form of the controller.
_LINEAR_GROUPS = ("axes.", "mimo.", "robust.")


@dataclass(slots=True, eq=False)
class Candidate:
    """One kind with its settings and its metrics.

    `kind`: of controller. `settings`: of its design. `x`: its point in the cube. `level`: of its last judgement, or "".
    `metrics`: of all levels. `error`: why it has none. `curves`: of its last judgement that has some.
    """

    kind: str
    settings: Mapping[str, Any]
    x: np.ndarray
    level: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    error: str = ""
    curves: Mapping[str, list[float]] = field(default_factory=dict)

    def update(self, level: str, judgement: Judgement) -> None:
        """Add the judgement of a level."""
        if judgement.error:
            self.error = judgement.error
            return
        self.level = level
        self.curves = judgement.curves or self.curves
        # The worse value counts: of margins by linear methods and by experiment, of steps on few draws and on many.
        self.metrics |= {
            name: worst(name, [value, self.metrics[name]]) if name in self.metrics else value
            for name, value in judgement.metrics.items()
        }

    def ratios(self, bounds: Sequence[Requirement], *, tested: bool) -> dict[str, float]:
        """Return metric -> value over limit (for lower bounds limit over value).

        A margin that was not computed, as of a controller without linear form, does not hold; one of such a controller
        by experiment alone fails beside recordings, or if stated, as in `verify`. A value that is no number fails.
        """
        found: dict[str, float] = {}
        blind = bool(self.metrics) and "axes.sensitivity" not in self.metrics
        for item in bounds:
            value = self.metrics.get(item.metric)
            if blind and item.metric.startswith(_LINEAR_GROUPS):
                known = math.inf if value is None else max(1.0, ratio(item, value))
                found[item.metric] = math.inf if tested or item.asked else known
            elif value is not None:
                found[item.metric] = max(found.get(item.metric, 0.0), ratio(item, value))
        return found

    def cost(self, bounds: Sequence[Requirement], *, tested: bool, aim: str = "") -> float:
        """Return the cost, at most 1 where all known requirements hold.

        It is the largest ratio where all hold, else 1 plus the sum of x/(1 + x/4) over the excesses x beyond 1: an
        exact penalty (Nocedal and Wright 2006, sec. 17.2). With `aim` it is the ratio of that metric where all hold.
        The mean ratio breaks ties; with `aim`, 1 - 1/Ms counts as one more ratio.
        """
        each = self.ratios(bounds, tested=tested)
        found = list(each.values())
        if self.error or not found:
            return math.inf
        beyond = sum(_saturate(max(value - 1.0, 0.0)) for value in found)
        rest = _TIE_WEIGHT * float(np.mean([min(value, 1.0) for value in found]))
        if beyond > 0.0:
            return 1.0 + beyond + rest
        if aim in each:
            sensitivity = self.metrics.get("axes.sensitivity", math.inf)
            near = 1.0 / sensitivity if sensitivity > 0.0 else 0.0
            rest = (len(found) * rest + _TIE_WEIGHT * (1.0 - near)) / (len(found) + 1)
        return (1.0 - _TIE_WEIGHT) * each.get(aim, max(found)) + rest

    def holds(self, bounds: Sequence[Requirement], *, tested: bool) -> bool:
        """Return whether every known requirement holds."""
        found = self.ratios(bounds, tested=tested)
        return not self.error and bool(found) and max(found.values()) <= 1.0


def _saturate(beyond: float) -> float:
    return _MAX_PENALTY if math.isinf(beyond) else beyond / (1.0 + beyond / _MAX_PENALTY)


def ratio(item: Requirement, value: float) -> float:
    """Return value over limit (for a lower bound limit over value); above 1 it fails, as no number does."""
    if math.isnan(value):
        return math.inf
    if item.bound == "min":
        return item.limit / value if value > 0.0 else math.inf
    if item.limit <= 0.0:
        return 0.0 if item.holds(value) else math.inf
    return value / item.limit if item.bound == "max" or value < item.limit else max(value / item.limit, 1.0 + 1e-9)


@dataclass(slots=True, eq=False)
class Search:
    """A running search.

    `task`: what is tuned. `spaces`: of the kinds. `workers`: processes beside this one. `log`: of judgements.
    `budget`: of judgements. `report`: called with progress and the best so far. `finals`: number of final candidates
    with margins by experiment. `earlier`: number of judgements of the search that this one resumes. `started`: done
    when a worker has imported and compiled what it needs.
    """

    task: Task
    spaces: list[Space]
    workers: WorkerPool | None
    log: Log
    budget: int
    report: Progress
    finals: int = _FINAL_COUNT
    candidates: dict[tuple[str, str], Candidate] = field(default_factory=dict)
    spent: set[Job] = field(default_factory=set)
    dropped: dict[str, str] = field(default_factory=dict)
    earlier: int = 0
    started: Future | None = None

    @property
    def levels(self) -> Sequence[str]:
        """The levels of all candidates; margins by experiment, and other loops, need simulation models."""
        if self.task.drawn:
            return LEVELS[1:-1]
        return LEVELS[:-1] if self.task.own else LEVELS[:1]

    def run(self) -> None:
        """Search until the budget is spent."""
        optimisers = {space.kind: _optimiser(space, self.task.seed, i) for i, space in enumerate(self.spaces)}
        levels = self.levels
        # A small budget goes to the starts first.
        finals = min(self.finals, max(0, self.budget - len(levels) * len(self.spaces))) if self.task.own else 0
        alive, before = self._judge_starts(levels, finals, optimisers), -1
        while self._remaining(finals + round(_REFINED_SHARE * self.budget)) > 0 and alive and before < len(self.spent):
            before = len(self.spent)
            generation = {space.kind: self._sample(space, optimisers[space.kind]) for space in alive}
            self._judge_levels([item for each in generation.values() for item in each], levels, finals)
            for space in alive:
                _tell(optimisers[space.kind], generation[space.kind], self._rank)
            alive = self._drop_kinds(alive)
        self._finish(finals)

    def resume(self, starts: Sequence[Candidate]) -> None:
        """Judge candidates of a search over fewer plants, and search near the best until the budget is spent."""
        finals = min(self.finals, max(0, self.budget - len(self.levels) * len(starts)))
        spaces = {space.kind: space for space in self.spaces}
        self._judge_levels([self._candidate(spaces[item.kind], item.x) for item in starts], self.levels, finals)
        self._finish(finals)

    def _finish(self, finals: int) -> None:
        """Search near the best, and judge the final candidates, of each kind one first, by margins and all draws."""
        self._refine(self.levels, finals)
        if finals:
            last = [item for item in self.sort_candidates() if item.level == "all"]
            self._judge_finals(best_of_kinds(last)[:finals])

    def _judge_finals(self, items: Sequence[Candidate]) -> None:
        """Judge the best, and those that are better still: more loops improve no value, so the others cannot win."""
        for item in items if self.task.drawn else ():
            for steps in steps_on_all_draws(self.task, item.kind, item.settings).values():
                item.update(item.level, Judgement({metric: worst(metric, each) for metric, each in steps.items()}))
        best = math.inf
        for item in sorted(items, key=self._final_cost):
            if self._final_cost(item) < best:
                self._judge([item], "margins", 0)
                best = min(best, self._final_cost(item))

    def sort_candidates(self) -> list[Candidate]:
        """Return all candidates with metrics, the best first."""
        return sorted((item for item in self.candidates.values() if item.level), key=self._rank)

    def cost(self, item: Candidate) -> float:
        """Return the cost of a candidate."""
        return self._final_cost(item) if item.level == LEVELS[-1] else self._cost(item, self.task.aims)

    def _final_cost(self, item: Candidate) -> float:
        return self._cost(item, self.task.final_aims)

    def _cost(self, item: Candidate, aims: Sequence[Requirement]) -> float:
        return item.cost(aims, tested=self.task.tested, aim="sim.rise_s" if self.task.drawn else "")

    def _candidates_of(self, kind: str) -> list[Candidate]:
        return [item for item in self.candidates.values() if item.kind == kind]

    def _rank(self, item: Candidate) -> tuple[int, float]:
        """Return the sort key: the level, later ones first, then the cost."""
        return -("", *LEVELS).index(item.level), self.cost(item)

    def _remaining(self, reserved: int) -> int:
        return self.budget - reserved - len(self.spent)

    def _judge_starts(self, levels: Sequence[str], finals: int, optimisers: dict[str, Any]) -> list[Space]:
        """Judge each kind at its start; return the remaining kinds and move their optimisers there."""
        starts = {space.kind: self._candidate(space, space.start) for space in self.spaces}
        if self.task.drawn:
            self._choose_draws(list(starts.values()))
        started = self._start_workers(list(starts.values())[-1], levels[-1])
        self._judge(list(starts.values()), levels[0], finals)
        if not self.task.drawn:
            starts = self._move_starts(starts, finals + (len(levels) - 1) * len(starts))
        for level in levels[1:]:
            self._judge(list(starts.values()), level, finals)
        if self.task.drawn:
            starts = self._judge_detuned(starts, levels, finals)
        self.started = started  # until now these would have compiled the same functions
        self.dropped |= {kind: item.error for kind, item in starts.items() if item.error}
        for number, space in enumerate(self.spaces):
            if not np.array_equal(starts[space.kind].x, space.start):
                optimisers[space.kind] = _optimiser(space, self.task.seed, number, starts[space.kind].x)
        return self._drop_kinds([space for space in self.spaces if space.kind not in self.dropped])

    def _choose_draws(self, starts: Sequence[Candidate]) -> None:
        """Choose the draws that lead the search: the hardest of the first start that can be designed."""
        for item in starts:
            with contextlib.suppress(SoftneckError):
                self.task = replace(self.task, hardest=hardest_draws(self.task, item.kind, item.settings))
                return

    def _judge_detuned(self, starts: dict[str, Candidate], levels: Sequence[str], finals: int) -> dict[str, Candidate]:
        """Return the better of each start and of a detuned one: with the least allowed margins a kind overshoots."""
        detuned = {space.kind: self._candidate(space, space.detuned(starts[space.kind].x)) for space in self.spaces}
        for level in levels:
            self._judge(list(detuned.values()), level, finals)
        return {kind: min(starts[kind], detuned[kind], key=self._rank) for kind in starts}

    def _move_starts(self, starts: dict[str, Candidate], reserved: int) -> dict[str, Candidate]:
        """Return the starts with the largest bound on Ms that the margins allow, by bisection."""
        at, best, step = dict(starts), dict(starts), _START_STEP
        spaces = {space.kind: space for space in self.spaces}
        # A controller without linear form has no margins to follow.
        led = {
            kind: space.trade_off for kind, space in spaces.items()
            if space.trade_off is not None and (starts[kind].error or "axes.sensitivity" in starts[kind].metrics)
        }  # fmt: skip
        for _ in range(_START_STEPS):
            for kind, k in led.items():
                x = at[kind].x.copy()
                # A failed design, of which no margin is known, gets a larger bound.
                x[k] += step if self._is_robust(at[kind]) else -step
                at[kind] = self._candidate(spaces[kind], np.clip(x, 0.0, 1.0))
            self._judge([at[kind] for kind in led], LEVELS[0], reserved)
            for kind, k in led.items():
                if at[kind].level:
                    best[kind] = min(best[kind], at[kind], key=lambda item: self._start_rank(item, k))
            step /= 2.0
        return best

    def _is_robust(self, item: Candidate) -> bool:
        """Return whether all known margins hold."""
        found = item.ratios(self.task.bounds, tested=self.task.tested)
        return all(value <= 1.0 for name, value in found.items() if name.startswith(_LINEAR_GROUPS))

    def _start_rank(self, item: Candidate, k: int) -> tuple[bool, bool, float]:
        """Return the sort key of a start: designed, robust, then the largest bound if robust, else the smallest."""
        robust = self._is_robust(item)
        return not item.level, not robust, -float(item.x[k]) if robust else float(item.x[k])

    def _judge_levels(self, items: Sequence[Candidate], levels: Sequence[str], finals: int) -> None:
        """Judge candidates level by level; the better ones continue."""
        left = list(items)
        for level in levels:
            self._judge(left, level, finals)
            left = self._select(left, level)

    def _refine(self, levels: Sequence[str], finals: int) -> None:
        """Judge neighbours of the best until the budget is spent or none is better.

        They lie on both sides along random orthogonal directions: where two limits meet, changing one setting alone
        improves nothing (Gratton et al. 2015, SIAM J. Optim. 25:1515).
        """
        away, rng = _FIRST_DISTANCE, np.random.default_rng(self.task.seed)
        spaces = {space.kind: space for space in self.spaces}
        while self._remaining(finals) > 0 and away > _LAST_DISTANCE:
            best = next(iter(self.sort_candidates()), None)
            if best is None or best.level != levels[-1]:
                return
            along = np.linalg.qr(rng.standard_normal((best.x.size, best.x.size)))[0]
            near = [x for step in away * along for x in (best.x + step, best.x - step)]
            self._judge_levels([self._candidate(spaces[best.kind], np.clip(x, 0.0, 1.0)) for x in near], levels, finals)
            if self.sort_candidates()[0] is best:
                away /= 2.0

    def _drop_kinds(self, alive: list[Space]) -> list[Space]:
        """Return the better third of the kinds; of more than two a costly one only if it is the best."""
        keep = max(_MIN_KINDS, math.ceil(len(alive) / _HALVING_RATE))
        best = sorted(alive, key=lambda space: min(self._rank(item) for item in self._candidates_of(space.kind)))
        if len(alive) > _MIN_KINDS:
            best = best[:1] + [space for space in best[1:] if space.kind not in COSTLY]
        return [space for space in alive if space in best[:keep]]

    def _sample(self, space: Space, optimiser: Any) -> list[Candidate]:
        """Return a generation of candidates."""
        return [self._candidate(space, optimiser.ask()) for _ in range(_POPULATION_SIZE)]

    def _candidate(self, space: Space, x: np.ndarray) -> Candidate:
        """Return the candidate at a point of the cube; equal settings give one candidate."""
        settings = space.settings(x)
        job = Job.of(space.kind, settings, "")
        return self.candidates.setdefault((job.kind, job.settings), Candidate(space.kind, settings, np.array(x)))

    def _select(self, items: list[Candidate], level: str) -> list[Candidate]:
        """Return the candidates of a level that hold so far, and at least the better half."""
        good = sorted((item for item in items if item.level == level and not item.error),
                      key=lambda item: max(1.0, self.cost(item)))  # fmt: skip
        # Remove duplicates.
        good = list({id(item): item for item in good}.values())
        return good[: max(math.ceil(len(good) / 2), sum(self.cost(item) <= 1.0 for item in good))]

    def _judge(self, items: Sequence[Candidate], level: str, reserved: int) -> None:
        """Judge candidates at a level within the budget; logged judgements are reused."""
        wanted: dict[Job, Candidate] = {}
        for item in items:
            job = Job.of(item.kind, item.settings, level)
            judged = item.level == level or item.error or job in self.spent
            if not judged and len(wanted) < self._remaining(reserved):
                wanted.setdefault(job, item)
        run_jobs([job for job in wanted if job not in self.log.found], self._call, self._store, self._started_workers)
        for job, item in wanted.items():
            self.spent.add(job)
            item.update(level, self.log.found[job])
        self._report_progress()

    def _start_workers(self, item: Candidate, level: str) -> Future | None:
        """Have a worker start with the kind that this process judges last; its result is not used."""
        if self.workers is None:
            return None
        return self.workers.pool.submit(judge_candidate, self.task, item.kind, item.settings, level)

    def _started_workers(self) -> WorkerPool | None:
        """Return the workers once they have started; until then this process does all."""
        return self.workers if self.started is not None and self.started.done() else None

    def _call(self, job: Job) -> Callable[[], Judgement]:
        item = self.candidates[(job.kind, job.settings)]
        return partial(judge_candidate, self.task, job.kind, item.settings, job.level)

    def _store(self, job: Job, judgement: Judgement) -> None:
        self.log.found[job] = judgement
        self.log.write()
        self.spent.add(job)
        self._report_progress()

    def _report_progress(self) -> None:
        best = next(iter(self.sort_candidates()), None)
        self.report(len(self.spent) / self.budget, "nothing yet" if best is None else in_words(best, self.cost(best)))


def run_jobs(
    jobs: Sequence[Job], call: Callable[[Job], Callable[[], Judgement]], took: Callable[[Job, Judgement], None],
    started: Callable[[], WorkerPool | None],
) -> None:  # fmt: skip
    """Run jobs, one here and two per worker that has `started` at a time, and store each result when it arrives."""
    left, out = list(jobs)[::-1], dict[Future, Job]()
    try:
        while left or out:
            workers = started()
            while workers is not None and len(left) > 1 and len(out) < 2 * workers.size:
                job = left.pop()
                out[workers.pool.submit(call(job))] = job
            if left:
                job = left.pop()
                with cores_taken(len(out)):
                    took(job, call(job)())
            done, _ = wait(out, timeout=0.0 if left else None, return_when=FIRST_COMPLETED)
            for future in done:
                took(out.pop(future), future.result())
    except BrokenExecutor as error:
        raise SoftneckError(
            "a worker process died (out of memory, or a plant that crashed); run the same command again to continue."
        ) from error


def best_of_kinds(ranked: Sequence[Candidate]) -> list[Candidate]:
    """Return candidates, the best of each kind first."""
    first = {item.kind: item for item in reversed(ranked)}
    return [*sorted(first.values(), key=ranked.index), *(item for item in ranked if item is not first[item.kind])]


def in_words(item: Candidate, cost: float) -> str:
    """Return a short text about a candidate."""
    words = [f"best {item.kind}"]
    for name, text in (("rise_s", "rise {:.2f} s"), ("overshoot_pct", "overshoot {:.1f} %"),
                       ("gain_margin", "gain margin {:.2g}")):  # fmt: skip
        values = [item.metrics.get(f"{group}.{name}", math.inf) for group in ("sim", "step", "axes")]
        words += [text.format(value) for value in values if math.isfinite(value)][:1]
    return ", ".join([*words, "all hold" if cost <= 1.0 else f"{cost - 1.0:.2f} beyond limits"])


def _optimiser(space: Space, seed: int, number: int, mean: np.ndarray | None = None) -> Any:
    from cmaes import CMA

    n = len(space.dimensions)
    return CMA(
        mean=space.start if mean is None else mean, sigma=STEP, bounds=np.array([[0.0, 1.0]] * n),
        population_size=_POPULATION_SIZE, seed=(1000 * seed + number) % 2**32,
    )  # fmt: skip


def _tell(optimiser: Any, generation: Sequence[Candidate], key: Callable[[Candidate], Any]) -> None:
    """Pass the ranks to CMA-ES."""
    order = sorted(range(len(generation)), key=lambda i: key(generation[i]))
    optimiser.tell([(generation[i].x, float(rank)) for rank, i in enumerate(order)])
