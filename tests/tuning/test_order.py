"""A candidate is judged by the worst plant, loop, payload and axis; what is no number never counts as good."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from softneck.cli._tune import command as tune_command
from softneck.core import KINDS, CheckFailedError, DataError, SettingsError, metric_of, resolve
from softneck.estimation import LinearNeck
from softneck.loop import LoopResult, RobotReference
from softneck.robot import Robot, Scaling
from softneck.tuning import _certify, _compare, _judge, _search, _tune, task_of
from softneck.tuning._compare import front
from softneck.tuning._judge import (
    LEVELS,
    Case,
    cases,
    judge_candidate,
    keep_worse,
    linear_metrics,
    loop_metrics,
    loop_of,
    margin_metrics,
    run_case,
    told_conditions,
    variation,
)
from softneck.tuning._requirements import make_tune_requirements
from softneck.tuning._search import Candidate, Search, ratio
from softneck.tuning._space import COSTLY, spaces
from softneck.tuning._task import Job, Judgement, Task, circle_angles, curve_times
from softneck.verification import LARGE, SMALL, Scale, metric_names
from softneck.verification._linear import AxisMargins
from softneck.verification._requirements import Requirement
from softneck.verification._verify import Verdict

from ..design.test_robots import BELLOWS, LEARNED
from ..order import MEMBERS, check_worst, is_worse
from ..verification.necks import family, linear_neck
from .test_requirements import axis

TS = 0.02
ALL = metric_names(Robot.preset(), track=True)
LOOPED = [name for name in ALL if name.startswith(("sim.", "track."))]


@pytest.mark.parametrize("name", ALL)
def test_the_worse_of_two_is_kept(name: str) -> None:
    def of(values: Any) -> float:
        found: dict[str, float] = {}
        for value in values:
            keep_worse(found, name, value)
        return found[name]

    check_worst(name, of)


def _task(**more: Any) -> Any:
    certificate = SimpleNamespace(
        uncertainty={"rolloff_db_per_decade": -1.0}, scale=Scale(), step_test=lambda seed: seed, **more
    )
    return SimpleNamespace(
        asked=SimpleNamespace(certificate=certificate), linear={}, drawn=(), seed=1, robot=Robot.preset()
    )


@pytest.mark.parametrize("name", [name for name in LOOPED if not name.startswith("track.c") and "ahead" not in name])
def test_every_loop_of_a_candidate_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean over plants, or the last one, in place of the worst would reward a candidate that one plant breaks."""

    def of(values: Any) -> float:
        told = iter(values)
        monkeypatch.setattr(_judge, "run_case", lambda *_: ({name: next(told)}, None))
        ready: Any = SimpleNamespace(own=[None])
        block: Any = SimpleNamespace(sample_time=TS)
        return loop_metrics(_task(), ready, block, "sequential", [Case(0, 0.0)] * len(values))[name]

    check_worst(name, of)


def test_a_circle_is_judged_by_the_worst_plant_at_one_lead_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [np.array([4.0, 1.0, 3.0, 5.0]), np.array([5.0, 6.0, 2.0, 1.0]), np.array([3.0, 2.0, 1.0, 0.5])]

    def judged(shifts: list[np.ndarray]) -> dict[str, float]:
        told = iter(shifts)
        monkeypatch.setattr(_judge, "run_case", lambda *_: ({}, next(told)))
        ready: Any = SimpleNamespace(own=[None])
        block: Any = SimpleNamespace(sample_time=TS)
        return loop_metrics(_task(), ready, block, "sequential", [Case(0, 0.0, circle=True)] * len(shifts))

    # Worst over the plants: 5, 6, 3, 5: the lead of two samples is the best for all.
    best = {"track.ahead_rms_deg": 3.0, "track.ahead_s": pytest.approx(2 * TS), "track.circle_rms_deg": 5.0}
    for order in (rows, rows[::-1]):
        found = judged(order)
        assert found == best
    lost = judged([*rows, np.full(4, math.inf)])
    assert lost["track.ahead_rms_deg"] == lost["track.circle_rms_deg"] == math.inf
    unknown = judged([*rows, np.array([math.nan, math.nan, 3.0, math.nan])])
    assert unknown == {**best, "track.circle_rms_deg": math.inf}


AXES = ("pitch", "roll")
# A linear check is of the controller in the order of its design, without an observer, in one thread of its worker.
ALONE = {"order": None, "observer": False}
OWN = [f"{axis}.{last}" for axis in AXES for last in (*LARGE, *SMALL)]
LINEAR = [*OWN, "stability.radius", "mimo.disk_margin", "step.rise_s", "step.coupling_deg"]


def _margins(values: Any, name: str) -> dict[str, np.ndarray]:
    """Return margins of plants, of which `name` is as given."""
    table = {f"{axis}.{last}": np.full(len(values), 2.0) for axis in AXES for last in (*LARGE, *SMALL)}
    return {"stability.radius": np.full(len(values), 0.9), "mimo.disk_margin": np.full(len(values), 0.5), **table,
            name: np.array(values)}  # fmt: skip


@pytest.mark.parametrize("name", LINEAR)
def test_every_linear_plant_law_and_axis_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plants: Any = SimpleNamespace(axes=AXES, later=lambda _: plants)
    ready: Any = SimpleNamespace(plants=plants, frequency=None, weights=None)

    def judged(values: Any, laws: int) -> dict[str, float]:
        """Return the metrics where the values are spread over so many linear forms."""
        parts = iter(np.array_split(np.array(values), laws))
        one = SimpleNamespace(laws={str(k): k for k in range(laws)}, extra=0, block=None)
        monkeypatch.setattr(_judge, "controller_under_test", lambda *_, **__: one)
        monkeypatch.setattr(_judge, "margins", lambda *_: _margins(next(parts), name))
        monkeypatch.setattr(_judge, "data_margins", lambda *_: [])
        steps = {key: np.array(values) for key in ("rise_s", "coupling_deg")}
        monkeypatch.setattr(_judge, "run_steps", lambda *_, **__: SimpleNamespace(metrics=steps))
        return linear_metrics(_task(), ready, None)

    check_worst(name, lambda values: judged(values, 1)[name])
    if name.startswith("step."):
        return
    for order in (MEMBERS, MEMBERS[::-1]):
        assert judged(order, 2)[name] == judged(MEMBERS, 1)[name]
    last = name.partition(".")[2]
    if name.startswith(AXES):
        # The other axis stands at 2: "axes" has the worse of both.
        expected = min(MEMBERS) if last in LARGE else max(MEMBERS)
        assert judged(MEMBERS, 1)[f"axes.{last}"] == expected
        assert judged((2.5,) if last in LARGE else (1.5,), 1)[f"axes.{last}"] == 2.0
    else:
        assert "axes.radius" not in judged(MEMBERS, 1)


def test_margins_that_the_data_support_count_where_they_are_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    plants: Any = SimpleNamespace(axes=AXES, later=lambda _: plants)
    ready: Any = SimpleNamespace(plants=plants, frequency=None, weights=None)
    one = SimpleNamespace(laws={"": None}, extra=0, block=None)
    monkeypatch.setattr(_judge, "controller_under_test", lambda *_, **__: one)
    monkeypatch.setattr(_judge, "margins", lambda *_: _margins([2.0], "stability.radius"))
    monkeypatch.setattr(_judge, "run_steps", lambda *_, **__: SimpleNamespace(metrics={}))

    def judged(*items: AxisMargins) -> dict[str, float]:
        monkeypatch.setattr(_judge, "data_margins", lambda *_: list(items))
        return linear_metrics(_task(), ready, None)

    def tested(axis: str, margins: Mapping[str, float], mu: float) -> AxisMargins:
        return AxisMargins(source="f", axis=axis, band=(1.0, 9.0), crossover=3.0, margins=margins, mu=mu, at={})

    low = tested("pitch", {"gain_margin": 1.4, "disk_margin": 0.3, "sensitivity": 3.0}, 0.4)
    found = judged(low, tested("roll", {"gain_margin": 9.0, "disk_margin": 9.0, "sensitivity": 1.0}, 0.7))
    assert (found["pitch.gain_margin"], found["axes.gain_margin"], found["roll.gain_margin"]) == (1.4, 1.4, 2.0)
    assert (found["pitch.disk_margin"], found["mimo.disk_margin"], found["roll.disk_margin"]) == (0.3, 0.3, 2.0)
    assert (found["axes.sensitivity"], found["roll.sensitivity"]) == (3.0, 2.0)
    assert "mimo.gain_margin" not in found
    assert found["robust.mu"] == 0.7
    assert judged(low, tested("roll", low.margins, math.nan))["robust.mu"] == math.inf
    # A loop that may cross outside the band has none at all.
    none = judged(tested("roll", {}, 0.1))
    for last in LARGE:
        assert none[f"roll.{last}"] == none[f"axes.{last}"] == 0.0
        assert none[f"pitch.{last}"] == 2.0
    assert none["roll.sensitivity"] == none["axes.sensitivity"] == math.inf
    assert none["mimo.disk_margin"] == 0.0


