"""A candidate is judged by the worst plant, loop, payload and axis; what is no number never counts as good."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import metric_of
from softneck.loop import LoopResult
from softneck.robot import Robot
from softneck.tuning import _judge
from softneck.tuning._judge import (
    Case,
    keep_worse,
    linear_metrics,
    loop_metrics,
    margin_metrics,
    run_case,
    told_conditions,
    variation,
)
from softneck.tuning._search import Candidate, ratio
from softneck.tuning._task import Judgement
from softneck.tuning._tune import front
from softneck.verification import LARGE, SMALL, Scale, metric_names
from softneck.verification._linear import AxisMargins
from softneck.verification._requirements import Requirement

from ..order import MEMBERS, check_worst, is_worse

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
        """Return the metrics where the values are spread over so many frozen points."""
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


def test_a_case_tells_all_that_is_judged_and_only_slack_may_be_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {f"sim.{name}": value for name, value in VALUES.items() if name != "limit_violation_s"}
    assert _case(monkeypatch, Case(0, 0.0), VALUES) == (told, "measured")
    for name in VALUES:
        found, _ = _case(monkeypatch, Case(0, 0.0), {**VALUES, name: math.nan})
        if name in ("slack_s", "limit_violation_s"):
            assert f"sim.{name}" not in found
        else:
            assert math.isnan(found[f"sim.{name}"])


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
def test_a_later_level_never_improves_a_margin(name: str) -> None:
    for first, second in ((1.5, 3.0), (3.0, 1.5)):
        item = Candidate("pi", {}, np.zeros(1))
        item.update("linear", Judgement({name: first}))
        item.update("margins", Judgement({name: second}))
        margin = name in ("axes.gain_margin", "axes.delay_margin_ms")
        assert item.metrics[name] == (1.5 if margin else second)
        assert item.level == "margins"
    item.update("all", Judgement({name: 9.0}, "it failed"))
    assert (item.level, item.error, item.metrics[name]) == ("margins", "it failed", second if not margin else 1.5)


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
    ("drawn", "stated", "heaviest", "told"), [(("d",), (), 0.0, True), (("d",), ("sim.payloads_kg",), 0.0, False),
                                              (("d",), (), 1.0, False), ((), (), 0.0, False)]
)  # fmt: skip
def test_a_default_payload_that_was_not_recorded_is_told(
    drawn: tuple[str, ...], stated: tuple[str, ...], heaviest: float, told: bool
) -> None:
    task = _task(sim={"payloads_kg": [heaviest]}, own={}, robot=Robot.preset())
    task.drawn, task.asked.track, task.asked.stated = drawn, {"delay_ms": 0.0}, frozenset(stated)
    found = told_conditions(task, [], TS)
    assert list(found) == ["payload 1 kg"] * told
    assert all(text.startswith("judged with at most 0 kg") and "--payload 1`" in text for text in found.values())
