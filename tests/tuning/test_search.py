"""Searches: the same whatever runs them, resumed as if never stopped, and their results by independent means."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import KINDS, FileFormatError, OutputFileError, SettingsError, SoftneckError, resolve
from softneck.core._kinds import make_settings
from softneck.plant import NeckParameters
from softneck.robot import Robot, Scaling
from softneck.tuning import _search, _tune, task_of, tune
from softneck.tuning._compare import active_requirement, front
from softneck.tuning._judge import cases, judged_delay, told_conditions
from softneck.tuning._requirements import make_tune_requirements
from softneck.tuning._search import Candidate, _optimiser, in_words, ratio, run_jobs
from softneck.tuning._space import KINDS_SEARCHED, spaces
from softneck.tuning._task import _LOG_FORMAT, FILE, Job, Log, Task
from softneck.tuning._tune import Tuned
from softneck.verification import make_simulation_model
from softneck.verification._requirements import Requirement

from ..verification.necks import family, small_draws
from .test_requirements import neck

# As quick as a verification can be; margins that a nominal plant within 20 % allows.
QUICK = {"sampling": {"plants": 30, "search_generations": 0}, "step": {"duration_s": 3.0},
         "require": {"stability.searched_radius": False, "robust.mu": False, "step.overshoot_pct": {"max": 30.0},
                     "axes.sensitivity": {"max": 3.0}, "axes.gain_margin": {"min": 1.5}, "step.rise_s": {"max": 0.9},
                     "axes.disk_margin": False, "mimo.disk_margin": False}}  # fmt: skip


def searched(folder: Path | None = None, budget: int = 14, **more: Any) -> Tuned:
    return tune({"neck": neck()}, QUICK, kinds=("pi", "lqg"), budget=budget, workers=more.pop("workers", 0),
                folder=folder, **more)  # fmt: skip


def told(found: Tuned) -> list[tuple[str, dict[str, Any], dict[str, float]]]:
    return [(item.kind, dict(item.settings), item.metrics) for item in found.candidates]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tuned, Path]:
    folder = tmp_path_factory.mktemp("whole")
    return searched(folder), folder


@pytest.mark.slow
def test_a_search_finds_what_verify_certifies(whole: tuple[Tuned, Path]) -> None:
    found, _ = whole
    assert found.holds
    assert found.verification.holds
    assert found.binding is None
    assert found.evaluations == 14
    costs = [item.cost(found.task.asked.bounds, tested=False) for item in found.candidates]
    assert found.best.cost(found.task.asked.bounds, tested=False) == min(costs)


@pytest.mark.slow
def test_the_number_of_workers_changes_nothing(whole: tuple[Tuned, Path]) -> None:
    assert told(searched(workers=2)) == told(whole[0])


@pytest.mark.slow
def test_another_seed_is_another_search(whole: tuple[Tuned, Path]) -> None:
    assert told(searched(budget=14, seed=1)) != told(whole[0])


@pytest.mark.slow
def test_a_search_that_was_stopped_goes_on_as_if_it_never_was(
    whole: tuple[Tuned, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from softneck.tuning import _search

    judged, calls = _search.judge_candidate, []

    def until_ctrl_c(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return judged(*arguments)

    monkeypatch.setattr(_search, "judge_candidate", until_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        searched(tmp_path)
    kept = json.loads((tmp_path / FILE).read_text())["evaluations"]
    assert len(kept) == 5
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    monkeypatch.setattr(_search, "judge_candidate", lambda *arguments: calls.append(arguments) or judged(*arguments))
    calls.clear()
    assert told(searched(tmp_path)) == told(whole[0])
    assert len(calls) == 14 - 5
    # And once more, where all is there: nothing is judged again, a larger budget goes on.
    calls.clear()
    assert told(searched(tmp_path)) == told(whole[0])
    assert not calls
    assert searched(tmp_path, budget=20).evaluations == 20
    assert len(calls) == 6


@pytest.mark.slow
def test_a_small_budget_gives_the_best_so_far(tmp_path: Path) -> None:
    found = searched(tmp_path, budget=1)
    assert (found.evaluations, len(found.candidates)) == (1, 1)


@pytest.mark.slow
def test_the_folder_of_another_search_is_kept(whole: tuple[Tuned, Path], tmp_path: Path) -> None:
    _, folder = whole
    before = (folder / FILE).read_bytes()
    with pytest.raises(OutputFileError, match="holds a search over other plants"):
        searched(folder, seed=3)
    assert (folder / FILE).read_bytes() == before
    (tmp_path / FILE).write_text("{}")
    with pytest.raises(SoftneckError, match="is no log of a search"):
        searched(tmp_path)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda row: row.update(curves=[1]), "curves"),
        (lambda row: row.update(curves=None), "curves"),
        (lambda row: row["curves"].update(low=["x"]), r"curves\.low\[0\]"),
        (lambda row: row["curves"].update(low=[math.inf] * 80), r"curves\.low\[0\]"),
        (lambda row: row["curves"].update(low=[0.0] * 79), r"curves\.low has 79 values instead of 80"),
        (lambda row: row["curves"].pop("value"), "curves has no value"),
        (lambda row: row.update(metrics={"sim.rise_s": "x"}), r"metrics\.sim\.rise_s"),
        (lambda row: row.update(settings={}), "settings"),
        (lambda row: row.pop("level"), "has no level"),
    ],
)
def test_a_log_with_another_value_is_refused_in_one_line(tmp_path: Path, damage: Any, said: str) -> None:
    curves = {"low": [0.0] * 80, "high": [1.0] * 80, "value": [0.5] * 80, "reference": [1.0]}
    row = {"kind": "pi", "settings": "{}", "level": "loops", "error": "", "metrics": {"sim.rise_s": 0.5}}
    row |= {"curves": curves}
    file = tmp_path / FILE
    file.write_text(json.dumps({"format": _LOG_FORMAT, "digest": "d", "evaluations": [row]}))
    assert len(Log(tmp_path, "d").found) == 1
    damage(row)
    file.write_text(json.dumps({"format": _LOG_FORMAT, "digest": "d", "evaluations": [row]}))
    with pytest.raises(FileFormatError, match=f"is no log of a search.*{said}") as refused:
        Log(tmp_path, "d")
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("given", "said"),
    [({"format": 2}, "another format"), ({"format": None}, "another format"), ({"evaluations": {}}, "another format"),
     ({"evaluations": None}, "another format"), ({"format": ...}, "format"), ({"evaluations": ...}, "evaluations")],
)  # fmt: skip
def test_a_log_of_another_format_is_refused_in_one_line(tmp_path: Path, given: dict[str, Any], said: str) -> None:
    whole = {"format": 1, "digest": "d", "evaluations": []}
    (tmp_path / FILE).write_text(json.dumps(whole))
    assert not Log(tmp_path, "d").found
    told = {key: value for key, value in (whole | given).items() if value is not ...}
    (tmp_path / FILE).write_text(json.dumps(told))
    with pytest.raises(FileFormatError, match=f"is no log of a search.*{said}"):
        Log(tmp_path, "d")


@pytest.mark.parametrize("force", [False, True])
def test_a_log_of_another_search_is_replaced_only_by_force(tmp_path: Path, force: bool) -> None:
    Log(tmp_path, "first").write()
    if force:
        Log(tmp_path, "other", force=True).write()
        assert json.loads((tmp_path / FILE).read_text())["digest"] == "other"
    else:
        with pytest.raises(OutputFileError, match="holds a search over other plants"):
            Log(tmp_path, "other")


def test_a_log_gives_back_what_was_judged_and_has_refusals_tried_again(tmp_path: Path) -> None:
    from softneck.tuning._task import Judgement

    log = Log(tmp_path, "d")
    job = Job.of("pi", {"b": 1.25, "a": 1e-17 + 0.1}, "all")
    curves = {"low": [0.0] * 80, "high": [1.0] * 80, "value": [0.1] * 80, "reference": [1.0]}
    refused = Job.of("pi", {}, "all")
    log.found[refused] = Judgement({}, "no plant")
    log.found[job] = Judgement({"x": 1.0 / 3.0, "y": float("inf")}, curves=curves)
    log.write()
    again = Log(tmp_path, "d")
    assert refused in log.found
    assert again.found == {job: log.found[job]}
    # One of a softneck that kept no curves is judged again.
    content = json.loads((tmp_path / FILE).read_text())
    del content["evaluations"][1]["curves"]
    (tmp_path / FILE).write_text(json.dumps(content))
    assert Log(tmp_path, "d").found == {}
    assert job == Job.of("pi", {"a": 1e-17 + 0.1, "b": 1.25}, "all")


@pytest.mark.parametrize("size", [0, 1, 2, 3])
def test_work_is_given_out_two_to_a_worker_and_all_of_it_comes_back(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    """This process works too; what it leaves to workers leaves its own threads no core."""
    out, given, here, taken = set[str](), list[str](), list[str](), list[int]()

    def submit(call: Any) -> Future:
        future: Future = Future()
        future.set_result(call())
        given.append(call())
        out.add(call())
        assert len(out) <= 2 * size
        return future

    @contextlib.contextmanager
    def cores_taken(count: int) -> Iterator[None]:
        taken.append(count)
        assert count == len(out)
        yield

    jobs, back = [Job("pi", str(k), "all") for k in range(9)], []

    def took(job: Job, result: Any) -> None:
        if job.settings not in out:
            here.append(job.settings)
        out.discard(job.settings)
        back.append((job, result))

    monkeypatch.setattr(_search, "cores_taken", cores_taken)
    workers: Any = SimpleNamespace(size=size, pool=SimpleNamespace(submit=submit)) if size else None
    run_jobs(jobs, lambda job: lambda: job.settings, took, lambda: workers)  # pyright: ignore[reportArgumentType, reportReturnType]
    assert sorted(back, key=lambda pair: pair[1]) == [(job, job.settings) for job in jobs]
    # The better ones stand first: a search that is stopped has judged those.
    assert (given, here) == (sorted(given), sorted(here))
    assert len(here) == len(taken) == 9 - len(given)
    assert bool(given) == bool(size)
    # A single one is not given away: this process would wait for it.
    run_jobs(jobs[:1], lambda job: lambda: job.settings, took, lambda: workers)  # pyright: ignore[reportArgumentType, reportReturnType]
    assert (here[-1], taken[-1]) == ("0", 0)


@pytest.mark.parametrize(
    ("cores", "asked", "beside"), [(1, None, 0), (2, None, 1), (64, None, 7), (2, 5, 5), (8, 0, 0)]
)
def test_by_default_each_further_core_has_a_process_but_no_machine_has_more_than_seven(
    monkeypatch: pytest.MonkeyPatch, cores: int, asked: int | None, beside: int
) -> None:
    opened: list[int] = []

    def open_workers(number: int, dask: None) -> Any:
        assert dask is None
        opened.append(number)
        return contextlib.nullcontext()

    def run(search: Any) -> None:
        assert search.workers is None
        raise KeyboardInterrupt

    monkeypatch.setattr(_tune, "core_count", lambda: cores)
    monkeypatch.setattr(_tune, "open_workers", open_workers)
    monkeypatch.setattr(_search.Search, "run", run)
    with pytest.raises(KeyboardInterrupt):
        searched(workers=asked)
    assert opened == [beside] * bool(beside)


def test_a_worker_that_dies_ends_a_search_with_what_to_do() -> None:
    def submit(_: Any) -> Future:
        raise BrokenExecutor

    worker: Any = SimpleNamespace(size=1, pool=SimpleNamespace(submit=submit))
    with pytest.raises(SoftneckError, match=r"a worker process died .*; run the same command again"):
        run_jobs([Job("pi", "", "all")] * 2, lambda _: dict, lambda *_: None, lambda: worker)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kind", [*KINDS_SEARCHED, "nmpc"])
def test_every_point_of_a_space_is_a_setting_of_its_kind(kind: str) -> None:
    (space,) = spaces((kind,), rise=0.4, cocontraction=1.0, robot=Robot.preset())
    made = resolve(KINDS[kind].settings)
    rng = np.random.default_rng(0)
    n = len(space.dimensions)
    for x in (np.zeros(n), np.ones(n), space.start, *rng.random((5, n))):
        make_settings(made, space.settings(x))
    started = space.settings(space.start)
    if isinstance(started.get("reference_time"), list):
        started["reference_time"], started["lead"] = started["reference_time"]
    # To the four digits that settings are rounded to.
    assert all(started[item.name] == pytest.approx(item.start, rel=1e-3) for item in space.dimensions)


def test_what_cannot_be_tuned_is_refused() -> None:
    for kind, match in (("custom", "cannot be tuned"), ("pie", "unknown kind")):
        with pytest.raises(SettingsError, match=match):
            spaces((kind,), rise=0.4, cocontraction=None, robot=Robot.preset())
    with pytest.raises(SettingsError, match="no linear plant"):
        tune({})


@given(
    bound=st.sampled_from(["min", "max", "below"]),
    limit=st.floats(1e-3, 1e3),
    value=st.one_of(st.floats(0.0, 1e4), st.just(float("inf"))),
)
def test_a_ratio_is_at_most_one_exactly_where_the_requirement_holds(bound: str, limit: float, value: float) -> None:
    item = Requirement("x", bound, limit, True)
    # Of two floats whose quotient rounds to 1 nothing can be said.
    if value == limit or abs(value / limit - 1.0) > 1e-12:
        assert (ratio(item, value) <= 1.0) == item.holds(value)


def candidate(**metrics: float) -> Candidate:
    # With a linear form, whose margins are known.
    named = {"axes.sensitivity": 1.2} | {name.replace("__", "."): value for name, value in metrics.items()}
    return Candidate("pi", {}, np.zeros(1), "all", named)


BOUNDS = (Requirement("sim.rise_s", "max", 0.4, True), Requirement("sim.overshoot_pct", "max", 5.0, True),
          Requirement("axes.gain_margin", "min", 2.0, True))  # fmt: skip


def test_the_front_is_what_no_other_beats() -> None:
    rng = np.random.default_rng(1)
    items = [candidate(a=x, axes__gain_margin=y) for x, y in rng.integers(0, 6, (40, 2)).astype(float)]
    kept = front(items, ["a", "axes.gain_margin"])
    assert front([], ["a"]) == front(items, []) == []
    # It begins with the best in the first objective.
    apart = [candidate(a=x, b=-x) for x in (2.0, 1.0, 3.0)]
    for names in (["a", "b"], ["b", "a"]):
        firsts = [item.metrics[names[0]] for item in front(apart, names)]
        assert firsts == sorted(item.metrics[names[0]] for item in apart)

    def beats(one: Candidate, other: Candidate) -> bool:
        p, q = ((item.metrics["a"], -item.metrics["axes.gain_margin"]) for item in (one, other))
        return p[0] <= q[0] and p[1] <= q[1] and p != q

    assert {id(item) for item in kept} == {id(item) for item in items if not any(beats(other, item) for other in items)}


def test_what_binds_is_what_alone_must_give_way_least() -> None:
    fast = candidate(sim__rise_s=0.3, sim__overshoot_pct=7.0, axes__gain_margin=2.5)
    slow = candidate(sim__rise_s=0.52, sim__overshoot_pct=5.0, axes__gain_margin=2.5)
    loud = candidate(sim__rise_s=0.3, sim__overshoot_pct=6.0, axes__gain_margin=1.0)
    assert active_requirement([fast, slow, loud], BOUNDS, tested=False) == ("sim.rise_s", pytest.approx(0.52))
    slower = candidate(sim__rise_s=0.55, sim__overshoot_pct=5.0, axes__gain_margin=2.5)
    for listed in ([slow, slower, loud], [slower, slow, loud]):
        assert active_requirement(listed, BOUNDS, tested=False) == ("sim.rise_s", pytest.approx(0.52))
    assert active_requirement([fast, loud], BOUNDS, tested=False) == ("sim.overshoot_pct", pytest.approx(7.0))
    assert active_requirement([loud], BOUNDS, tested=False) == ("axes.gain_margin", None)
    # Of several that miss two limits the best tells which.
    worst = candidate(sim__rise_s=0.9, sim__overshoot_pct=30.0, axes__gain_margin=1.0)
    for listed in ([loud, worst], [worst, loud]):
        assert active_requirement(listed, BOUNDS, tested=False) == ("axes.gain_margin", None)
    good = candidate(sim__rise_s=0.3, sim__overshoot_pct=5.0, axes__gain_margin=2.0)
    assert active_requirement([good, slow], BOUNDS, tested=False) == (None, None)


@pytest.mark.parametrize("tested", [True, False])
def test_what_was_not_computed_does_not_bind(tested: bool) -> None:
    """`adaptive` has no linear form: beside recordings its Ms counts as broken, and nobody knows it."""
    bounds = (Requirement("axes.sensitivity", "max", 2.5, True), *BOUNDS[:2])
    blind = candidate(sim__rise_s=0.5, sim__overshoot_pct=3.0)
    del blind.metrics["axes.sensitivity"]
    assert blind.cost(bounds, tested=tested) > 1.0
    assert active_requirement([blind], bounds, tested=tested) == ("sim.rise_s", None)
    blind.metrics["sim.rise_s"] = 0.3
    assert blind.cost(bounds, tested=tested) > 1.0
    assert active_requirement([blind], bounds, tested=tested) == (None, None)


@pytest.mark.parametrize("asked", [True, False])
@pytest.mark.parametrize("tested", [True, False])
def test_a_margin_that_was_not_computed_does_not_hold(tested: bool, asked: bool) -> None:
    """`adaptive` was picked with all its rows of margins empty: what nobody computed was taken to be at its limit."""
    bounds = (Requirement("axes.sensitivity", "max", 2.5, asked), *BOUNDS[:2])
    blind = candidate(sim__rise_s=0.3, sim__overshoot_pct=3.0)
    del blind.metrics["axes.sensitivity"]
    assert not blind.holds(bounds, tested=tested)
    slow = candidate(sim__rise_s=0.52, sim__overshoot_pct=3.0)
    # One that misses a limit by a third is the better one, and nothing is said about the blind one's other limits.
    assert slow.cost(bounds, tested=tested) < blind.cost(bounds, tested=tested)
    assert active_requirement([blind], bounds, tested=tested) == (None, None)


@pytest.mark.parametrize(
    ("asked", "judged"), [(0.0, None), (0.01, 20.0), (5.0, 20.0), (20.0, 20.0), (29.0, 20.0), (60.0, 60.0)]
)
def test_each_condition_asked_is_judged_or_said(asked: float, judged: float | None) -> None:
    """Directions, sizes and payloads are loops of their own; a delay is whole samples, at least one."""
    table = {"track": {"delay_ms": asked}, "sim": {"payloads_kg": [0.0, 0.32], "orientations_deg": [0.0, 30.0, 90.0]}}
    task, own = task_of({"neck": neck()}, table, 0), [make_simulation_model(NeckParameters.paper(), "own")]
    every = cases(own, task.asked, task.robot)
    assert {(case.payload, round(math.degrees(case.orientation)), case.part) for case in every} >= {
        (kg, angle, 1.0) for kg in (0.0, 0.32) for angle in (0, 30, 90)
    }
    assert {case.part for case in every} == {1.0, task.asked.track["small_part"]}
    assert {case.payload for case in every if case.late} == {0.0, 0.32}
    told = told_conditions(task, own, 0.02)
    if judged is None or judged == asked:
        assert not told
    else:
        assert told == {f"additional delay {asked:g} ms": f"judged at {judged:g} ms, whole samples of the loop"}
    assert judged is None or judged_delay(asked, 0.02) == pytest.approx(1e-3 * judged)


def test_a_value_that_is_no_number_does_not_hold() -> None:
    for bound in BOUNDS:
        assert ratio(bound, math.nan) == math.inf
    item = candidate(sim__rise_s=math.nan, sim__overshoot_pct=3.0)
    assert not item.holds(BOUNDS[:2], tested=False)


@pytest.mark.parametrize(
    ("metrics", "cost", "said"),
    [
        ({"sim.rise_s": 0.444, "sim.overshoot_pct": 5.04, "axes.gain_margin": 2.345}, 0.9,
         "best pi, rise 0.44 s, overshoot 5.0 %, gain margin 2.3, all hold"),
        # Of loops before that of linear plants; what is unknown or never reached is left out.
        ({"sim.rise_s": math.inf, "step.rise_s": 0.3, "sim.overshoot_pct": 7.0, "step.overshoot_pct": 1.0}, 1.25,
         "best pi, rise 0.30 s, overshoot 7.0 %, 0.25 beyond limits"),
        ({"axes.gain_margin": math.nan}, 1.0, "best pi, all hold"), ({}, math.inf, "best pi, inf beyond limits"),
    ],
)  # fmt: skip
def test_the_best_so_far_is_said_in_words(metrics: dict[str, float], cost: float, said: str) -> None:
    assert in_words(Candidate("pi", {}, np.zeros(1), "all", metrics), cost) == said


@pytest.mark.parametrize("kind", ["pi", "lqg"])
def test_each_kind_and_seed_draws_its_own_candidates(kind: str) -> None:
    (space,) = spaces((kind,), rise=0.4, cocontraction=None, robot=Robot.preset())

    def first(*given: Any) -> tuple[float, ...]:
        return tuple(_optimiser(space, *given).ask())

    drawn = [first(seed, number) for seed in (0, 1, 2**31 - 2) for number in (0, 1, 6)]
    assert len(set(drawn)) == len(drawn)
    assert first(1, 1) == drawn[4]


def test_few_requirements_are_broken_rather_than_all_a_little() -> None:
    one = candidate(sim__rise_s=0.5, sim__overshoot_pct=4.0, axes__gain_margin=2.1)
    each = candidate(sim__rise_s=0.46, sim__overshoot_pct=5.75, axes__gain_margin=2.1)
    good = candidate(sim__rise_s=0.4, sim__overshoot_pct=5.0, axes__gain_margin=2.0)
    costs = [item.cost(BOUNDS, tested=False) for item in (good, one, each)]
    assert costs[0] <= 1.0 < costs[1] < costs[2]
    # A quarter beyond, of which 4 at most count; and what breaks ties, 0.02 at most.
    assert 1.0 + 0.25 / (1.0 + 0.25 / 4.0) < costs[1] < 1.02 + 0.25 / (1.0 + 0.25 / 4.0)


KNOWN = ("axes.sensitivity", "axes.gain_margin", "mimo.disk_margin", "sim.rise_s", "sim.overshoot_pct")
JUDGED = tuple(Requirement(name, "min" if "margin" in name else "max", limit, False)
               for name, limit in zip(KNOWN, (2.5, 2.0, 0.4, 0.4, 5.0), strict=True))  # fmt: skip
ANY = st.one_of(st.floats(0.01, 100.0), st.sampled_from([0.0, math.inf]))


def of(values: Iterable[float], kind: str = "pi") -> Candidate:
    return Candidate(kind, {}, np.zeros(1), "all", dict(zip(KNOWN, values, strict=True)))


@given(st.tuples(*[ANY] * len(KNOWN)), st.tuples(*[ANY] * len(KNOWN)), st.booleans())
def test_what_another_beats_in_everything_never_comes_first(one: Any, other: Any, tested: bool) -> None:
    better = [(max if item.bound == "min" else min)(p, q) for item, p, q in zip(JUDGED, one, other, strict=True)]
    assert of(better).cost(JUDGED, tested=tested) <= of(one).cost(JUDGED, tested=tested)
    broken = [ratio(item, p) > 1.0 and ratio(item, q) < ratio(item, p)
              for item, p, q in zip(JUDGED, one, better, strict=True)]  # fmt: skip
    # Also among those that are far beyond their limits: 1e6 of which differ by less than rounding.
    far = max((ratio(item, p) for item, p in zip(JUDGED, one, strict=True) if ratio(item, p) < math.inf), default=0.0)
    if any(broken) and far < 1e6:
        assert of(better).cost(JUDGED, tested=tested) < of(one).cost(JUDGED, tested=tested)


@given(st.tuples(*[ANY] * len(KNOWN)), st.booleans())
def test_what_was_judged_at_fewer_metrics_never_wins_for_that(values: Any, tested: bool) -> None:
    whole, blind = of(values, "pi"), of(values, "mpc")
    for name in ("axes.sensitivity", "axes.gain_margin", "mimo.disk_margin"):
        del blind.metrics[name]
    costs = [item.cost(JUDGED, tested=tested) for item in (whole, blind)]
    if tested or whole.holds(JUDGED, tested=False):
        assert costs[0] <= costs[1]


def test_what_is_not_certified_is_as_bad_in_whatever_way_that_is_told() -> None:
    # On `chain` the loops of an `mpc`, whose margins nobody certifies, came before those of a `pi` that crosses where
    # nobody recorded: one counted twice its limits, the other a thousand times.
    mpc = Candidate("mpc", {}, np.zeros(1), "all", {"sim.rise_s": 1.16, "sim.overshoot_pct": 8.6})
    pi = of((math.inf, 0.0, 0.0, 0.34, 1.5))
    assert pi.cost(JUDGED, tested=True) < mpc.cost(JUDGED, tested=True)
    assert not mpc.holds(JUDGED, tested=True)


def test_what_is_known_twice_counts_by_the_worse() -> None:
    from softneck.tuning._task import Judgement

    item = candidate(axes__gain_margin=2.5)
    item.update("margins", Judgement({"axes.gain_margin": 1.8, "axes.delay_margin_ms": 90.0}))
    assert item.metrics["axes.gain_margin"] == 1.8
    item.update("margins", Judgement({"axes.gain_margin": 4.0}))
    assert item.metrics["axes.gain_margin"] == 1.8


def test_where_draws_decide_a_search_is_not_led_by_linear_requirements() -> None:
    def led_by(drawn: tuple[str, ...], require: dict[str, Any]) -> set[str]:
        task: Any = SimpleNamespace(asked=make_tune_requirements({"require": require}), drawn=drawn)
        return {item.metric for item in Task.bounds.fget(task)}  # pyright: ignore[reportOptionalCall]

    every, led = led_by((), {}), led_by(("draw",), {})
    shown = {
        "stability.radius",
        "axes.sensitivity",
        "mimo.disk_margin",
        "robust.mu",
        "step.overshoot_pct",
        "step.settling_s",
    }
    assert shown <= every
    assert led < every
    assert not shown & led
    # No loop of the search tells the error under a load; margins come before loops.
    assert {"axes.gain_margin", "axes.delay_margin_ms", "step.load_rms_deg", "sim.rise_s", "track.ahead_rms_deg"} <= led
    # What somebody states counts.
    assert led_by(("draw",), {"step.overshoot_pct": {"max": 9.0}}) == led | {"step.overshoot_pct"}


@pytest.mark.slow
def test_draws_that_a_search_sees_are_in_no_certificate_and_decide_for_linear_margins() -> None:
    draws = small_draws()
    asked = {"sampling": {"plants": 30, "search_generations": 0},
             "sim": {"payloads_kg": [0.0], "orientations_deg": [0.0], "size_deg": 10.0},
             "require": {"sim.rise_s": {"max": 0.9}}}  # fmt: skip
    found = tune({"neck": replace(family(), draws=draws)}, asked, kinds=("pi",), budget=4, workers=0)
    assert found.task.drawn[:4] == tuple(f"neck, draw {k + 1}" for k in range(4))
    assert "axes.sensitivity" not in {bound.metric for bound in found.task.bounds}
    [part] = found.verification.evidence.drawn
    assert part.count == draws.count
    told = [item["name"] for rows in part.conditions.values() for item in rows]
    assert not [name for name in told if "neck, draw" in name]
    seen = {model.arrays["weights"].tobytes() for model in draws.for_search()}
    assert not seen & {model.arrays["weights"].tobytes() for model in draws.for_certificate(part.attempt)}


# What is searched of each kind: (setting, lowest, highest, start). Ms of 3 leaves a gain margin of 1.5, Ms of 1.15 one
# of 7.7; phase margins are what those of the kind are designed for.
DEGREE = math.radians(1.0)
SEARCHED = {
    "pi": [("max_sensitivity", 1.15, 2.5, 1.5), ("phase_margin", 40 * DEGREE, 80 * DEGREE, 1.05)],
    "pid": [("max_sensitivity", 1.2, 3.0, 1.5), ("noise_gain", 2.0, 10.0, 5.0)],
    "fopi": [("max_sensitivity", 1.2, 3.0, 1.5), ("phase_margin", 60 * DEGREE, 100 * DEGREE, 1.4)],
    "hinf": [("max_sensitivity", 1.2, 3.0, 1.5), ("control_weight", 0.05, 1.0, 0.3)],
    "lqg": [("max_sensitivity", 1.2, 3.0, 1.4), ("control_weight", 0.01, 1.0, 0.06), ("input_noise", 1.0, 100.0, 5.0)],
    "adaptive": [("max_sensitivity", 1.15, 2.0, 1.5), ("phase_margin", 0.7, 1.4, 1.05)],
    "mpc": [("max_sensitivity", 1.2, 2.5, 1.5)],
    "nmpc": [],
}


@pytest.mark.parametrize("kind", SEARCHED)
@pytest.mark.parametrize(("least", "preset"), [(0.0, "neck"), (0.3, "finger"), (9.0, "neck")])
def test_what_is_searched_of_a_kind_has_its_range_and_its_start(kind: str, least: float, preset: str) -> None:
    """Speeds are in parts of the rise that is asked, and no shorter than the motors allow; leads in their unit."""
    robot, rise = Robot.preset(preset), 0.5
    unit = Scaling.of(robot).motor_unit
    (space,) = spaces((kind,), rise=rise, cocontraction=0.7, robot=robot, least=least)
    found = [(item.name, item.low, item.high, item.start) for item in space.dimensions]
    short = min(least, rise)
    linear = kind not in ("adaptive", "mpc", "nmpc")
    speed = (
        [("reference_time", 0.05 * rise, 0.6 * rise, 0.25 * rise), ("lead", 0.2, 2.5, 1.0)] if linear
        else [("rise_s", max(0.3 * rise, 1.03 * short), 1.2 * rise, max(0.42 * rise, 1.03**2 * short))]
    )  # fmt: skip
    ahead = [("lead_limit", 0.4 * unit, 2.0 * unit, 0.8 * unit)] if kind in ("mpc", "nmpc") else []
    assert [row[0] for row in found] == [row[0] for row in (*speed, *SEARCHED[kind], *ahead)]
    for row, expected in zip(found, (*speed, *SEARCHED[kind], *ahead), strict=True):
        assert row[1:] == pytest.approx(expected[1:])
    for item in space.dimensions:
        assert 0.0 < item.start_part < 1.0
        assert (item.value(0.0), item.value(1.0)) == pytest.approx((item.low, item.high), rel=1e-3)
        assert item.value(item.start_part) == pytest.approx(item.start, rel=1e-3)
        assert item.value(0.5) == pytest.approx(math.sqrt(item.low * item.high), rel=1e-3)
        assert (item.value(-1.0), item.value(2.0)) == (item.value(0.0), item.value(1.0))
    names = [item.name for item in space.dimensions]
    assert space.trade_off == (names.index("max_sensitivity") if "max_sensitivity" in names else None)
    pulls = {"mpc": {}, "nmpc": {"minimum_tautness": 0.7}}.get(kind, {"least_cocontraction": 0.7})
    assert {key: value for key, value in space.fixed.items() if key != "lead_limit"} == pulls
    assert ("lead_limit" in space.fixed) is (not ahead)
    assert space.fixed.get("lead_limit", 0.6 * unit) == pytest.approx(0.6 * unit)
    settings = space.settings(space.start)
    if linear:
        assert settings["reference_time"] == pytest.approx([0.25 * rise, 1.0], rel=1e-3)
        assert "lead" not in settings
    (free,) = spaces((kind,), rise=rise, cocontraction=None, robot=robot)
    assert set(free.fixed) <= {"lead_limit"}