@pytest.mark.parametrize("drawn", [(), ("f, draw 1",)])
@pytest.mark.parametrize("extra", [0, 2])
def test_linear_checks_are_of_plants_as_late_as_the_loop_and_of_the_data_where_no_draws_decide(
    extra: int, drawn: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A delay that the loop's order adds takes phase: without it each margin would be too good."""
    plants = SimpleNamespace(later=lambda samples: SimpleNamespace(axes=AXES, samples=samples))
    one = SimpleNamespace(laws={"": "law"}, extra=extra, block="block")
    asked: list[Any] = []
    named: list[Any] = []
    monkeypatch.setattr(_judge, "controller_under_test", lambda *given, **more: named.append((given, more)) or one)
    monkeypatch.setattr(_judge, "margins", lambda *given: asked.append(given) or {})
    monkeypatch.setattr(_judge, "data_margins", lambda *given: asked.append(given) or [])
    steps = SimpleNamespace(metrics={})
    monkeypatch.setattr(_judge, "run_steps", lambda *given, **more: named.append(more) or asked.append(given) or steps)
    task = _task()
    task.drawn, task.linear = drawn, {"f": 1}
    assert linear_metrics(task, SimpleNamespace(plants=plants, weights="W"), "c") == {}  # pyright: ignore[reportArgumentType]
    assert named == [(("c",), ALONE), {"robot": task.robot, "weights": "W"}]
    by_data = [] if drawn else [({"f": 1}, "law", AXES, extra, -1.0)]
    assert [given for given in asked if given[0] == {"f": 1}] == by_data
    linear = [given for given in asked if given[0] != {"f": 1}]
    assert [given[0].samples for given in linear] == [extra, extra]
    assert [given[1] for given in linear] == ["law", "block"]
    assert linear[1][2] == task.seed


@pytest.mark.parametrize("name", ["axes.gain_margin", "axes.delay_margin_ms"])
def test_a_margin_by_experiment_is_the_smallest_of_all_loops(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    task = _task()
    ready: Any = SimpleNamespace(own=())
    monkeypatch.setattr(_judge, "loops_under_test", lambda *_, **__: [None])
    monkeypatch.setattr(_judge, "crossings", lambda *_, **__: None)

    def of(values: Any) -> float:
        table = {name: (np.array(values), []), "pitch.gain_margin": (np.array([0.1]), [])}
        monkeypatch.setattr(_judge, "crossing_values", lambda _: table)
        found = margin_metrics(task, ready, SimpleNamespace(), "sequential")  # pyright: ignore[reportArgumentType]
        assert set(found) == {name}
        return found[name]

    check_worst(name, of)
    monkeypatch.setattr(_judge, "loops_under_test", lambda *_, **__: [])
    assert margin_metrics(task, ready, SimpleNamespace(), "sequential") == {}  # pyright: ignore[reportArgumentType]


# -- one case ---------------------------------------------------------------------------------------------------------

VALUES = {"overshoot_pct": 1.0, "rise_s": 2.0, "settling_s": 3.0, "steady_rms_deg": 4.0, "rms_error_deg": 5.0,
          "max_rad": 6.0, "limit_violation_s": 7.0, "slack_s": 8.0}  # fmt: skip


def _case(monkeypatch: pytest.MonkeyPatch, case: Case, values: dict[str, float], result: Any = None) -> Any:
    asked: list[str] = []

    def judge(loop: Any, *, compiled: bool, angle: str) -> Any:
        assert compiled  # thousands of loops
        asked.append(angle)
        return values, result

    monkeypatch.setattr(_judge, "loop_of", lambda *_: None)
    monkeypatch.setattr(_judge, "judge_loop", judge)
    monkeypatch.setattr(_judge, "variation", lambda _: 9.0)
    task = _task()
    task.asked.shows_settling = lambda part: part == 1.0
    found, distances = run_case(case, None, None, "sequential", task)  # pyright: ignore[reportArgumentType]
    assert distances is None
    return found, asked[0]


@pytest.mark.parametrize("name", ["sim.rise_s", "axes.gain_margin", "axes.delay_margin_ms"])
def test_a_final_candidate_is_judged_on_its_own_plants_and_on_all_draws_of_each_family(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plants = [SimpleNamespace(name="mine"), SimpleNamespace(name="f, draw 1")]
    families = {"f": SimpleNamespace(draws="F"), "g": SimpleNamespace(draws="G"), "n": SimpleNamespace(draws=None)}
    task: Any = _task()
    task.linear, task.drawn = {**families, "m": 1}, ("f, draw 1",)
    asked: list[Any] = []
    values = {"f": [2.0, 3.0], "g": [1.0, 4.0]}

    def run(family: str, draws: str, block: Any, certificate: Any, **more: Any) -> Any:
        asked.append((family, draws, block, more["order"], more["observer"], more["attempt"]))
        return SimpleNamespace(values={name: np.array(values[family])})

    monkeypatch.setattr(_judge, "run_drawn", run)
    tried: list[Any] = []

    def loops(block: str, own: Any, certificate: Any, **more: Any) -> list[str]:
        tried.append((block, certificate, more))
        return [plant.name for plant in own]

    monkeypatch.setattr(_judge, "loops_under_test", loops)
    monkeypatch.setattr(_judge, "crossings", lambda loops, **more: tried.append((loops, more)) or loops)
    monkeypatch.setattr(_judge, "crossing_values", lambda loops: {"axes.gain_margin": ([9.0] * len(loops), loops)})
    found = margin_metrics(task, SimpleNamespace(own=plants), "block", "parallel", "eyes")  # pyright: ignore[reportArgumentType]
    asked_for = ("block", task.asked.certificate, {"order": "parallel", "observer": "eyes"})
    assert tried == [asked_for, (["mine"], {"overall": True})]
    # Attempt 0: no draw of a certificate is seen. The draws that lead the search are among them.
    assert asked == [(f, f.upper(), "block", "parallel", "eyes", 0) for f in "fg"]
    assert found == {"axes.gain_margin": 9.0, name: 1.0 if metric_of(name).larger else 4.0}


def test_a_case_tells_all_that_is_judged_and_only_slack_may_be_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {f"sim.{name}": value for name, value in VALUES.items() if name != "limit_violation_s"}
    assert _case(monkeypatch, Case(0, 0.0), VALUES) == (told, "measured")
    for name in VALUES:
        found, _ = _case(monkeypatch, Case(0, 0.0), {**VALUES, name: math.nan})
        if name in ("slack_s", "limit_violation_s"):
            assert f"sim.{name}" not in found
        else:
            assert math.isnan(found[f"sim.{name}"])


@pytest.mark.parametrize("circle", [False, True])
def test_a_circle_tells_distances_and_no_metrics_and_a_step_the_other_way_round(
    circle: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = _task()
    task.asked.shows_settling = lambda _: True
    case = Case(1, 0.5, noise=True, circle=circle)
    given = (case, "plant", "block", "parallel", task, "eyes")
    judged: list[Any] = []
    monkeypatch.setattr(_judge, "loop_of", lambda *told: told)
    monkeypatch.setattr(_judge, "_distances", lambda *told: told)
    monkeypatch.setattr(_judge, "judge_loop", lambda loop, **_: judged.append(loop) or (VALUES, None))
    metrics, distances = run_case(*given)  # pyright: ignore[reportArgumentType]
    assert judged == [given] * (not circle)
    assert (bool(metrics), distances) == ((False, (given, task)) if circle else (True, None))


def test_percentages_of_a_small_step_are_left_out_and_its_variation_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    found, angle = _case(monkeypatch, Case(0, 0.0, part=0.5, noise=True), VALUES, SimpleNamespace())
    assert angle == "true"
    left = ("rise_s", "steady_rms_deg", "rms_error_deg", "max_rad", "slack_s")
    assert found == {**{f"sim.{name}": VALUES[name] for name in left}, "track.variation_rad_s": 9.0}
    for case in (Case(0, 0.0, part=0.5), Case(0, 0.0, noise=True)):
        assert "track.variation_rad_s" not in _case(monkeypatch, case, VALUES, SimpleNamespace())[0]
    diverged = _case(monkeypatch, Case(0, 0.0, part=0.5, noise=True), VALUES, None)[0]
    assert diverged["track.variation_rad_s"] == math.inf


def test_variation_is_of_all_motors_and_moves_up_and_down() -> None:
    rows = 11
    zigzag = 0.1 * (np.arange(rows) % 2)
    signals = {"motor_setpoint_1": zigzag, "motor_setpoint_2": -2.0 * zigzag, "motor_setpoint_3": np.zeros(rows)}
    result = LoopResult(np.arange(rows) * TS, signals, {}, TS)
    assert variation(result) == pytest.approx(10 * (0.1 + 0.2) / (10 * TS))
    in_bar = {
        f"{name}_setpoint": 1e5 * values
        for name, values in zip("abcd", (zigzag, zigzag, 0 * zigzag, zigzag), strict=True)
    }
    of_bellows = LoopResult(result.time, in_bar, {}, TS, robot=BELLOWS)
    assert variation(of_bellows) == pytest.approx(10 * 0.3 / (10 * TS))  # bar/s


PAIR: Any = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def test_curves_have_set_points_and_their_common_part_in_the_motors_unit() -> None:
    # Of the last plant. What moves no output is the mean of four chambers in a ring, and nothing where each is alone.
    y, P = np.array([[0.0, 3.0], [2.0, 1.0]]), 1e5 * np.array([[1.0, 1.0, 1.0, 1.0], [0.5, 1.0, 2.0, 2.5]])
    ring: Any = SimpleNamespace(weights=[np.eye(3, 4) - np.eye(3, 4, 1)])
    task = task_for({}, robot=BELLOWS)
    found = {name: list(values) for name, values in _judge._step_curves(task, ring, y, P).items()}
    assert found.pop("tautness") == pytest.approx([1.0, 1.5])
    assert found == {
        "low": [0.0, 1.0], "high": [2.0, 3.0], "value": [2.0, 1.0],
        **{f"set_point_{j + 1}": list(P[:, j] / 1e5) for j in range(4)},
    }  # fmt: skip
    alone: Any = SimpleNamespace(weights=[LEARNED])
    assert _judge._step_curves(task, alone, y, P).keys() == found.keys()
    # Two of four that pull against each other are enough: their part of the mean.
    pair: Any = SimpleNamespace(weights=[PAIR])
    assert _judge._step_curves(task, pair, y, P)["tautness"] == pytest.approx([0.5, 0.375])


# -- candidates -------------------------------------------------------------------------------------------------------


def _bound(name: str, limit: float = 2.0) -> Requirement:
    return Requirement(name, "min" if metric_of(name).larger else "max", limit, False)


@pytest.mark.parametrize("name", ALL)
def test_a_worse_value_never_has_a_smaller_ratio(name: str) -> None:
    item = _bound(name)
    values = sorted((0.5, 1.0, 1.999, 2.0, 2.001, 4.0), reverse=metric_of(name).larger)
    ratios = [ratio(item, value) for value in values]
    assert ratios == sorted(ratios)
    assert [value <= 1.0 for value in ratios] == [item.holds(value) for value in values]
    assert ratio(item, 2.0) == 1.0
    assert ratio(item, metric_of(name).unknown) == math.inf


@pytest.mark.parametrize("name", ["axes.gain_margin", "axes.delay_margin_ms", "sim.rise_s", "axes.sensitivity"])
def test_a_later_level_never_improves_a_value(name: str) -> None:
    for first, second in ((1.5, 3.0), (3.0, 1.5)):
        item = Candidate("pi", {}, np.zeros(1))
        item.update("linear", Judgement({name: first}))
        item.update("margins", Judgement({name: second}))
        worse = 1.5 if metric_of(name).larger else 3.0
        assert item.metrics[name] == worse
        assert item.level == "margins"
    item.update("all", Judgement({name: 9.0}, "it failed"))
    assert (item.level, item.error, item.metrics[name]) == ("margins", "it failed", worse)


def test_of_two_limits_on_one_metric_the_worse_ratio_counts_and_the_largest_decides() -> None:
    item = Candidate("pi", {}, np.zeros(1))
    item.update("all", Judgement({"sim.rise_s": 1.0, "sim.max_rad": 1.0, "axes.sensitivity": 1.0}))
    tight, loose = _bound("sim.rise_s", 0.5), _bound("sim.rise_s", 4.0)
    for bounds in ([tight, loose], [loose, tight]):
        assert item.ratios(bounds, tested=False) == {"sim.rise_s": 2.0}
        assert not item.holds(bounds, tested=False)
    good, poor = _bound("sim.rise_s", 2.0), _bound("sim.max_rad", 0.9)
    assert item.holds([good], tested=False)
    assert not item.holds([good, poor], tested=False)
    assert not item.holds([], tested=False)
    assert item.cost([], tested=False) == math.inf
    assert item.cost([good, poor], tested=False) > 1.0 > item.cost([good], tested=False)
    # More requirements that fail, or that fail by more, never cost less.
    worse = _bound("sim.max_rad", 0.5)
    assert item.cost([good, worse], tested=False) > item.cost([good, poor], tested=False)
    item.error = "it cannot be built"
    assert item.cost([good], tested=False) == math.inf
    assert not item.holds([good], tested=False)


def test_the_front_keeps_what_none_beats_margins_upwards() -> None:
    def candidate(rise: float, margin: float) -> Candidate:
        item = Candidate("pi", {}, np.zeros(1))
        item.update("all", Judgement({"sim.rise_s": rise, "axes.gain_margin": margin}))
        return item

    points = ((1.0, 2.0), (2.0, 3.0), (2.0, 2.0), (0.5, 1.5), (0.4, math.nan))
    items = [candidate(*point) for point in points]
    found = front(items, ["sim.rise_s", "axes.gain_margin"])
    assert [item.metrics["sim.rise_s"] for item in found] == [0.5, 1.0, 2.0]
    assert found[-1].metrics["axes.gain_margin"] == 3.0
    assert is_worse("axes.gain_margin", 2.0, 3.0)


@pytest.mark.parametrize(
    ("drawn", "stated", "asked", "told"),
    [(("d",), (), [0.0], True), (("d",), ("sim.payloads_kg",), [0.0], False), (("d",), (), [1.0], False),
     (("d",), (), [0.0, 1.0], False), (("d",), (), [1.0, 0.0], False), ((), (), [0.0], False)],
)  # fmt: skip
def test_a_default_payload_that_was_not_recorded_is_told(
    drawn: tuple[str, ...], stated: tuple[str, ...], asked: list[float], told: bool
) -> None:
    task = _task(sim={"payloads_kg": asked}, own={}, robot=Robot.preset())
    task.drawn, task.asked.track, task.asked.stated = drawn, {"delay_ms": 0.0}, frozenset(stated)
    found = told_conditions(task, [], TS)
    assert list(found) == ["payload 1 kg"] * told
    assert all(text.startswith("judged with at most 0 kg") and "--payload 1`" in text for text in found.values())


# -- the loops of a candidate -----------------------------------------------------------------------------------------


def task_for(table: dict[str, Any], robot: str | Robot = "neck", time: float = 1.0, **more: Any) -> Any:
    asked = make_tune_requirements(
        table, scale=Scale(robot=robot if isinstance(robot, Robot) else Robot.preset(robot), time=time)
    )
    return SimpleNamespace(
        **{"asked": asked, "robot": asked.certificate.robot, "cocontraction": None, "seed": 3, "own": {}, "linear": {},
           "drawn": (), "hardest": {}, "models": [], "observer": None, **more}
    )  # fmt: skip


CONDITIONS = {"sim": {"payloads_kg": [0.5, 0.0], "orientations_deg": [0.0, 45.0, 90.0]}, "track": {"small_part": 0.3}}


@pytest.mark.parametrize("robot", ["neck", "finger"])
def test_every_plant_payload_direction_and_size_is_a_loop_and_a_circle_where_there_are_two_angles(robot: str) -> None:
    task = task_for(CONDITIONS, robot)
    own: list[Any] = [
        SimpleNamespace(name="a", payloads=lambda kg: kg), SimpleNamespace(name="b", payloads=lambda _: [1.0])
    ]  # fmt: skip
    found = cases(own, task.asked, task.robot)
    angles = [0.0, math.pi / 4, math.pi / 2] if robot == "neck" else [0.0]
    expected = set()
    for plant, kg in ((0, 0.0), (0, 0.5), (1, 1.0)):
        expected |= {Case(plant, kg, angle, noise=noisy) for angle in angles for noisy in (False, True)}
        expected |= {Case(plant, kg, angle, part=0.3, noise=True) for angle in (angles[0], angles[-1])}
        expected |= {Case(plant, kg, 0.0, 1.0, noise=True, late=True, circle=False)}
        expected |= {Case(plant, kg, 0.0, 1.0, noise=False, late=False, circle=True)} if robot == "neck" else set()
    assert set(found) == expected
    assert len(found) == len(expected)
    # Of a draw the full-size steps are others' but for one, which the curves show.
    drawn = cases(own, task.asked, task.robot, ("b",))
    assert {case for case in expected if case.plant == 0} <= set(drawn) < expected
    steps = [case for case in drawn if case.plant == 1 and case.part == 1.0 and not (case.late or case.circle)]
    assert steps == [Case(1, 1.0, 0.0)]


def _port(name: str, start: float = 0.0) -> Any:
    return SimpleNamespace(name=name, start=start)


@pytest.mark.parametrize("pulls", [0.0, 0.6, None])
@pytest.mark.parametrize("common", [None, 0.0, 0.4])
@pytest.mark.parametrize("time", [1.0, 2.5])
def test_the_cocontraction_that_is_asked_is_judged_unless_the_controller_pulls_by_its_own(
    pulls: float | None, common: float | None, time: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked, judged, told: all loops are held at the recordings' co-contraction, from three seconds before the step.

    All times are those of the neck times the robot's.
    """
    monkeypatch.setattr(_judge, "step_loop", lambda *args, **more: (args, more))
    task = task_for(CONDITIONS, time=time, cocontraction=common)
    own = [] if pulls is None else [_port("least_cocontraction", pulls)]
    block: Any = SimpleNamespace(parameters=[_port("other"), *own], sample_time=TS)
    plant: Any = SimpleNamespace(quiet=lambda ts: ("quiet", ts))
    args, more = loop_of(Case(0, 0.5, math.pi / 2, part=0.3), plant, block, "parallel", task)  # pyright: ignore[reportGeneralTypeIssues]
    reference = args[4]
    together = 0.0 if pulls is not None else common or 0.0
    at = time * (3.0 if pulls or together else 0.5)
    assert reference(at + 0.1) == pytest.approx((0.0, 0.3 * math.radians(15.0), together), abs=1e-12)
    assert reference(at - 0.01) == (0.0, 0.0, together)
    assert (args[1], args[3], more["duration"], more["order"]) == (
        ("quiet", TS), 0.5, pytest.approx(at + 5.0 * time), "parallel",
    )  # fmt: skip
    assert more["faults"] == []


def test_noise_delay_and_circle_of_a_loop_are_those_that_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_judge, "step_loop", lambda *args, **more: SimpleNamespace(reference=args[4], **more))
    block: Any = SimpleNamespace(parameters=[], sample_time=TS)
    plant: Any = SimpleNamespace(quiet=lambda ts: ts)
    track = {"noise_deg": 0.2, "delay_ms": 47.0, "circle_rad_s": 2.0, "circle_deg": 12.0}

    def loop(case: Case, **changes: Any) -> Any:
        return loop_of(case, plant, block, "sequential", task_for({"track": {**track, **changes}}))

    [noise] = loop(Case(2, 0.0, math.radians(45.0), noise=True)).faults
    assert (noise.kind, noise.std, noise.seed) == ("noise", pytest.approx(math.radians(0.2)), 3 + 2000 + 45)
    noise, delay = loop(Case(0, 0.0, noise=True, late=True)).faults
    assert (delay.kind, delay.delay) == ("delay", pytest.approx(2 * TS))
    assert loop(Case(0, 0.0, noise=True, late=True), noise_deg=0.0, delay_ms=0.0).faults == []
    circle = loop(Case(0, 0.0, circle=True))
    # Half a second to begin, two to reach it, two turns of pi seconds.
    assert circle.duration == pytest.approx(2.5 + 2.0 * math.pi)
    slow = loop_of(Case(0, 0.0, circle=True), plant, block, "sequential", task_for({"track": track}, time=3.0))
    assert slow.duration == pytest.approx(3.0 * 2.5 + 2.0 * math.pi)
    angles = np.array([circle.reference(t)[:2] for t in 2.5 + np.linspace(0.0, math.pi, 9)])
    np.testing.assert_allclose(np.hypot(*angles.T), math.radians(12.0), rtol=0.05)
    turned = np.unwrap(np.arctan2(angles[:, 1], angles[:, 0]))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2.0 * math.pi, rel=0.02)


def _circle(lag: int, rows: int = 700, offset: float = 0.0) -> LoopResult:
    """Return a circle of 2 rad/s at 0.2 rad whose outputs come `lag` samples late."""
    t = np.arange(rows) * TS
    r = {"pitch": 0.2 * np.cos(2.0 * t), "roll": 0.2 * np.sin(2.0 * t)}
    late = {"pitch": 0.2 * np.cos(2.0 * (t - lag * TS)) + offset, "roll": 0.2 * np.sin(2.0 * (t - lag * TS))}
    signals = late | {f"{name}_reference": values for name, values in r.items()}
    return LoopResult(t, signals | {f"motor_setpoint_{j}": np.full(rows, 0.1 * j) for j in (1, 2, 3)}, {}, TS)


@pytest.mark.parametrize("lag", [0, 3, 40])
def test_the_distance_to_a_circle_is_least_at_the_lead_that_its_lag_asks_for(
    lag: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, loop = task_for({"track": {"circle_rad_s": 2.0}}), SimpleNamespace(controller=SimpleNamespace(sample_time=TS))
    circle = _circle(lag, offset=0.05)
    for name in ("pitch", "roll"):
        circle.signals[name][: -round(math.pi / TS)] = 9.0  # what was before the last turn does not count
    monkeypatch.setattr(_judge, "run_loop", lambda _, compiled: circle if compiled else None)
    found = _judge._distances(loop, task)  # pyright: ignore[reportArgumentType]
    # 0.8 s of leads, each a sample.
    assert found.shape == (41,)
    leads = np.arange(41)
    # Beside its centre too; 157 samples are a turn to 0.05 %, by which the middle of the cosine is off.
    expected = np.degrees(np.hypot(0.4 * np.sin((leads - lag) * TS), 0.05))
    np.testing.assert_allclose(found, expected, rtol=1e-3)

    slow = task_for({"track": {"circle_rad_s": 2.0}}, time=3.0)
    assert _judge._distances(loop, slow).shape == (121,)  # pyright: ignore[reportArgumentType]

    def overflow(*_: Any, **__: Any) -> LoopResult:
        raise DataError("overflow")

    monkeypatch.setattr(_judge, "run_loop", overflow)
    assert list(_judge._distances(loop, task)) == [math.inf] * 41  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("middle", [0.0, 0.3])
def test_the_radius_of_a_circle_is_that_of_its_last_turn_at_the_angles_of_the_page(middle: float) -> None:
    """Around where the robot is operated."""
    neck = Robot.preset()
    range_of = {"min": (middle - 0.2,) * 2, "max": (middle + 0.2,) * 2, "rest": (middle,) * 2}
    task = task_for({"track": {"circle_rad_s": 2.0}}, robot=replace(neck, outputs=replace(neck.outputs, **range_of)))
    circle = _circle(5, offset=0.05)
    for name in ("pitch", "roll"):
        circle.signals[name][:] += middle
    turn = round(math.pi / circle.sample_time)
    for name in ("pitch", "roll"):
        circle.signals[name][:-turn] = 9.0  # what was before it does not count
    found = _judge._radius(circle, task)
    angles = circle_angles()
    # A circle around (0.05, 0), seen from the origin.
    expected = 0.05 * np.cos(angles) + np.sqrt(0.04 - (0.05 * np.sin(angles)) ** 2)
    np.testing.assert_allclose(found, np.degrees(expected), rtol=2e-3)


@pytest.mark.parametrize("linear", [{"f": 1}, {"f": 1, "m": 2}])
def test_a_design_is_for_the_one_linear_plant_or_for_all_in_their_order(linear: dict[str, int]) -> None:
    asked = make_tune_requirements({})
    task = Task(digest="", linear=linear, own={}, asked=asked, robot=Robot.preset(), seed=0)
    assert task.plant == (1 if len(linear) == 1 else [1, 2])


def test_curves_are_of_the_plain_steps_from_the_lowest_to_the_highest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps without noise, of full size, along the first output; the last plant's own curve and set-points."""
    task = task_for({"track": {"circle_rad_s": 2.0}}, own={"a": None})
    plants = [0, 1, 2]
    every = [
        Case(k, 0.0, angle, noise=noisy) for k in plants for angle in (math.pi / 2, 0.0) for noisy in (True, False)
    ]
    every += [Case(2, 0.0, part=0.3), Case(2, 0.0, late=True)]
    run: list[Case] = []
    bent = 0.07  # [rad] where it stands before

    def result(loop: Any, *, compiled: bool) -> LoopResult:
        assert compiled
        run.append(loop.case)
        loop = loop.case
        if loop.circle:
            return _circle(2 + loop.plant)
        t = np.arange(300) * TS
        begin = (30, 40, 25)[loop.plant]
        on = (t >= begin * TS - 1e-9).astype(float)
        size = (0.3, 0.1, 0.2)[loop.plant]
        signals = {"pitch": bent + size * on, "roll": 9.0 * on, "pitch_reference": bent + 0.2 * on,
                   "roll_reference": 0.0 * on}  # fmt: skip
        share = (5.0, 3.0, 1.0)[loop.plant]
        moved = {f"motor_setpoint_{j}": share * j * (1.0 + np.arange(300) - begin) * on for j in (1, 2, 3)}
        return LoopResult(t, signals | moved, {}, TS)

    still = RobotReference(kind="step", values=(0.2, 0.0), at=0.5)
    monkeypatch.setattr(_judge, "loop_of", lambda case, *_: SimpleNamespace(case=case, reference=still))
    monkeypatch.setattr(_judge, "run_loop", result)

    def curves(cases: list[Case]) -> dict[str, list[float]]:
        ready: Any = SimpleNamespace(all=cases, own=plants, weights=[None])
        return _judge.loop_curves(task, ready, None, "sequential")  # pyright: ignore[reportArgumentType]

    found = curves(every)
    assert run == [Case(k, 0.0) for k in plants]
    assert (found["low"][-1], found["high"][-1], found["value"][-1]) == pytest.approx(
        (math.degrees(0.1), math.degrees(0.3), math.degrees(0.2)), rel=1e-3
    )
    assert found["low"][0] == pytest.approx(math.degrees(0.1), rel=1e-3)
    assert found["reference"] == [pytest.approx(math.degrees(0.2), rel=1e-3)]
    # Of the sample before each time, counted from the step on; the last for all that is later.
    held = [1.0 + min(int(time / TS + 1e-6), 300 - 26) for time in curve_times(task)]
    assert [found[f"set_point_{j}"] for j in (1, 2, 3)] == [[j * value for value in held] for j in (1, 2, 3)]
    assert found["tautness"] == [2.0 * value for value in held]
    assert "circle" not in found
    circled = curves([*every, Case(0, 0.0, circle=True), Case(1, 0.0, circle=True)])
    assert circled["circle"] == pytest.approx([math.degrees(0.2)] * circle_angles().size, rel=1e-3)
    assert circled["circle_low"] == pytest.approx(circled["circle_high"], rel=1e-3)

    def overflow(*_: Any, **__: Any) -> LoopResult:
        raise DataError("overflow")

    monkeypatch.setattr(_judge, "run_loop", overflow)
    assert curves(every) == {}
    # One number that is none leaves no curve at all.
    assert _judge._finite_curves({"a": np.array([1.0, math.nan])}) == {}
    assert _judge._finite_curves({"a": np.array([1.0]), "b": np.array([math.nan])}) == {}
    assert _judge._finite_curves({"a": np.array([math.inf])}) == {}
    assert _judge._finite_curves({"a": np.array([1.23456])}) == {"a": [1.235]}


def test_linear_curves_are_of_the_first_output_with_the_nominal_plant_last(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(400) * TS
    y = np.zeros((2, 3, 400))
    y[0] = np.array([0.2, 0.1, 0.3])[:, None] * np.ones(400)
    y[:, :, 200:] = 7.0  # under the load
    P = np.zeros((2, 3, 400, 3))
    P[0, 0] = (1.0 + np.arange(400))[:, None] * [1.0, 2.0, 3.0]
    tests: list[Any] = []

    def run(plants: Any, block: Any, test: Any, **more: Any) -> Any:
        tests.append(test)
        assert (plants, block) == (("later", 1), "block")
        assert more == {"robot": task.robot, "weights": [None]}
        return SimpleNamespace(time=t, angles=y, motors=P)

    def alone(controller: Any, **more: Any) -> Any:
        assert (controller, more) == ("c", ALONE)
        return SimpleNamespace(extra=1, block="block")

    plants: Any = SimpleNamespace(later=lambda extra: ("later", extra))
    monkeypatch.setattr(_judge, "run_steps", run)
    monkeypatch.setattr(_judge, "controller_under_test", alone)
    task = task_for({"step": {"duration_s": 4.0}})
    found = _judge.linear_curves(task, SimpleNamespace(plants=plants, weights=[None]), "c")  # pyright: ignore[reportArgumentType]
    assert (tests[0].noise, tests[0].load) == (0.0, 0.0)
    ends = [found[name][-1] for name in ("low", "high", "value")]
    assert ends == pytest.approx([math.degrees(v) for v in (0.1, 0.3, 0.2)], rel=1e-3)
    held = [1.0 + min(int(time / TS + 1e-6), 199) for time in curve_times(task)]
    assert [found[f"set_point_{j}"] for j in (1, 2, 3)] == [[j * value for value in held] for j in (1, 2, 3)]
    assert found["reference"] == [15.0]


@pytest.mark.parametrize(("own", "duration"), [({"p": 1}, 7.0), ({}, 4.0)])
def test_curves_last_as_long_as_the_steps_that_they_are_of_and_are_denser_at_the_start(
    own: dict[str, Any], duration: float
) -> None:
    times = curve_times(task_for({"sim": {"duration_s": 7.0}, "step": {"duration_s": 4.0}}, own=own))
    assert (times[0], times[-1]) == (0.0, duration)
    assert (np.diff(times, 2) > 0.0).all()
    # A circle is looked at all the way round.
    np.testing.assert_allclose(np.diff(circle_angles()), math.tau / 48)
    assert circle_angles()[0] == -math.pi


@pytest.mark.parametrize("drawn", [(), ("f, draw 1",)])
@pytest.mark.parametrize("measured", [[], [False], [True], [False, True], [True, False], [True, True]])
def test_one_family_that_was_tested_against_its_recordings_is_enough(
    drawn: tuple[str, ...], measured: list[bool]
) -> None:
    linear: dict[str, Any] = {
        str(k): SimpleNamespace(measured={"pitch": 1} if one else {}) for k, one in enumerate(measured)
    }
    task: Any = SimpleNamespace(drawn=drawn, linear={"model": object(), **linear})
    assert Task.tested.fget(task) is (any(measured) and not drawn)  # pyright: ignore[reportOptionalCall]


def test_the_hardest_draws_overshoot_most_or_rise_last_and_one_that_fails_is_hard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = {"sim.overshoot_pct": np.arange(12.0) % 7, "sim.rise_s": np.r_[np.nan, np.inf, np.arange(10.0)]}
    monkeypatch.setattr(_judge, "prepare", lambda _: None)
    monkeypatch.setattr(_judge, "design_candidate", lambda *_: SimpleNamespace(block=lambda: "block", order="jacobi"))
    monkeypatch.setattr(_judge, "run_steps_on_draws", lambda *_, **__: values)
    draws = SimpleNamespace(for_search=lambda: range(12))
    task = task_for({}, linear={"f": SimpleNamespace(draws=draws), "m": SimpleNamespace()})
    # 6 and 5, twice 4 or 11; no number, infinity, then the two that rise last.
    assert _judge.hardest_draws(task, "pi", {}) == {"f": (0, 1, 4, 5, 6, 10, 11)}


@pytest.mark.parametrize(("lost", "margin"), [(0.0, 2.2), (0.5, 2.2 / 1.5), (1.0, 1.1)])
def test_of_the_hardest_draws_the_worst_counts_and_each_that_oscillates_lowers_the_margin(
    lost: float, margin: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    steps = {"f": np.array([1.0, 3.0]), "g": np.array([2.0])}
    monkeypatch.setattr(_judge, "run_steps_on_draws", lambda name, *_, **__: {"sim.rise_s": steps[name]})
    monkeypatch.setattr(_judge, "oscillating_share", lambda name, *_, **more: told.append((name, more)) or lost)
    linear = {name: SimpleNamespace(draws=name) for name in "fg"}
    aims = (Requirement("axes.gain_margin", "min", 2.2, False), Requirement("sim.rise_s", "max", 2.2, False))
    task = task_for({}, linear=linear, aims=aims, hardest={"f": (1, 2), "g": (0,)})
    found = _judge.drawn_metrics(task, "block", "jacobi", None)  # pyright: ignore[reportArgumentType]
    assert found == {"sim.rise_s": 3.0, "axes.gain_margin": margin}
    where = {"order": "jacobi", "observer": None, "gain": 2.2}
    assert told == [("f", {**where, "numbers": (1, 2)}), ("g", {**where, "numbers": (0,)})]


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("own", [True, False])
def test_each_level_computes_its_own_and_an_error_of_a_design_is_told(
    level: str, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready: Any = SimpleNamespace(own=[1] * own, all=("case",))
    controller = SimpleNamespace(block=lambda: "block", order="parallel")
    monkeypatch.setattr(_judge, "prepare", lambda _: ready)
    monkeypatch.setattr(_judge, "design_candidate", lambda *_: controller)
    monkeypatch.setattr(_judge, "make_observer", lambda *_: "eyes")
    for name in (
        "linear_metrics", "loop_metrics", "margin_metrics", "drawn_metrics", "linear_curves", "loop_curves"
    ):  # fmt: skip
        monkeypatch.setattr(_judge, name, lambda *args, name=name: {name: args[2:]})
    found = judge_candidate(task_for({}), "pi", {}, level)
    if level == "linear":
        assert found.metrics == {"linear_metrics": (controller,)}
        assert bool(found.curves) is not own
    elif level == "margins":
        assert found.metrics == {"margin_metrics": ("block", "parallel", "eyes")}
    else:
        assert found.metrics == {"loop_metrics": ("block", "parallel", ("case",), "eyes")}
        assert found.curves == {"loop_curves": ("block", "parallel", "eyes")}
    assert not found.error
    if level == "all":
        led = judge_candidate(task_for({}, hardest={"family": (3,)}), "pi", {}, level)
        assert led.metrics == {
            "loop_metrics": ("block", "parallel", ("case",), "eyes"), "linear_metrics": (controller,),
            "drawn_metrics": ("parallel", "eyes"),
        }  # fmt: skip

    def fails(*_: Any) -> Any:
        raise SettingsError("no\n  way")

    monkeypatch.setattr(_judge, "design_candidate", fails)
    found = judge_candidate(task_for({}), "pi", {}, level)
    assert (dict(found.metrics), found.error, dict(found.curves)) == ({}, "no way", {})


def test_each_kind_is_designed_on_its_plant() -> None:
    light, heavy = SimpleNamespace(arrays={}), SimpleNamespace(arrays={"payload": np.array([0.0, 1.0, -3.0, -0.2])})
    task = task_for({}, models=[light, heavy], linear={"a": "first", "b": "second"}, plant="plant")
    ready: Any = SimpleNamespace(uncertain="uncertain")

    def plant_of(kind: str, task: Any = task) -> Any:
        return _judge._plant_for(task, ready, kind, resolve(KINDS[kind].settings)())

    assert (plant_of("pi"), plant_of("adaptive"), plant_of("mpc")) == ("uncertain", "first", "plant")
    assert plant_of("nmpc") is heavy
    assert plant_of("nmpc", task_for({}, plant="plant")) == "plant"


# -- the course of a search -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", ["min", "max", "below"])
def test_a_ratio_is_one_at_the_limit_and_above_it_beyond(bound: str) -> None:
    item, sign = Requirement("m", bound, 2.0, True), -1.0 if bound == "min" else 1.0
    assert ratio(item, 2.0 - 0.1 * sign) < 1.0 < ratio(item, 2.0 + 0.1 * sign)
    assert (ratio(item, 2.0) <= 1.0) is (bound != "below")
    for value in (0.5, 3.0):
        assert ratio(item, value) == (2.0 / value if bound == "min" else value / 2.0)
    zero = Requirement("m", bound, 0.0, True)
    if bound != "min":
        assert ratio(zero, 0.1) == math.inf
        assert ratio(zero, -0.1) == 0.0
        assert ratio(zero, 0.0) == (0.0 if bound == "max" else math.inf)
    else:
        assert ratio(item, 0.0) == ratio(item, -1.0) == math.inf


def test_a_candidate_exactly_at_its_limits_holds_and_ties_are_broken_by_the_mean() -> None:
    bounds = (Requirement("sim.rise_s", "max", 0.4, True), Requirement("sim.overshoot_pct", "max", 5.0, True))

    def of(**metrics: float) -> Candidate:
        named = {name.replace("__", "."): value for name, value in metrics.items()}
        return Candidate("pi", {}, np.zeros(1), "all", {"axes.sensitivity": 1.2} | named)

    edge = of(sim__rise_s=0.4, sim__overshoot_pct=5.0)
    assert edge.holds(bounds, tested=False)
    assert edge.cost(bounds, tested=False) == pytest.approx(1.0, rel=1e-12)
    half = of(sim__rise_s=0.4, sim__overshoot_pct=2.5)
    # The largest ratio counts by 0.98, their mean by 0.02.
    assert half.cost(bounds, tested=False) == pytest.approx(0.98 + 0.02 * 0.75, rel=1e-12)
    far = of(sim__rise_s=math.inf, sim__overshoot_pct=5.0)
    assert far.cost(bounds, tested=False) == pytest.approx(1.0 + 4.0 + 0.02, rel=1e-12)
    twice = of(sim__rise_s=0.8, sim__overshoot_pct=5.0)
    assert twice.cost(bounds, tested=False) == pytest.approx(1.0 + 1.0 / 1.25 + 0.02, rel=1e-12)
    broken = Candidate("pi", {}, np.zeros(1), "all", dict(edge.metrics), error="no plant")
    assert not broken.holds(bounds, tested=False)
    assert broken.cost(bounds, tested=False) == math.inf
    assert not of().holds((), tested=False)


def test_curves_stay_until_a_later_level_has_some_and_an_error_changes_nothing_else() -> None:
    item = Candidate("pi", {}, np.zeros(1))
    item.update("linear", Judgement({"sim.rise_s": 1.0}, curves={"low": [1.0]}))
    item.update("all", Judgement({"sim.rise_s": 2.0, "track.ahead_s": 3.0}))
    assert (item.level, item.curves) == ("all", {"low": [1.0]})
    assert item.metrics == {"sim.rise_s": 2.0, "track.ahead_s": 3.0}
    item.update("margins", Judgement({"sim.rise_s": 9.0}, "it broke", curves={"low": [9.0]}))
    assert (item.level, item.error, item.curves, item.metrics["sim.rise_s"]) == ("all", "it broke", {"low": [1.0]}, 2.0)


def searching(kinds: str = "abcdefg", budget: int = 20, **more: Any) -> Search:
    spaces: Any = [SimpleNamespace(kind=kind) for kind in kinds]
    bounds = (Requirement("m", "max", 1.0, True),)
    asked = SimpleNamespace(bounds=bounds, stated=frozenset())
    task: Any = SimpleNamespace(
        bounds=bounds, aims=bounds, final_aims=bounds, tested=False, seed=0, **{"drawn": (), "asked": asked, **more}
    )
    return Search(task, spaces, None, None, budget, lambda *_: None)  # pyright: ignore[reportArgumentType]


def of_kind(kind: str, value: float, level: str = "all", number: int = 0) -> Candidate:
    return Candidate(kind, {}, np.array([float(number)]), level, {"m": value, "axes.sensitivity": 1.0})


@pytest.mark.parametrize(("count", "kept"), [(1, 1), (2, 2), (3, 2), (6, 2), (7, 3)])
def test_a_third_of_the_kinds_goes_on_and_never_fewer_than_two(count: int, kept: int) -> None:
    search = searching("abcdefg"[:count])
    for k, kind in enumerate("gfedcba"):
        search.candidates[kind, "1"] = of_kind(kind, 0.1 * (k + 1))
        search.candidates[kind, "2"] = of_kind(kind, 5.0)
    best = [space.kind for space in search._drop_kinds(search.spaces)]
    assert best == sorted("abcdefg"[:count], key="gfedcba".index)[:kept][::-1]


def test_a_costly_kind_goes_on_only_as_the_best() -> None:
    costly = next(iter(COSTLY))
    for value, kept in ((0.1, [costly, "a"]), (0.3, ["a", "b"])):
        search = searching("ab")
        search.spaces.insert(0, SimpleNamespace(kind=costly))  # pyright: ignore[reportArgumentType]
        for kind, m in (("a", 0.2), ("b", 0.5), (costly, value)):
            search.candidates[kind, ""] = of_kind(kind, m)
        assert [space.kind for space in search._drop_kinds(search.spaces)] == kept
        # Of two kinds none is dropped.
        assert len(search._drop_kinds(search.spaces[:2])) == 2


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        ([0.5, 0.6, 0.7, 2.0], 3),
        ([2.0, 3.0, 4.0, 5.0], 2),
        ([2.0, 3.0, 4.0], 2),
        ([0.5, 2.0, 3.0, 4.0, 5.0], 3),
        ([1.0, 1.0, 1.0, 1.0, 2.0], 4),
        ([], 0),
    ],
)
def test_what_holds_goes_on_and_at_least_the_better_half(values: list[float], kept: int) -> None:
    search = searching()
    items = [of_kind("a", value, number=k) for k, value in enumerate(values)]
    others = [of_kind("a", 0.1, level="linear"), Candidate("a", {}, np.zeros(1), "all", {"m": 0.1}, error="x")]
    found = search._select([*others, *items[::-1], *items], "all")
    assert {id(item) for item in found} == {id(item) for item in items[:kept]}
    assert len(found) == kept


def test_what_is_left_of_a_level_is_judged_at_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    search, said = searching("a"), list[Any]()
    monkeypatch.setattr(Search, "_judge", lambda _, items, level, finals: said.append((level, list(items), finals)))
    monkeypatch.setattr(Search, "_select", lambda _, items, __: items[1:])
    search._judge_levels([1, 2, 3], LEVELS, 5)  # pyright: ignore[reportArgumentType]
    assert said == [("linear", [1, 2, 3], 5), ("all", [2, 3], 5), ("margins", [3], 5)]


@pytest.mark.parametrize("left", [0, 1, 2, 9])
def test_nothing_is_judged_twice_nor_after_an_error_nor_beyond_the_budget(
    left: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the six one has an error, one was judged at this level, one twice and one in an earlier process."""
    found: dict[Job, Judgement] = {}
    search, run = searching("a", budget=left + 4), list[str]()
    writes: list[int] = []
    search.log = SimpleNamespace(found=found, write=lambda: writes.append(len(found)))  # pyright: ignore[reportAttributeAccessIssue]
    items = {name: Candidate("a", {"k": name}, np.zeros(1)) for name in "abcdef"}
    items["b"].error, items["c"].level = "no design", "all"
    jobs = {name: Job.of("a", item.settings, "all") for name, item in items.items()}
    search.spent = {jobs["e"]}
    found[jobs["f"]] = Judgement({"m": 0.7})

    def judge(wanted: Any, call: Any, took: Any, started: Any) -> None:
        for job in wanted:
            run.append(json.loads(job.settings)["k"])
            took(job, Judgement({"m": 0.5}))

    monkeypatch.setattr(_search, "run_jobs", judge)
    search._judge([items[name] for name in "abcaefd"], "all", 3)
    # What a log tells is not run, but it is counted; the rest is kept for later.
    assert run == [name for name in "afd"[:left] if name != "f"]
    assert writes == [2 + k for k in range(len(run))]  # each is on the disk as soon as it is known
    assert search.spent == {jobs["e"], *(jobs[name] for name in "afd"[:left])}
    assert {name for name, item in items.items() if item.metrics} == set("afd"[:left])
    assert all(items[name].level == "all" for name in "afd"[:left])


def test_a_search_goes_on_from_the_moved_start_of_a_kind_and_from_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching("abc")
    for space in search.spaces:
        space.start = np.array([0.5, 0.4])  # pyright: ignore[reportAttributeAccessIssue]
        space.dimensions = (0, 1)  # pyright: ignore[reportAttributeAccessIssue]
    # Moved along one setting, moved along both, and left; one that cannot be designed is said and dropped.
    moved = {"a": [0.5, 0.3], "b": [0.6, 0.5], "c": [0.5, 0.4]}
    optimisers = {space.kind: _search._optimiser(space, 0, i) for i, space in enumerate(search.spaces)}
    before = dict(optimisers)
    monkeypatch.setattr(Search, "_candidate", lambda _, space, x: Candidate(space.kind, {}, np.array(x)))
    monkeypatch.setattr(Search, "_judge", lambda *_: None)
    monkeypatch.setattr(Search, "_drop_kinds", lambda _, alive: alive)

    def move(_: Search, starts: Any, reserved: int) -> Any:
        assert reserved == 3 + 3
        error = {"b": "no margin"}
        return {kind: Candidate(kind, {}, np.array(moved[kind]), error=error.get(kind, "")) for kind in starts}

    monkeypatch.setattr(Search, "_move_starts", move)
    left = search._judge_starts(LEVELS[:2], 3, optimisers)
    assert ([space.kind for space in left], search.dropped) == (["a", "c"], {"b": "no margin"})
    assert optimisers["c"] is before["c"]
    for number, kind in enumerate("ab"):
        same = _search._optimiser(search.spaces[number], 0, number, np.array(moved[kind]))
        np.testing.assert_array_equal(optimisers[kind].mean, moved[kind])
        np.testing.assert_array_equal(optimisers[kind].ask(), same.ask())


@pytest.mark.parametrize("drawn", [(), ("d",)])
def test_where_draws_decide_a_kind_begins_at_the_better_of_its_limits_and_of_a_detuned_design(
    drawn: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching("ab", drawn=drawn)
    search.spaces = list(spaces(("pi", "mpc"), rise=0.5, cocontraction=None, robot=Robot.preset()))
    moved: list[str] = []
    monkeypatch.setattr(Search, "_move_starts", lambda _, starts, __: moved.extend(starts) or starts)
    monkeypatch.setattr(Search, "_drop_kinds", lambda _, alive: alive)
    monkeypatch.setattr(Search, "_choose_draws", lambda _, starts: moved.append(f"draws of {starts[0].kind}"))
    best = {"pi": 1.3, "mpc": 9.0}

    def judge(_: Any, items: Any, level: str, __: int) -> None:
        for item in items:
            Ms = item.settings["max_sensitivity"]
            item.level, item.metrics = level, {"m": abs(Ms - best[item.kind]), "axes.sensitivity": 1.0}

    monkeypatch.setattr(Search, "_judge", judge)
    optimisers: dict[str, Any] = dict.fromkeys(("pi", "mpc"))
    search._judge_starts(LEVELS[:2], 0, optimisers)
    pi, mpc = search.spaces
    # Margins by linear methods lead where no draws do.
    assert moved == (["draws of pi"] if drawn else ["pi", "mpc"])
    assert optimisers["mpc"] is None
    if not drawn:
        assert optimisers["pi"] is None
        return
    detuned = pi.settings(optimisers["pi"].mean)
    assert detuned["max_sensitivity"] < pi.settings(pi.start)["max_sensitivity"]
    assert detuned["reference_time"][0] == pi.settings(pi.start)["reference_time"][0]
    assert detuned["reference_time"][1] < pi.settings(pi.start)["reference_time"][1]
    # At the end of the ranges nothing is detuned.
    np.testing.assert_array_equal(mpc.detuned(0.0 * mpc.start), 0.0 * mpc.start)


def test_the_hardest_draws_of_the_first_start_that_can_be_designed_lead(monkeypatch: pytest.MonkeyPatch) -> None:
    def hardest(_: Any, kind: str, __: Any) -> dict[str, tuple[int, ...]]:
        if kind == "a":
            raise SettingsError("no way")
        return {kind: (1, 2)}

    monkeypatch.setattr(_search, "hardest_draws", hardest)
    search = searching("abc")
    asked: Any = SimpleNamespace(bounds=())
    search.task = Task(digest="", linear={}, own={}, asked=asked, robot=Robot.preset(), seed=0, drawn=("d",))
    search._choose_draws([of_kind(kind, 0.5) for kind in "abc"])
    assert search.task.hardest == {"b": (1, 2)}
    search._choose_draws([of_kind("a", 0.5)])
    assert search.task.hardest == {"b": (1, 2)}


def test_once_all_requirements_hold_the_aim_alone_counts_and_no_failure_is_bought_with_it() -> None:
    slow = Candidate("a", {}, np.zeros(1), "all", {"m": 0.2, "sim.rise_s": 0.9, "axes.sensitivity": 1.0})
    fast = replace(slow, metrics={**slow.metrics, "m": 0.95, "sim.rise_s": 0.5})
    wrong = replace(slow, metrics={**slow.metrics, "m": 1.01, "sim.rise_s": 0.1})
    bounds = (Requirement("m", "max", 1.0, True), Requirement("sim.rise_s", "max", 1.0, False))
    cost = [item.cost(bounds, tested=False, aim="sim.rise_s") for item in (fast, slow, wrong)]
    assert cost[0] < cost[1] < 1.0 < cost[2]
    # Without one it is the largest ratio.
    assert slow.cost(bounds, tested=False) < fast.cost(bounds, tested=False) < 1.0


def test_of_equal_aims_the_larger_modulus_margin_wins_but_buys_no_aim() -> None:
    bounds = (Requirement("m", "max", 1.0, True), Requirement("sim.rise_s", "max", 1.0, False))

    def cost(rise: float, **sensitivity: float) -> float:
        metrics = {"m": 0.2, "sim.rise_s": rise} | {f"axes.{name}": value for name, value in sensitivity.items()}
        return Candidate("a", {}, np.zeros(1), "all", metrics).cost(bounds, tested=False, aim="sim.rise_s")

    order = [cost(0.5, sensitivity=value) for value in (1.0, 1.65, 2.8, math.inf)]
    assert order == sorted(set(order))
    # An unknown one is the worst, and a number that is none too.
    assert cost(0.5) == cost(0.5, sensitivity=math.nan) == order[-1]
    # A rise of 3 % of its limit more, less than a sample's share of any default, is worth no margin.
    assert cost(0.53, sensitivity=1.0) > order[-1]


def test_of_two_starts_that_are_alike_the_one_at_its_limits_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    search = searching("ab", drawn=("d",))
    search.spaces = list(spaces(("pi", "mpc"), rise=0.5, cocontraction=None, robot=Robot.preset()))

    def judge(_: Any, items: Any, level: str, __: int) -> None:
        for item in items:
            item.level, item.metrics = level, {"m": 0.5, "axes.sensitivity": 1.0}

    monkeypatch.setattr(Search, "_judge", judge)
    starts = {space.kind: search._candidate(space, space.start) for space in search.spaces}
    judge(None, starts.values(), LEVELS[1], 0)
    assert search._judge_detuned(starts, LEVELS[:2], 0) == starts
    for item in starts.values():
        item.metrics = {"m": 0.6, "axes.sensitivity": 1.0}
    # One that was judged less far is not taken for its cost.
    assert search._judge_detuned(starts, LEVELS[:1], 0) == starts
    assert all(found is not starts[kind] for kind, found in search._judge_detuned(starts, LEVELS[:2], 0).items())


@pytest.mark.parametrize("told", ["no margins", "margins that hold", "margins that fail", "no design", "later"])
def test_a_start_follows_its_margins_to_a_larger_bound_and_stays_where_it_has_none(
    told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching("a")
    search.spaces = list(spaces(("pi",), rise=0.5, cocontraction=None, robot=Robot.preset()))
    (space,) = search.spaces
    bound = Requirement("axes.gain_margin", "min", 2.0, True)
    search.task.bounds = (bound,)  # pyright: ignore[reportAttributeAccessIssue]
    search.task.aims = (replace(bound, limit=4.0),)  # pyright: ignore[reportAttributeAccessIssue] - of what is asked
    known = (
        {} if told == "no margins" else {"axes.sensitivity": 1.5, "axes.gain_margin": 3.0 if "hold" in told else 1.5}
    )

    def judge(_: Any, items: Any, level: str, __: int) -> None:
        for item in items:
            if told == "no design" or (told == "later" and item.x[k] < start.x[k] + 1e-9):
                item.error = "too slow"
            else:
                item.level, item.metrics = level, known

    monkeypatch.setattr(Search, "_judge", judge)
    start, k, step = search._candidate(space, space.start), space.trade_off or 0, _search._START_STEP
    judge(None, [start], LEVELS[0], 0)
    moved = search._move_starts({"pi": start}, 0)["pi"]
    if told == "later":  # of what can be designed the smallest bound, as its margins fail
        assert (moved.error, moved.x[k] > start.x[k]) == ("", True)
        assert moved.x[k] == min(item.x[k] for item in search.candidates.values() if item.level)
        return
    if told in ("no margins", "no design"):
        assert moved is start
        # Of what cannot be designed a larger bound is tried, of what has no margins to follow none.
        tried = sorted(item.x[k] for item in search.candidates.values() if item is not start)
        assert tried == ([] if told == "no margins" else pytest.approx(
            np.minimum(start.x[k] + step * np.array([1.0, 1.5, 1.75]), 1.0)))  # fmt: skip
        return
    sign = 1.0 if "hold" in told else -1.0
    assert moved.x[k] == pytest.approx(np.clip(start.x[k] + sign * 1.75 * step, 0.0, 1.0))
    np.testing.assert_array_equal(np.delete(moved.x, k), np.delete(start.x, k))


def test_a_search_is_led_by_what_it_aims_at_and_its_finals_are_of_each_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    closer = (Requirement("m", "max", 0.5, True),)
    search, judged = searching("ab", own={"p": 1}), list[Any]()
    search.task.aims = closer  # pyright: ignore[reportAttributeAccessIssue]
    item = of_kind("a", 0.75)
    assert search.cost(item) == item.cost(closer, tested=False) > 1.0 > item.cost(search.task.bounds, tested=False)
    # One that is judged on all draws is compared by what is kept then.
    item.level = LEVELS[-1]
    assert search.cost(item) == item.cost(search.task.final_aims, tested=False) < 1.0
    # Four of the better kind, and one of another that is left out of none.
    for number, (kind, value) in enumerate([("a", 0.1), ("a", 0.2), ("a", 0.3), ("b", 0.4)]):
        search.candidates[kind, str(number)] = of_kind(kind, value, number=number)
    search.candidates["a", "low"] = of_kind("a", 0.0, "linear")
    monkeypatch.setattr(Search, "_refine", lambda *_: None)
    monkeypatch.setattr(Search, "_judge_finals", judged.append)
    search._finish(2)
    assert [each.metrics["m"] for each in judged[0]] == [0.1, 0.4]
    search._finish(0)
    assert len(judged) == 1


@given(st.lists(st.tuples(*[st.floats(0.1, 0.9)] * 3), min_size=1, max_size=6), st.booleans())
@example([(0.5, 0.1, 0.1), (0.5, 0.1, 0.1)], True)
def test_finals_that_are_left_out_could_not_win(values: list[tuple[float, float, float]], drawn: bool) -> None:
    """The best is the same as if all were judged, and so is its value: more loops only add to a cost."""
    search, judged, name = searching("a", own={"p": 1}, drawn=("d",) * drawn), list[Candidate](), "sim.overshoot_pct"
    search.task.final_aims = (Requirement(name, "max", 1.0, True),)  # pyright: ignore[reportAttributeAccessIssue]
    items = [Candidate("a", {}, np.zeros(1), "all", {name: before, "axes.sensitivity": 1.0}) for before, _, _ in values]
    of_steps = [before + steps * drawn for before, steps, _ in values]
    whole = [known + more for known, (_, _, more) in zip(of_steps, values, strict=True)]
    for number, item in enumerate(items):
        item.settings = {"number": number}

    def steps(_: Any, kind: str, settings: Any) -> Any:
        assert kind == "a"
        assert not judged  # margins cost more
        return {"f": {name: np.array([0.0, of_steps[settings["number"]]])}, "g": {name: np.zeros(2)}}

    def judge(some: list[Candidate], level: str, reserved: int) -> None:
        assert (level, reserved) == ("margins", 0)
        for item in some:
            judged.append(item)
            item.metrics[name] = whole[item.settings["number"]]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search.__class__, "_judge", lambda _, *given: judge(*given))
        patch.setattr(_search, "steps_on_all_draws", steps)
        search._judge_finals(items)
    assert min(item.metrics[name] for item in judged) == min(whole)
    # Each was better than the best so far, and those left out are not.
    begun = [of_steps[item.settings["number"]] for item in judged]
    assert begun == sorted(begun)
    assert all(start < min(whole[one.settings["number"]] for one in judged[:k]) for k, start in enumerate(begun) if k)
    assert all(item.metrics[name] >= min(whole) for item in items if item not in judged)


@pytest.mark.parametrize("tested", [True, False])
@pytest.mark.parametrize("asked", [True, False])
@pytest.mark.parametrize(
    ("value", "ratio"), [(None, math.inf), (4.0, 1.0), (2.0, 1.0), (1.0, 2.0), (math.nan, math.inf)]
)
def test_a_margin_by_experiment_alone_earns_nothing_and_is_none_beside_recordings_or_if_stated(
    value: float | None, ratio: float, tested: bool, asked: bool
) -> None:
    bounds = (Requirement("axes.gain_margin", "min", 2.0, asked), Requirement("sim.rise_s", "max", 1.0, asked))
    metrics = {"sim.rise_s": 0.5} | ({} if value is None else {"axes.gain_margin": value})
    found = Candidate("adaptive", {}, np.zeros(1), "all", metrics).ratios(bounds, tested=tested)
    assert found == {"axes.gain_margin": math.inf if tested or asked else ratio, "sim.rise_s": 0.5}
    # One with a linear form has the ratio of its margin, and one that was not judged none at all.
    seen = Candidate("pi", {}, np.zeros(1), "all", metrics | {"axes.sensitivity": 1.0}).ratios(bounds, tested=tested)
    margins = {} if value is None else {"axes.gain_margin": math.inf if math.isnan(value) else 2.0 / value}
    assert seen == {"sim.rise_s": 0.5, **margins}
    assert Candidate("pi", {}, np.zeros(1)).ratios(bounds, tested=tested) == {}


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("budget", [1, 5, 40])
def test_a_search_judges_starts_generations_neighbours_and_finals_within_its_budget(
    own: bool, budget: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching("ab", budget=budget, own={"p": 1} if own else {})
    said: list[Any] = []

    class Optimiser:
        def ask(self) -> np.ndarray:
            return np.zeros(1)

        def tell(self, given: Any) -> None:
            said.append(("tell", [rank for _, rank in given]))

    monkeypatch.setattr(_search, "_optimiser", lambda *_: Optimiser())

    def judge(self: Search, items: Any, level: str, reserved: int) -> None:
        said.append((level, len(items), reserved))
        for item in items:
            item.level = level
            self.spent.add(Job("a", str(len(self.spent)), level))

    monkeypatch.setattr(Search, "_judge", judge)
    monkeypatch.setattr(Search, "_drop_kinds", lambda _, alive: alive[:1])
    monkeypatch.setattr(
        Search, "_judge_starts", lambda self, levels, finals, _: said.append((levels, finals)) or self.spaces
    )
    monkeypatch.setattr(Search, "_sample", lambda _, space, __: [of_kind(space.kind, 0.5, "", k) for k in range(3)])
    monkeypatch.setattr(Search, "_refine", lambda _, levels, finals: said.append(("refine", levels, finals)))
    monkeypatch.setattr(Search, "_judge_finals", lambda _, items: said.append(("margins", len(items))))
    best = [of_kind("a", 0.1 * k) for k in range(5)] + [of_kind("a", 0.0, "linear")]
    monkeypatch.setattr(Search, "sort_candidates", lambda _: best)
    search.run()
    levels = LEVELS[:-1] if own else LEVELS[:1]
    finals = min(4, max(0, budget - len(levels) * 2)) if own else 0
    assert said[0] == (levels, finals)
    # Three tenths of the budget are left to neighbours.
    rounds = [item for item in said if item[0] == "tell"]
    assert bool(rounds) is (budget - finals - round(0.3 * budget) > 0)
    assert [len(item[1]) for item in rounds] == [3] * len(rounds)
    # Both kinds have a generation in the first round, and the one that is left in each later one.
    judged = [item[1] for item in said if item[0] == levels[0]]
    assert judged == ([6] + [3] * (len(judged) - 1) if rounds else [])
    assert all(item[2] == finals for item in said if item[0] in levels)
    assert ("refine", levels, finals) in said
    # Margins by experiment of the best that were judged as far as any; they may take all that is left.
    assert (said[-1] == ("margins", finals)) is bool(finals)


@pytest.mark.parametrize(
    ("budget", "level", "levels"),
    [(500, "all", LEVELS[:2]), (9, "all", LEVELS[:2]), (500, "linear", LEVELS[:2]), (500, "linear", LEVELS[:1])],
)
def test_neighbours_of_the_best_are_judged_on_both_sides_until_none_is_better(
    budget: int, level: str, levels: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    search, rounds, asked = searching("a", budget=budget), list[tuple[np.ndarray, np.ndarray]](), levels
    best = np.array([0.4, 0.6])
    valley = np.array([0.55, 0.45])

    def judged(x: np.ndarray, level: str) -> Candidate:
        made = Candidate("a", {}, x, level, {"m": 1.0 + float(np.hypot(*(x - valley)))})
        return search.candidates.setdefault(("a", str(x)), made)

    judged(best, level)
    monkeypatch.setattr(Search, "_candidate", lambda _, __, x: x)

    def judge(_: Search, near: Any, levels: Any, finals: int) -> None:
        assert (levels, finals) == (asked, 3)
        rounds.append((search.sort_candidates()[0].x, np.array(near)))
        for x in near:
            judged(x, levels[-1])
            search.spent.add(Job("a", str(len(search.spent)), "all"))

    monkeypatch.setattr(Search, "_judge_levels", judge)
    search._refine(levels, 3)
    if level != levels[-1]:  # the best was not judged to its end
        assert not rounds
        return
    # Four to a round, while more is left than the finals need.
    assert len(rounds) == 2 if budget == 9 else len(rounds) > 5
    away = _search._FIRST_DISTANCE
    for (at, near), (after, _) in zip(rounds, [*rounds[1:], (search.sort_candidates()[0].x, None)], strict=True):
        sides = (near - at).reshape(2, 2, 2)
        np.testing.assert_allclose(sides[:, 0], -sides[:, 1], atol=1e-12)
        np.testing.assert_allclose(sides[:, 0] @ sides[:, 0].T, away**2 * np.eye(2), atol=1e-12)
        away /= 2.0 if after is at else 1.0
    if budget == 500:
        assert away <= _search._LAST_DISTANCE
        # Of directions that turn each round one leads down until a step is no longer than what is left.
        assert np.hypot(*(search.sort_candidates()[0].x - valley)) < _search._FIRST_DISTANCE / 4.0


# -- the end of a search ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [None, math.nan, math.inf, 1.01])
@pytest.mark.parametrize("at", [0, 1])
def test_a_step_over_an_observer_holds_where_every_loop_of_full_size_does(
    lost: float | None, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = [Case(0, 0.0), Case(1, 0.0, noise=True), Case(0, 0.0, part=0.3), Case(0, 0.0, late=True),
             Case(0, 0.0, circle=True)]  # fmt: skip
    task = task_for({})
    ready: Any = SimpleNamespace(all=every, own=[0, 1])
    controller = SimpleNamespace(block=lambda: None, order="parallel")
    run: list[Any] = []

    def judged(loop: Any) -> tuple[dict[str, float], None]:
        run.append(loop)
        value = lost if lost is not None and len(run) - 1 == at else 1.0
        return {"rise_s": value, "slack_s": math.nan}, None

    monkeypatch.setattr(_certify, "prepare", lambda _: ready)
    monkeypatch.setattr(_certify, "design_candidate", lambda *_: controller)
    monkeypatch.setattr(_certify, "loop_of", lambda *args: (*args[:2], args[3], args[5]))
    monkeypatch.setattr(_certify, "judge_loop", judged)
    bounds = (Requirement("sim.rise_s", "max", 1.0, True), Requirement("sim.slack_s", "max", 0.1, False))
    observer = SimpleNamespace(block=lambda: "eyes")
    held = _certify.holds_with_observer(task, Candidate("pi", {}, np.zeros(1)), observer, bounds)
    assert held is (lost is None)
    assert run == [(every[0], 0, "parallel", "eyes"), (every[1], 1, "parallel", "eyes")]
    several = (*bounds, Requirement("sim.rise_s", "max", 0.5, True))
    assert not _certify.holds_with_observer(task, Candidate("pi", {}, np.zeros(1)), observer, several), "not any bound"
    # An observer that makes the steps rise later is left out.
    for rise, quick in ((1.1, True), (1.0, True), (0.99, False)):
        item = Candidate("pi", {}, np.zeros(1), metrics={"sim.rise_s": rise})
        assert _certify.holds_with_observer(task, item, observer, bounds) is quick  # only the first two loops are lost
    ready.all = every[2:]
    assert not _certify.holds_with_observer(task, Candidate("pi", {}, np.zeros(1)), observer, bounds)

    # One that diverges is lost, whichever it is.
    ready.all = every
    for fine in (0, 1):
        told = iter([({"rise_s": 0.5}, None)] * fine)

        def fails(_: Any, told: Any = told) -> Any:
            if found := next(told, None):
                return found
            raise DataError("overflow")

        monkeypatch.setattr(_certify, "judge_loop", fails)
        assert not _certify.holds_with_observer(task, Candidate("pi", {}, np.zeros(1)), observer, bounds)


@pytest.mark.parametrize("holds", [[True], [False, True, True], [False, False, False], [False, False, False, True]])
def test_the_first_whose_certificate_holds_is_taken_and_else_the_best(
    holds: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    items = [of_kind("a", 0.1 * (k + 1), number=k) for k in range(len(holds))] + [of_kind("a", 5.0)]
    tried: list[int] = []

    def verified(task: Any, controller: Any, observed: bool, files: Any, attempt: int) -> Any:
        assert observed is (controller == 0.2)
        tried.append(attempt)
        return SimpleNamespace(holds=holds[attempt - 1], number=attempt - 1)

    monkeypatch.setattr(_certify, "prepare", lambda _: None)
    monkeypatch.setattr(_certify, "design_candidate", lambda *settings: settings[-1]["k"])
    # What is verified is the loop that is delivered: with the observer where its steps hold with it.
    monkeypatch.setattr(_certify, "_observed", lambda _, item: item.settings["k"] == 0.2)
    monkeypatch.setattr(_certify, "_verify_loop", verified)
    items = [replace(item, settings={"k": round(0.1 * (k + 1), 1)}) for k, item in enumerate(items)]
    search = searching()
    most = 2
    monkeypatch.setattr(Search, "sort_candidates", lambda _: items)
    monkeypatch.setattr(_certify, "most_attempts", lambda _: 3)
    found, count = _certify._verify_best(search, 0, None, lambda *_: None)
    verification: Any = found.verification
    first = next((k for k, held in enumerate(holds[:most]) if held), None)
    assert found.item is items[first or 0]
    assert (found.controller, found.observed) == (found.item.settings["k"], found.controller == 0.2)
    assert verification.number == (first or 0)
    # Each attempt at a certificate has a number of its own: its draws are none that another has seen.
    assert tried == list(range(1, (min(len(holds), most) if first is None else first + 1) + 1))
    assert count == len(tried)
    # If none holds in the search, the best alone is verified; draws that another search had are not drawn again.
    tried.clear()
    monkeypatch.setattr(Search, "sort_candidates", lambda _: items[-1:] * 2)
    assert _certify._verify_best(search, 0, None, lambda *_: None)[0].item is items[-1]
    assert tried == [1]
    monkeypatch.setattr(Search, "sort_candidates", lambda _: [items[0]] * 2)
    monkeypatch.setattr(_certify, "_verify_loop", lambda *rest: tried.append(rest[-1]) or SimpleNamespace(holds=False))
    assert _certify._verify_best(search, 2, None, lambda *_: None)[1] == 3
    assert tried == [1, 3]


def test_what_holds_on_all_draws_is_verified_before_what_holds_on_few_and_of_each_kind_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A search keeps away from its limits, so what holds on all draws may cost more than 1.

    Seen on the neck `spring`: two neighbours that four draws liked took all attempts at a certificate.
    """
    search = searching()
    bounds = (Requirement("m", "max", 1.0, False),)
    task: Any = SimpleNamespace(bounds=bounds, tested=False, asked=None)
    search.task = task
    few = [of_kind("b", 0.5, number=1), of_kind("b", 0.6, number=2), of_kind("c", 0.7, number=3)]
    dear, fails = of_kind("a", 0.9, "margins"), of_kind("d", 1.1, "margins")
    ranked = [dear, fails, *few]
    monkeypatch.setattr(Search, "sort_candidates", lambda _: ranked)
    monkeypatch.setattr(Search, "cost", lambda _, item: 2.0 if item.level == "margins" else 0.5)
    monkeypatch.setattr(_certify, "most_attempts", lambda _: 5)
    monkeypatch.setattr(_certify, "relaxations", lambda *_: {})
    tried: list[Candidate] = []

    def certify(_: Any, item: Candidate, *rest: Any) -> Any:
        del rest
        tried.append(item)
        return SimpleNamespace(verification=SimpleNamespace(holds=False))

    monkeypatch.setattr(_certify, "certify", certify)
    _certify._verify_best(search, 0, None, lambda *_: None)
    assert [id(item) for item in tried] == [id(dear), id(few[0])]
    tried.clear()
    ranked[:] = few
    _certify._verify_best(search, 0, None, lambda *_: None)
    assert [id(item) for item in tried] == [id(few[0]), id(few[2])]


class _Resumed(Search):
    """A search that records what it resumes with, and finds one candidate."""

    def resume(self, starts: Any) -> None:
        self.starts = [item.kind for item in starts]
        if self.task.seed == 0:
            self.candidates["b", ""] = Candidate("b", {}, np.zeros(1), "margins", {**FINE, "axes.sensitivity": 1.0})


LIMITS = (Requirement("sim.rise_s", "max", 1.0, False), Requirement("sim.overshoot_pct", "max", 5.0, True),
          Requirement("axes.gain_margin", "min", 2.0, False))  # fmt: skip


def resumable(monkeypatch: pytest.MonkeyPatch, values: dict[str, float], *, found: bool, holds: int) -> Any:
    """Return a search that ended with these values of its best, whose certificates hold from the attempt `holds` on.

    Returns what `certify_search` does, and the attempts.
    """
    # Of a large rise and overshoot one draw is the worst, of a small margin another; each is made anew when asked for.
    part = SimpleNamespace(family="f", attempt=0, worst=lambda _, largest: 2 if largest else 1,
                           model=lambda number: SimpleNamespace(arrays=[number]))  # fmt: skip
    failed = [Verdict(bound, 9.0 if bound.bound == "max" else 1.7, False, {}) for bound in LIMITS]
    asked = SimpleNamespace(bounds=LIMITS, stated=frozenset(["sim.overshoot_pct"]), kept={"axes.gain_margin": 0.2})

    @dataclass(frozen=True)
    class Asked:
        bounds: Any = LIMITS
        stated: Any = asked.stated
        kept: Any = field(default_factory=lambda: asked.kept)

    @dataclass(frozen=True)
    class Plants:
        digest: str = "d"
        own: Any = field(default_factory=lambda: {"p": 1, "draw": 2})
        drawn: Any = ("draw",)
        asked: Any = field(default_factory=Asked)
        linear: Any = field(default_factory=dict)
        seed: int = 0
        tested: bool = False
        bounds: Any = LIMITS
        aims: Any = LIMITS
        final_aims: Any = LIMITS

    search: Any = _Resumed(Plants(seed=not found), searching("ab").spaces, None, None, 40, lambda *_: None)  # pyright: ignore[reportArgumentType]
    best = Candidate("a", {}, np.zeros(1), "margins", {**values, "axes.sensitivity": 1.0, "m": 0.1})
    search.candidates = {
        ("a", "1"): best,
        ("b", "1"): replace(best, kind="b", level="all"),
        ("a", "2"): of_kind("a", 0.3),
    }
    search.spent = {1, 2, 3}
    verified: list[int] = []

    def certify(_: Any, item: Any, __: Any, attempt: int, ___: Any) -> Any:
        verified.append(attempt)
        fine = attempt >= holds
        return _certify.Certified(item, "c", False, SimpleNamespace(  # pyright: ignore[reportArgumentType]
            holds=fine, failed=[] if fine else failed, evidence=SimpleNamespace(drawn=[part])))  # fmt: skip

    monkeypatch.setattr(_certify, "certify", certify)
    made: dict[str, Any] = {}
    monkeypatch.setattr(
        _certify, "prepare", lambda task: made.setdefault(task.digest, SimpleNamespace(kept={task.digest: 1}))
    )
    monkeypatch.setattr(_certify, "_drawn_in_search", lambda *_: [part])
    return search, _certify.certify_search(search, None, lambda *_: None), verified


FINE = {"sim.rise_s": 0.9, "sim.overshoot_pct": 4.0, "axes.gain_margin": 2.5}


@pytest.mark.parametrize(
    ("worse", "joined"),
    [({}, None), ({"sim.rise_s": 1.15}, None), ({"sim.rise_s": 1.16}, [2]), ({"sim.overshoot_pct": 5.1}, [2]),
     ({"sim.rise_s": 1.1, "sim.overshoot_pct": 5.1}, [2]), ({"axes.gain_margin": 1.9}, [1]),
     ({"sim.rise_s": 1.5, "axes.gain_margin": 1.9}, [2, 1])],
)  # fmt: skip
def test_a_search_resumes_with_the_worst_draws_of_what_its_best_fails_but_a_little_speed(
    worse: dict[str, float], joined: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    search, (again, certified, tried), verified = resumable(monkeypatch, FINE | worse, found=True, holds=1)
    # No certificate is tried of what the search's own draws refuse.
    assert (tried, verified, certified.verification.holds) == (1, [1], True)
    if joined is None:
        assert again is search
        return
    assert [model.arrays[0] for model in list(again.task.own.values())[2:]] == joined
    assert again.task.drawn == ("draw", *list(again.task.own)[2:])
    assert again.task.digest != "d"
    # Room is kept for a margin that the plants of the search did not show.
    short = 2.0 - worse.get("axes.gain_margin", 2.0)
    assert again.task.asked.kept == {"axes.gain_margin": pytest.approx(0.2 + short)}
    # The best of each kind comes first, and what was spent is counted.
    assert again.starts == ["a", "b", "a"]
    assert (again.budget, again.earlier, again.spent) == (16, 3, set())


def test_what_no_loop_over_draws_tells_resumes_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_certify, "_failing_draws", lambda *_: {})
    for values, holds in ((FINE | {"sim.overshoot_pct": 5.1}, 1), (FINE, 9)):
        search, (again, certified, tried), verified = resumable(monkeypatch, values, found=True, holds=holds)
        assert again is search
        assert (tried, certified.verification.holds) == (verified[-1], holds == 1)


@pytest.mark.parametrize(
    ("missed", "tried", "resumes"),
    [({}, 1, False), ({0: 1.1}, 1, False), ({0: 1.16}, 1, True), ({1: 5.1}, 1, True), ({0: 1.1, 1: 5.1}, 1, True),
     ({2: 1.9}, 1, True), ({0: 1.16}, 4, True), ({0: 1.16}, 5, False), ({0: None}, 1, True)],
)  # fmt: skip
def test_a_certificate_resumes_a_search_unless_little_speed_alone_fails_or_no_draws_are_left(
    missed: dict[int, float | None], tried: int, resumes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = [Verdict(LIMITS[k], value, False, {}) for k, value in missed.items()]
    asked = SimpleNamespace(bounds=LIMITS, stated=frozenset(), kept={})
    task: Any = SimpleNamespace(digest="d", own={}, drawn=("draw",), asked=asked, bounds=LIMITS, linear={})
    best = Candidate("a", {}, np.zeros(1), "margins", FINE)
    search: Any = SimpleNamespace(task=task, sort_candidates=lambda: [best])
    verification = SimpleNamespace(holds=not failed, failed=failed, evidence=SimpleNamespace(drawn=[]))
    certified: Any = SimpleNamespace(item=best, verification=verification)
    monkeypatch.setattr(_certify, "_verify_best", lambda *_: (certified, tried))
    monkeypatch.setattr(_certify, "_failing_draws", lambda _, failed: {"draw 2": 1} if failed else {})

    def replaced(*_: Any, **__: Any) -> Any:
        raise KeyError("it resumes")

    monkeypatch.setattr(_certify, "replace", replaced)
    if resumes:
        with pytest.raises(KeyError, match="it resumes"):
            _certify.certify_search(search, None, lambda *_: None)
    else:
        assert _certify.certify_search(search, None, lambda *_: None) == (search, certified, tried)
    # A margin that nothing told counts as none; what is kept of other limits stays.
    kept = _certify._more_kept({"axes.gain_margin": 0.2, "sim.overshoot_pct": 1.6},
                            [Verdict(LIMITS[2], None, False, {}), Verdict(LIMITS[1], 9.0, False, {})])  # fmt: skip
    assert kept == {"axes.gain_margin": pytest.approx(2.2), "sim.overshoot_pct": 1.6}
    # What loops of a search say decides only where there are draws among them.
    item = Candidate("a", {}, np.zeros(1), "margins", {"sim.overshoot_pct": 9.0})
    assert [(v.requirement, v.value, v.holds) for v in _certify._failed_in_search(task, item)] == [
        (LIMITS[1], 9.0, False)
    ]
    task.drawn = ()
    assert _certify._failed_in_search(task, item) == []


def test_at_most_three_draws_join_each_once_though_it_is_the_worst_in_several_metrics() -> None:
    def part(family: str, *worst: int | None) -> Any:
        told = dict(zip("abc", worst, strict=True))
        return SimpleNamespace(family=family, attempt=2, worst=lambda metric, **_: told[metric],
                               model=lambda number: [family, number])  # fmt: skip

    failed: Any = [SimpleNamespace(requirement=Requirement(metric, "max", 1.0, False)) for metric in "abc"]
    found = _certify._failing_draws([part("f", 4, 4, None), part("g", 4, 0, 4)], failed)
    assert found == {"f, attempt 2, a": ["f", 4], "g, attempt 2, a": ["g", 4], "g, attempt 2, b": ["g", 0]}
    many = _certify._failing_draws([part("f", 4, 3, 2), part("g", 1, 0, 4)], failed)
    assert list(many.values()) == [["f", 4], ["f", 3], ["f", 2]]
    # Of a margin the smallest is the worst, of all else the largest.
    sides: list[bool] = []
    asked: Any = [SimpleNamespace(requirement=Requirement("a", bound, 1.0, False)) for bound in ("min", "max", "below")]
    one: Any = SimpleNamespace(family="f", attempt=1, worst=lambda _, largest: sides.append(largest))
    assert _certify._failing_draws([one], asked) == {}
    assert sides == [False, True, True]


@pytest.mark.parametrize("found", [True, False])
def test_draws_that_fail_a_certificate_join_the_plants_of_a_search_that_resumes(
    found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    holds = 3 if found else 9
    search, (again, certified, tried), verified = resumable(monkeypatch, FINE, found=found, holds=holds)
    assert verified == list(range(1, tried + 1))
    assert certified.verification.holds is found
    if not found:  # nothing could be designed for them: the first search stands
        assert again is search
        return
    assert [model.arrays[0] for model in list(again.task.own.values())[2:]] == [2, 1]
    assert again.task.asked.kept == {"axes.gain_margin": pytest.approx(0.5)}
    assert (certified.item.kind, tried) == ("b", 3)
    # What the first search designed is not designed again.
    assert _certify.prepare(again.task).kept == {"d": 1, again.task.digest: 1}


@pytest.mark.parametrize("budget", [3, 30])
def test_a_search_that_resumes_judges_its_starts_and_neighbours_within_its_budget(
    budget: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    search, said = searching("ab", budget=budget, own={"p": 1}), []

    def judge(self: Search, items: Any, level: str, reserved: int) -> None:
        said.append((level, sorted({item.kind for item in items}), reserved))
        for item in items:
            item.level, item.metrics = level, {"m": float(item.x[0]), "axes.sensitivity": 1.0}

    monkeypatch.setattr(Search, "_judge", judge)
    made = {kind: of_kind(kind, 9.0) for kind in "ab"}
    monkeypatch.setattr(
        Search, "_candidate", lambda self, space, _: self.candidates.setdefault(space.kind, made[space.kind])
    )
    monkeypatch.setattr(Search, "_refine", lambda _, levels, finals: said.append(("near", list(levels), finals)))
    monkeypatch.setattr(
        Search, "_judge_finals", lambda _, items: said.append(("margins", sorted(item.kind for item in items)))
    )
    search.resume([of_kind("b", 1.0), of_kind("a", 2.0)])
    finals = 0 if budget == 3 else 4
    begun = [(level, ["a", "b"], finals) for level in LEVELS[:-1]] + [("near", list(LEVELS[:-1]), finals)]
    assert said == begun + [("margins", ["a", "b"])] * (finals > 0)


@pytest.mark.parametrize("observer", [None, "given"])
def test_the_draws_of_a_search_are_run_with_the_observer_that_is_given_or_else_that_of_the_kind(
    observer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_certify, "prepare", lambda task: ("ready", task))
    made = SimpleNamespace(block=lambda: "block", order="parallel")
    monkeypatch.setattr(
        _certify, "design_candidate", lambda *given: made if given[1:3] == (("ready", "t"), "pi") else None
    )
    monkeypatch.setattr(_certify, "make_observer", lambda *given: given)
    monkeypatch.setattr(_certify, "search_draws", lambda *given: given)
    found = _certify._drawn_in_search("t", Candidate("pi", {}, np.zeros(1)), observer)  # pyright: ignore[reportArgumentType]
    assert found == ("t", "block", "parallel", observer or ("t", "pi"))


@pytest.mark.parametrize("observed", [True, False])
def test_a_certificate_is_of_the_loop_that_is_delivered_without_the_draws_of_the_search(
    observed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_for({}, linear={"f": 1}, own={"p": 2, "f, draw 1": 3}, drawn=("f, draw 1",), observer="eyes")
    monkeypatch.setattr(_certify, "verify", lambda *settings, **named: (*settings, named))
    controller, plants, asked, named = _certify._verify_loop(task, "c", observed, None, 2)  # pyright: ignore[reportGeneralTypeIssues]
    assert (controller, plants, asked) == ("c", {"f": 1, "p": 2}, task.asked.certificate)
    assert (named["observer"], named["attempt"]) == ("eyes" if observed else None, 2)


def ended(
    monkeypatch: pytest.MonkeyPatch, *, verified: list[Any], level: str = "all", own: bool = True, m: float = 0.5,
    ahead: float = 0.5,
) -> Any:  # fmt: skip
    """Return the result of a search whose best has this level, over verdicts (holds, value)."""
    bounds = (Requirement("sim.rise_s", "max", 1.0, True), Requirement("track.ahead_rms_deg", "max", 1.0, True))
    task = task_for({}, own={"p": 1} if own else {}, bounds=bounds, tested=False)
    metrics = {"sim.rise_s": m, "axes.sensitivity": 1.0, "track.ahead_rms_deg": ahead}
    best = Candidate("pi", {}, np.zeros(1), level, metrics)
    failed = [SimpleNamespace(value=value, requirement=bounds[min(k, 1)])
              for k, (holds, value) in enumerate(verified) if not holds]  # fmt: skip
    verification = SimpleNamespace(holds=not failed, failed=failed)
    certified = _certify.Certified(best, SimpleNamespace(design={}), False, verification)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(_tune, "prepare", lambda _: SimpleNamespace(own=()))
    monkeypatch.setattr(_tune, "_relax", lambda found, *_: ("relaxed", found))
    search: Any = SimpleNamespace(task=task, sort_candidates=lambda: [best], dropped={"lqg": "no"}, spent=[1],
                                  earlier=1)  # fmt: skip
    return _tune._make_result(search, certified, 1, None, lambda *_: None)


def test_a_result_holds_where_its_certificate_its_loops_and_its_search_do(monkeypatch: pytest.MonkeyPatch) -> None:
    good = ended(monkeypatch, verified=[(True, 0.5)])
    assert (good.holds, good.binding, good.evaluations, good.dropped) == (True, None, 2, {"lqg": "no"})
    what, slow = ended(monkeypatch, verified=[(True, 0.5)], m=1.5)
    assert (what, slow.holds, slow.binding, slow.nearest) == ("relaxed", False, "sim.rise_s", pytest.approx(1.5))
    # `verify` runs no circles: those of the search count.
    what, off = ended(monkeypatch, verified=[(True, 0.5)], ahead=1.5)
    assert (what, off.holds, off.binding) == ("relaxed", False, "track.ahead_rms_deg")
    # The certificate covers more plants than the search; of two that fail there is no nearest value.
    what, found = ended(monkeypatch, verified=[(False, 1.2)])
    assert (what, found.holds, found.binding, found.nearest) == ("relaxed", False, "sim.rise_s", 1.2)
    for others in ([None], [1.4, 1.3]):
        _, found = ended(monkeypatch, verified=[(False, 1.2), *((False, value) for value in others)])
        assert (found.binding, found.nearest) == ("sim.rise_s", None)
    _, found = ended(monkeypatch, verified=[(False, None)])
    assert (found.holds, found.binding) == (False, None)
    # A search that ended before its loops promises nothing, and relaxes nothing; without models there are no loops.
    early = ended(monkeypatch, verified=[(True, 0.5)], level="linear")
    assert early.holds is False
    assert ended(monkeypatch, verified=[(True, 0.5)], level="linear", own=False).holds is True


def test_loops_are_compared_with_loops_and_an_observer_is_judged_where_there_are_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    levels = [of_kind("a", 0.5, level, number=k) for k, level in enumerate(("margins", "all", "linear"))]
    search: Any = SimpleNamespace(sort_candidates=lambda: levels)
    assert _certify.compared_candidates(search) == levels[:2]
    levels[:] = levels[2:]
    assert _certify.compared_candidates(search) == levels
    monkeypatch.setattr(_certify, "make_observer", lambda _, kind: "eyes" if kind == "mpc" else None)
    monkeypatch.setattr(_certify, "holds_with_observer", lambda *_: True)
    monkeypatch.setattr(_certify, "_drawn_in_search", lambda *_: [])
    own_eyes: Any = SimpleNamespace(block=lambda: "seen")
    for own, eyes, kind, observed in (
        ({}, own_eyes, "pi", False), ({"p": 1}, own_eyes, "pi", True), ({"p": 1}, None, "pi", False),
        ({}, own_eyes, "mpc", True),
    ):  # fmt: skip
        task = task_for({}, own=own, observer=eyes, bounds=())
        assert _certify._observed(task, of_kind(kind, 0.5)) is observed


def test_the_observer_is_over_a_model_with_payloads_if_there_is_one_that_it_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    light, heavy = SimpleNamespace(arrays={}), SimpleNamespace(arrays={"payload": np.array([0.0, 1.0, -3.0, -0.2])})
    refused: list[Any] = []

    def design(_: Any, model: Any) -> Any:
        if model in refused:
            raise SettingsError("not this one")
        return model

    monkeypatch.setattr(_tune.KalmanSettings, "design", design)
    task = task_for({}, models=[light, heavy], linear={"a": "first", "b": "second"})
    for expected in (heavy, "first", None):
        assert _tune._observer(task) is expected
        refused.append(expected)


def test_a_search_without_any_result_says_whether_the_budget_or_the_designs_ended_it() -> None:
    spaces = [SimpleNamespace(kind="pi"), SimpleNamespace(kind="lqg")]
    for dropped, error in (({"pi": "x"}, CheckFailedError), ({"pi": "x", "lqg": "y"}, SettingsError)):
        search: Any = SimpleNamespace(task=task_for({}), sort_candidates=list, dropped=dropped, spaces=spaces)
        with pytest.raises(error, match="pi: x"):
            _certify.compared_candidates(search)


def test_the_rise_that_is_aimed_at_is_the_shortest_asked_or_two_time_constants() -> None:
    both = task_for({"require": {"sim.rise_s": {"max": 0.7}, "step.rise_s": {"max": 0.5}}})
    assert _tune._target_rise(both) == 0.5
    # Of the slower axis of the nominal plant, the first.
    for one, other in ((9.0, 4.0), (4.0, 9.0)):
        first, second = (LinearNeck(pitch=axis(one), roll=axis(pole)) for pole in (other, 2.0))
        none = task_for({"require": {"sim.rise_s": False}}, linear={"a": first, "b": second})
        assert _tune._target_rise(none) == pytest.approx(2.0 / 4.0)


@pytest.mark.parametrize(
    ("made", "held"),
    [
        ([], None), ([([0.0, 0.0], [0.2, 0.6])], 0.4), ([([0.0, 0.0], [-0.6, 0.6])], None),
        ([([0.0, 1.0], [0.2, 0.4]), ([0.5, 0.5], [0.8, 1.0])], 0.3),
        ([([0.0, 0.0], [0.05, 0.05])], None), ([([0.0, 0.0], [0.05, 0.052])], 0.051),
        # Of the heaviest load, the middle one of several.
        ([([0.0, 0.0], [2.0, 2.0]), ([0.5, 1.0], [0.5, 0.7]), ([1.0, 1.0], [0.1, 0.3]), ([1.0, 1.0], [1.0, 1.2])], 0.6),
    ],
)  # fmt: skip
def test_the_cocontraction_of_loops_is_the_recordings_with_the_heaviest_load(
    made: list[Any], held: float | None
) -> None:
    parts = [{"payload_kg": kg, "cocontraction": ends} for kg, ends in made]
    thing = SimpleNamespace(findings={"tested": {"conditions": parts}}, robot=Robot.preset())
    found = _tune._recorded_cocontraction({"f": thing}, Robot.preset())
    assert found == (None if held is None else pytest.approx(held))
    # Two of four chambers that pull against each other are enough; where none does there is nothing to hold.
    unit = Scaling.of(BELLOWS).motor_unit
    parts = [{"payload_kg": kg, "cocontraction": [unit * end for end in ends]} for kg, ends in made]
    findings = {"tested": {"conditions": parts}}
    for expected, weights in ((held, PAIR), (None, LEARNED)):
        own = SimpleNamespace(findings=findings, robot=BELLOWS, directions=weights)
        found = _tune._recorded_cocontraction({"f": own}, BELLOWS)
        assert found == (None if expected is None else pytest.approx(unit * expected))


def test_a_search_without_candidates_has_nothing_in_its_way_and_its_defaults_are_those_of_the_command() -> None:
    assert _compare.active_requirement([], [_bound("sim.rise_s")], tested=False) == (None, None)
    defaults = {name: item.default for name, item in inspect.signature(_tune.tune).parameters.items()}
    del defaults["plants"]
    assert defaults == {
        "requirements": None, "kinds": (), "budget": 160, "observer": None, "seed": 0, "workers": None, "folder": None,
        "force": False, "files": None, "progress": None,
    }  # fmt: skip
    options = {option.name: option.default for option in tune_command.params}
    assert (options["budget"], options["seed"]) == (160, 0)


RELAXED = {"sim.rise_s": _compare.Loosened(0.5, 0.6, 0.7)}


def relaxed(
    monkeypatch: pytest.MonkeyPatch, items: list[Candidate], held: dict[tuple[str, bool], bool], tried: int, *,
    before: dict[str, Any] | None = None, holds: bool = True,
):  # fmt: skip
    """Return the result of `_relax` and its certificates (kind, relaxed, attempt); `held` are those that hold.

    `before`: defaults that the first certificate had relaxed; `holds`: whether it does.
    """
    asked = make_tune_requirements({})
    task = replace(task_of({"n": linear_neck()}, {}, 0), asked=asked)
    made: list[tuple[str, bool, int]] = []

    def verified(task: Any, controller: Any, observed: bool, __: Any, attempt: int) -> Any:
        assert observed is (controller.kind == "lqg")
        wider = task.asked.limit("sim.rise_s") == 0.7
        made.append((controller.kind, wider, attempt))
        return SimpleNamespace(holds=held.get((controller.kind, wider), False), failed=[controller.kind], task=task)

    def kept(item: Candidate, failed: Any, _: Any) -> Any:
        return {} if item.settings.get("margins") and failed else RELAXED

    monkeypatch.setattr(_tune, "relaxations", kept)
    monkeypatch.setattr(_certify, "_verify_loop", verified)
    monkeypatch.setattr(_certify, "design_candidate", lambda *settings: SimpleNamespace(kind=settings[2], design={}))
    monkeypatch.setattr(_certify, "prepare", lambda _: None)
    monkeypatch.setattr(_certify, "_observed", lambda _, item: item.kind == "lqg")
    controller = SimpleNamespace(kind=items[0].kind, design={})
    # That of the best may hold where the loops of its search do not.
    first = SimpleNamespace(failed=[items[0].kind], holds=holds, task=_certify.relaxed(task, before or {}))
    found: Any = _Found(task, items[0], first, candidates=tuple(items), controller=controller)
    done: list[float] = []
    best: Any = _certify.Certified(items[0], controller, False, first, before or {})  # pyright: ignore[reportArgumentType]
    again: Any = _tune._relax(found, best, tried, None, lambda share, _: done.append(share))
    # Of the last tenth of the bar of `tune`.
    assert done == sorted(done)
    assert all(0.0 <= share <= 1.0 for share in done)
    assert again.holds is (any(held.get((kind, wide)) for kind, wide, _ in made) or bool(before and holds))
    if not again.holds and before is None:
        assert again is found
    return again, made


def rising(kind: str, rise: float = 0.6, **settings: Any) -> Candidate:
    metrics = {"sim.rise_s": rise, "axes.sensitivity": 1.0}
    return Candidate(kind, settings, np.zeros(1), "all", metrics)


def test_what_is_relaxed_is_verified_again_by_draws_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    found, made = relaxed(monkeypatch, [rising("pi")], {("pi", True): True}, 1)
    assert made == [("pi", True, 2)]
    assert found.loosened == RELAXED
    assert found.task.asked.limit("sim.rise_s") == found.verification.task.asked.limit("sim.rise_s") == 0.7
    assert relaxed(monkeypatch, [rising("pi")], {}, 2)[1] == [("pi", True, 3)]
    monkeypatch.setattr(_tune, "most_attempts", lambda _: 2)
    assert relaxed(monkeypatch, [rising("pi")], {}, 2)[1] == []  # no draws are left
    # A best that fails in its margins is not verified again.
    assert relaxed(monkeypatch, [rising("pi", margins=True)], {}, 2)[1] == []


def test_what_the_draws_of_the_next_certificate_miss_is_relaxed_too(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, steady = make_tune_requirements({}), {"sim.steady_rms_deg": _compare.Loosened(0.15, 0.2, 0.22)}
    task = replace(task_of({"n": linear_neck()}, {}, 0), asked=asked)
    made: list[tuple[set[str], int]] = []

    def again(task: Any, made_before: Any, _: Any, attempt: int) -> Any:
        wider = {name for name in (*RELAXED, *steady) if task.asked.limit(name) != asked.limit(name)}
        made.append((wider, attempt))
        failed = ["steady"] if wider == set(RELAXED) else []
        return replace(made_before, verification=SimpleNamespace(holds=not failed, failed=failed))

    monkeypatch.setattr(_tune, "relaxations", lambda _, failed, __: steady if failed == ["steady"] else RELAXED)
    monkeypatch.setattr(_tune, "certify_again", again)
    item, first = rising("pi"), SimpleNamespace(holds=False, failed=["rise"])
    found: Any = _Found(task, item, first, candidates=(item,), controller=None)
    best: Any = _certify.Certified(item, None, False, first, {})  # pyright: ignore[reportArgumentType]
    relaxed: Any = _tune._relax(found, best, 1, None, lambda *_: None)
    assert made == [(set(RELAXED), 2), ({*RELAXED, *steady}, 3)]
    assert relaxed.loosened == RELAXED | steady


def test_what_its_search_relaxed_is_verified_once_and_told_as_asked_where_nothing_holds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, made = relaxed(monkeypatch, [rising("pi")], {}, 1, before=RELAXED)
    assert made == []
    assert found.loosened == RELAXED
    assert found.task.asked.limit("sim.rise_s") == found.verification.task.asked.limit("sim.rise_s") == 0.7
    # A certificate that fails with them is relaxed by its own values, by draws of its own.
    found, made = relaxed(monkeypatch, [rising("pi")], {("pi", True): True}, 1, before=RELAXED, holds=False)
    assert (found.loosened, made) == (RELAXED, [("pi", True, 2)])
    for item in (rising("pi"), rising("pi", margins=True)):
        found, made = relaxed(monkeypatch, [item], {}, 1, before=RELAXED, holds=False)
        assert made[-1][:2] == ("pi", False)
        assert found.verification.task.asked.limit("sim.rise_s") != 0.7
        assert found.loosened is None


def test_the_best_is_verified_with_the_defaults_that_it_meets_in_its_search(monkeypatch: pytest.MonkeyPatch) -> None:
    task = replace(task_of({"n": linear_neck()}, {}, 0), asked=make_tune_requirements({}))
    limit = task.asked.limit("sim.rise_s")
    assert limit is not None
    monkeypatch.setattr(_certify, "design_candidate", lambda *_: SimpleNamespace(kind="pi", design={}))
    monkeypatch.setattr(_certify, "prepare", lambda _: None)
    monkeypatch.setattr(_certify, "_observed", lambda *_: False)
    monkeypatch.setattr(_certify, "_verify_loop", lambda task, *_: SimpleNamespace(holds=True, task=task))
    for factor, wider in ((1.0, {}), (1.4, {"sim.rise_s"}), (2.4, {})):
        search: Any = SimpleNamespace(
            task=task, sort_candidates=lambda f=factor: [rising("pi", f * limit)], cost=lambda _: 9.0
        )
        certified, tried = _certify._verify_best(search, 0, None, lambda *_: None)
        seen: Any = certified.verification
        assert (tried, certified.kept.keys()) == (1, wider or set())
        assert (seen.task.asked.limit("sim.rise_s") > limit) is bool(wider)
    # What a relaxed certificate fails is relaxed from the limit that was asked, to the worse of both values.
    failed = [Verdict(Requirement("sim.rise_s", "max", 1.5 * limit, True), 1.6 * limit, False, {})]
    one = _compare.relaxations(rising("pi", 1.4 * limit), failed, task.asked)["sim.rise_s"]
    assert (one.default, one.reached) == (limit, pytest.approx(1.6 * limit))


def test_where_the_best_fails_in_more_the_best_of_another_kind_is_verified_and_relaxed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    items = [rising("pi", margins=True), rising("pi"), rising("lqg"), rising("lqg"), rising("mpc")]
    monkeypatch.setattr(_tune, "most_attempts", lambda _: 4)
    found, made = relaxed(monkeypatch, items, {("lqg", True): True}, 1)
    # At what was asked first, which tells each metric that fails; never more certificates than a family has draws for.
    assert made == [("lqg", False, 2), ("lqg", True, 3)]
    assert (found.best, found.controller.kind, found.observed) == (items[2], "lqg", True)
    assert relaxed(monkeypatch, items, {}, 1)[1] == [("lqg", False, 2), ("lqg", True, 3)]
    assert relaxed(monkeypatch, items, {}, 2)[1] == [("lqg", False, 3), ("lqg", True, 4)]
    assert relaxed(monkeypatch, items, {}, 3)[1] == []
    # One that fails in its margins in the search is left out, and one that could not be judged to its end.
    poor, lost = rising("lqg"), replace(rising("lqg"), error="it diverged")
    poor.metrics["axes.sensitivity"] = 1.01 * (make_tune_requirements({}).limit("axes.sensitivity") or math.nan)
    assert relaxed(monkeypatch, [items[0], poor, lost], {}, 1)[1] == []


@dataclass(frozen=True)
class _Found:
    task: Any
    best: Any
    verification: Any
    holds: bool = False
    loosened: Any = None
    controller: Any = None
    candidates: Any = ()
    assumed: Any = None
    observed: bool = False


def test_four_draws_of_each_family_are_in_every_loop_of_a_search() -> None:
    models = [linear_neck() for _ in range(9)]
    draws: Any = SimpleNamespace(model=None, for_search=lambda count: models[:count], conditions={"payload_kg": [0.0]})
    task = task_of({"f": replace(family(), draws=draws), "g": family()}, {}, 0)
    assert task.own == {f"f, draw {k + 1}": models[k] for k in range(4)}
    assert task.drawn == tuple(task.own)


@pytest.mark.parametrize("loads", [[[0.0, 0.5], [0.2, 1.0]], [[1.0, 0.2], [0.5, 0.0]]])
def test_default_payloads_end_where_the_draws_of_every_family_have_them(
    loads: list[list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    families = [SimpleNamespace(draws=SimpleNamespace(conditions={"payload_kg": kg})) for kg in loads]
    asked: list[Any] = []
    monkeypatch.setattr(_tune, "sources_of", lambda _: {})
    monkeypatch.setattr(_tune, "default_rise", lambda *_: 0.5)
    monkeypatch.setattr(_tune, "make_tune_requirements", lambda *_, **settings: asked.append(settings["payload"]))
    _tune._read_requirements({}, Robot.preset(), [*families, SimpleNamespace(draws=None)], stepping=True)
    assert set(asked) == {0.5}
    asked.clear()
    _tune._read_requirements({}, Robot.preset(), [SimpleNamespace(draws=None)], stepping=True)
    assert set(asked) == {None}
    # What was read stays as it is.
    read = make_tune_requirements({})
    assert _tune._read_requirements(read, Robot.preset(), families, stepping=True) is read
