"""Worst means worst: over axes, plants, payloads, directions and searches, for every metric of a verification."""

from __future__ import annotations

import errno
import math
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, metric_of
from softneck.loop import LoopResult
from softneck.robot import Robot
from softneck.verification import (
    Verification,
    _evidence,
    _experiments,
    _linear,
    _neck_loops,
    _steps,
    _structured,
    _verify,
    metric_names,
)
from softneck.verification._evidence import Evidence, Values, worst_row
from softneck.verification._experiments import Crossing, crossing_values
from softneck.verification._linear import LARGE, SMALL, LinearLaw, margins
from softneck.verification._metrics import Scale
from softneck.verification._neck_loops import LoopRun, judge_loop
from softneck.verification._plants import all_plants, nominal_plants, source_of_family
from softneck.verification._requirements import Requirement, make_requirements
from softneck.verification._steps import StepTest, _metrics, run_steps
from softneck.verification._structured import StructuredResult, _Task
from softneck.verification._verify import Verdict, _verdict

from ..order import check_worst, is_worse
from .necks import TS, family, pi

ALL = metric_names(Robot.preset())
CONTROLLER = cache(pi)


def _bound(name: str) -> str:
    return "min" if metric_of(name).larger else "max"


@pytest.mark.parametrize("name", ALL)
def test_the_row_of_a_verdict_is_the_worst(name: str) -> None:
    def of(values: Any) -> float:
        table = {name: Values(np.array(values, float), lambda row: {"row": row})}
        return float(table[name].values[worst_row(table, name, _bound(name))])

    check_worst(name, of)


@pytest.mark.parametrize("name", ALL)
def test_a_verdict_is_that_of_the_worst_and_no_number_holds_nothing(name: str) -> None:
    """A verdict has the value and the plant of the worst; NaN on either side of the comparison fails."""
    worse, better = (1.2, 1.7) if metric_of(name).larger else (1.7, 1.2)

    def verdict(values: list[float], limit: float) -> Any:
        table = {name: Values(np.array(values), lambda row: {"row": row})}
        evidence: Any = SimpleNamespace(
            metrics=table,
            not_computed={},
            foreign=False,
            tested=[],
            drawn=[],
            crossings=[],
            plants=SimpleNamespace(axes=()),
        )
        return _verdict(Requirement(name, _bound(name), limit, True), evidence, {})

    for values in ([worse, better], [better, worse]):
        assert verdict(values, worse).holds
        assert verdict(values, worse).value == worse
        assert verdict(values, worse).worst == {"row": values.index(worse)}
        assert verdict(values, better).holds is False
        assert verdict(values, math.nan).holds is False
        assert verdict([*values, math.nan], worse).holds is False
        assert verdict([math.nan, *values], worse).holds is False


@pytest.mark.parametrize("asked", [True, False])
@pytest.mark.parametrize(
    ("name", "drawn", "foreign", "value", "holds", "note"),
    [
        # Without draws each decides; a built-in plant decides where it is asked.
        ("axes.sensitivity", None, False, 9.0, (False, False), ""),
        ("axes.sensitivity", None, False, 1.0, (True, True), ""), ("sim.rise_s", None, False, 9.0, (False, False), ""),
        ("sim.rise_s", None, True, 9.0, (False, None), "built-in"),
        ("sim.rise_s", None, True, 1.0, (True, None), "built-in"), ("step.rise_s", None, True, 9.0, (False, False), ""),
        # With draws: what they tell decides, a linear test that fails is shown beside, and one that is asked counts.
        ("axes.gain_margin", "axes.gain_margin", False, 1.0, (False, False), ""),
        ("axes.sensitivity", "axes.gain_margin", False, 9.0, (False, None), "draws of the family decide"),
        ("axes.sensitivity", "axes.gain_margin", False, 1.0, (True, True), ""),
        ("sim.rise_s", "axes.gain_margin", False, 9.0, (False, False), ""),
        # What was not computed: of simulated loops, or beside draws, it is open where nobody asked; else it fails.
        ("step.rise_s", None, False, None, (False, False), "not computed"),
        ("sim.rise_s", None, False, None, (False, None), "not computed"),
        ("robust.mu", "axes.gain_margin", False, None, (False, None), "not computed"),
    ],
)  # fmt: skip
def test_who_decides(
    name: str, drawn: str | None, foreign: bool, value: float | None, holds: tuple[Any, Any], note: str, asked: bool
) -> None:
    table = {} if value is None else {name: Values(np.array([value]), lambda _: {})}
    part = SimpleNamespace(values={drawn: [1.0]}, unreached={})
    evidence: Any = SimpleNamespace(
        metrics=table, not_computed={}, foreign=foreign, tested=[], drawn=[part] if drawn else [], crossings=[],
        plants=SimpleNamespace(axes=("pitch", "roll")),
    )  # fmt: skip
    found = _verdict(Requirement(name, _bound(name), 1.5, asked), evidence, {})
    assert (found.holds, found.value) == (holds[0 if asked else 1], value)
    assert (note in found.note) if note and not (asked and note != "not computed") else found.note == ""


@pytest.mark.parametrize(
    ("metric", "why"),
    [("sim.rise_s", ["no such payload"]), ("axes.gain_margin", ["pitch"]), ("step.rise_s", ["loop"]),
     ("pitch.sensitivity", ["pitch"]), ("roll.sensitivity", ["loop"]), ("roll.delay_margin_ms", ["alone"]),
     ("robust.mu", ["pitch"]), ("track.circle_rms_deg", [""])],
)  # fmt: skip
def test_the_data_that_a_metric_is_about_must_support_it(metric: str, why: list[str]) -> None:
    def reason(tested: bool, *, foreign: bool = False, drawn: Any = (), said: Any = None) -> str:
        told = [SimpleNamespace(axis=axis, why=lambda axis=axis: "" if axis == "roll" else axis, unheard=())
                for axis in ("roll", "pitch")]  # fmt: skip
        evidence: Any = SimpleNamespace(tested=told * tested, foreign=foreign, drawn=list(drawn),
                                        plants=SimpleNamespace(axes=("pitch", "roll")))  # fmt: skip
        elsewhere = {"sim": "no such payload", "margins": "alone", "loop": "loop"} if said is None else said
        return _verify.unsupported_reason(Requirement(metric, "max", 1.0, True), evidence, elsewhere)

    assert reason(True) == why[0]
    assert reason(True, said={}) == (why[0] if why[0] == "pitch" else "")
    assert reason(False, said={}) == ""
    if metric.startswith("sim."):
        assert reason(True, foreign=True) == ""
        large: Any = SimpleNamespace(values={}, unreached={"sim": "too large"})
        assert reason(True, drawn=[large]) == "too large"
    # What draws tell is about their loops, of which the co-contraction alone may be another.
    decided = SimpleNamespace(values={metric: [1.0]}, unreached={})
    if not metric.startswith("sim."):
        assert reason(True, drawn=[decided]) == "loop"


@pytest.mark.parametrize("holds", [[True, None], [True, False], [False, True], [None], [None, None], [True, True]])
def test_a_verification_holds_where_some_are_judged_and_none_fails_and_counts_what_is_not_computed(
    holds: list[Any],
) -> None:
    item = Requirement("axes.sensitivity", "max", 2.0, True)
    verdicts = [Verdict(item, None if value is None else 1.5, value, {"row": k}, "open" * (value is None))
                for k, value in enumerate(holds)]  # fmt: skip
    evidence: Any = SimpleNamespace(drawn=[], plants=[0] * 7, necks=[], not_computed={"sim": "none"}, foreign=True,
                                    tested=[], crossings=[], linear=[])  # fmt: skip
    under: Any = SimpleNamespace(extra=2, order="parallel", robot=Robot.preset(),
                                 block=SimpleNamespace(sample_time=TS, kind="pi"))  # fmt: skip
    files = {"controller": ("pi.npz", "a" * 64)}
    found = Verification(verdicts=verdicts, evidence=evidence, controller=under, necks=[], files=files,
                         observer=holds[0] is True, requirements=make_requirements({}))  # fmt: skip
    assert found.holds is (True in holds and False not in holds)
    assert [verdict.worst["row"] for verdict in found.failed] == [k for k, value in enumerate(holds) if value is False]
    assert found.summary().startswith("all" if all(holds) else f"{holds.count(True)} of {len(holds)} requirements hold")
    assert (", 1 is not computed" in found.summary()) is (holds.count(None) == 1)
    assert "parallel order: 2 samples of delay" in found.order_words()
    said = found.contents({0: Path("worst.toml")})
    assert (said["holds"], said["observer"]) == (found.holds, holds[0] is True)
    assert [row["holds"] for row in said["requirements"]] == holds
    assert [row.get("note") for row in said["requirements"]] == [None if v is not None else "open" for v in holds]
    assert [row.get("loop") for row in said["requirements"]] == ["worst.toml", *[None] * (len(holds) - 1)]
    assert (said["plants"]["count"], said["extra_delay_samples"], said["not_computed"]) == (7, 2, {"sim": "none"})
    assert said["files"] == {"controller": {"path": "pi.npz", "sha256": "a" * 64}}
    assert "attempts" not in said
    assert found.contents(further={"attempts": {"tried": []}})["attempts"] == {"tried": []}
    assert {"robot", "scale"}.isdisjoint(said)
    # Of another robot it says whose, and by what the defaults were stretched.
    other = Robot.preset("antagonist")
    under.robot = other
    scale = Scale(robot=other, time=3.0, size=2.0)
    found = Verification(verdicts=verdicts, evidence=evidence, controller=under, necks=[], observer=False,
                         requirements=make_requirements({}, scale=scale))  # fmt: skip
    said = found.contents()
    assert said["robot"] == {"name": "antagonist", "hash": other.hash}
    assert said["scale"] == {"time": 3.0, "size": 2.0}


def test_the_validity_of_a_certificate_is_the_narrowest_of_its_families_and_the_least_of_its_margins() -> None:
    tested: Any = [SimpleNamespace(band=(1.0, 30.0), margins={"gain_margin": 2.5, "delay_margin_ms": 90.0}),
                   SimpleNamespace(band=(2.0, 20.0), margins={"gain_margin": 3.5})]  # fmt: skip
    part = SimpleNamespace(plants=SimpleNamespace(axes=("pitch", "roll")), margins={
        "pitch.gain_margin": np.array([4.0, 3.0]), "roll.gain_margin": np.array([2.2, 5.0]),
        "pitch.delay_margin_ms": np.array([80.0]), "roll.delay_margin_ms": np.array([100.0])})  # fmt: skip
    found = [
        Crossing("p", axes, what, 0.1, (0.0, 0.0), value, 0.0)
        for axes, what, value in (("both", "gain_down", 1.9), ("roll", "delay", 0.07), ("pitch", "gain_up", 2.9))
    ]
    facts = {"amplitude": [0.0, 0.3, 0.1], "confidence": 0.95, "names": ["a.csv"], "sha256": ["b"]}
    more = {**facts, "amplitude": [0.7], "confidence": 0.9}
    evidence: Any = SimpleNamespace(tested=tested, crossings=found, linear=[part])
    said = _verify.validity(evidence, {"f": facts, "g": more})
    assert (said["band_rad_s"], said["amplitude_rad"], said["confidence_level"]) == ([2.0, 20.0], [0.1, 0.7], 0.9)
    assert said["margins"] == {
        "linear": {"gain_ratio": 2.2, "delay_s": 0.08},
        "simulated": {"gain_ratio": 1.9, "delay_s": 0.07},
    }
    assert said["recordings"][0] == {"family": "f", "name": "a.csv", "sha256": "b"}
    none = _verify.validity(SimpleNamespace(tested=[], crossings=[], linear=[]), {})  # pyright: ignore[reportArgumentType]
    assert none["margins"] == {kind: {"gain_ratio": None, "delay_s": None} for kind in ("linear", "simulated")}
    assert (none["band_rad_s"], none["amplitude_rad"], none["confidence_level"]) == (None, None, None)


# -- steps ------------------------------------------------------------------------------------------------------------

TEST = StepTest(step=0.2, duration=1.0, noise=0.0, load=0.0, seed=0)
HALF = 50


def response(size: float, lag: float, peak: float = 0.0) -> np.ndarray:
    """Rows of a step and of the load after it; a slower lag, a larger peak and a larger offset are worse."""
    t = np.arange(2 * HALF) * TS
    y = 1.0 - np.exp(-t / lag) + peak * np.exp(-((t - 0.3) ** 2) / 0.005)
    return TEST.step * (y + 0.1 * size * (t >= 0.9))


def stepped(monkeypatch: pytest.MonkeyPatch, members: list[np.ndarray], others: list[Any]) -> _steps.Steps:
    """Return the steps of one plant whose axes respond as `members`, moving the other axis by `others`."""
    plants = nominal_plants([source_of_family(family(), "f")])[0].take(np.array([0]))
    runs = iter(zip(members, others, strict=True))

    def run(plants: Any, block: Any, signals: np.ndarray, *_: Any) -> tuple[np.ndarray, np.ndarray]:
        axis = int(np.flatnonzero(signals[-1, :2])[0])
        member, other = next(runs)
        y = np.full((1, len(signals), 2), other)
        y[0, :, axis] = member
        return y, np.zeros((1, len(signals), 3))

    monkeypatch.setattr(_steps, "_run", run)
    return run_steps(plants, CONTROLLER().block(), TEST)


@pytest.mark.parametrize("name", _steps.METRICS)
def test_the_worse_axis_of_a_step_counts_and_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The first is worse by every metric: slower, with a peak, an offset, and more of the other axis.
    bad, good = (response(1.0, 0.12, 0.4), 0.02), (response(0.2, 0.06, 0.2), 0.005)
    alone = {}
    for label, (y, other) in {"bad": bad, "good": good}.items():
        alone[label] = _metrics(y[None], np.full((1, HALF), other), TEST, HALF, TS)[name][0]
    assert is_worse(name, alone["bad"], alone["good"])
    for members, at in (((bad, good), 0), ((good, bad), 1)):
        found = stepped(monkeypatch, [y for y, _ in members], [other for _, other in members])
        assert found.metrics[name][0] == alone["bad"]
        assert found.worse[name][0] == at
    for lost in (math.nan, math.inf):
        for place in (0, 1):
            y = good[0].copy()
            y[60] = lost
            members = [good[0], good[0]]
            members[place] = y
            found = stepped(monkeypatch, members, [0.0, 0.0])
            assert found.metrics[name][0] == math.inf
            assert found.worse[name][0] == place


@pytest.mark.parametrize(("row", "counts"), [(0, True), (HALF - 1, True), (HALF, False)])
@pytest.mark.parametrize("size", [0.03, -0.03, math.nan, math.inf])
def test_what_another_axis_does_counts_until_the_load_comes(
    row: int, counts: bool, size: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = np.zeros((2 * HALF, 1))
    other[row] = size
    still, y = np.zeros_like(other), response(0.2, 0.06)
    expected = 0.0 if not counts else abs(math.degrees(size)) if math.isfinite(size) else math.inf
    for others in ([other, still], [still, other]):
        found = stepped(monkeypatch, [y, y], others)
        assert found.metrics["coupling_deg"][0] == pytest.approx(expected)
        # What is no number makes the whole response none.
        assert math.isfinite(found.metrics["rise_s"][0]) is (math.isfinite(size) or not counts)


def test_each_metric_of_a_step_follows_its_own_row() -> None:
    """Each plant has its own value: no row of an array takes that of another, in whatever order they stand."""
    rows = [response(1.0, 0.12, 0.4), response(0.2, 0.06, 0.2), response(0.0, 0.3), response(0.5, 0.05)]
    others = [0.02, -0.03, 0.0, 0.01]
    y, other = np.stack(rows), np.stack([np.full(HALF, value) for value in others])
    whole = _metrics(y, other, TEST, HALF, TS)
    for name, values in whole.items():
        for row in range(len(rows)):
            assert values[row] == _metrics(y[[row]], other[[row]], TEST, HALF, TS)[name][0]
        np.testing.assert_array_equal(_metrics(y[::-1], other[::-1], TEST, HALF, TS)[name], values[::-1])
        assert len(set(values.tolist())) > 2, name


# -- loops over simulation models -------------------------------------------------------------------------------------


def loop_result(pitch: np.ndarray, roll: np.ndarray, sizes: tuple[float, float] = (0.2, 0.1)) -> LoopResult:
    rows = pitch.size
    signals = {"pitch": pitch, "roll": roll}
    signals |= {f"{axis}_reference": np.full(rows, s) for axis, s in zip(("pitch", "roll"), sizes, strict=True)}
    signals |= {f"motor_setpoint_{j}": np.full(rows, 0.1 * j) for j in (1, 2, 3)}
    for axis in ("pitch", "roll"):
        signals[f"{axis}_reference"][0] = 0.0
    return LoopResult(np.arange(rows) * TS, signals, {}, TS)


def judged(monkeypatch: pytest.MonkeyPatch, result: Any) -> tuple[dict[str, float], Any]:
    def run(loop: Any, *, compiled: bool) -> LoopResult:
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(_neck_loops, "run_loop", run)
    return judge_loop(SimpleNamespace(reference=None))  # pyright: ignore[reportArgumentType]


AXIS = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg")


@pytest.mark.parametrize("name", AXIS)
def test_the_worse_axis_of_a_loop_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bad, good = (response(1.0, 0.12, 0.4) / 0.2, response(0.2, 0.06, 0.2) / 0.2)
    sizes = (0.2, 0.2)
    both = [judged(monkeypatch, loop_result(0.2 * a, 0.2 * b, sizes))[0][name] for a, b in ((bad, good), (good, bad))]
    alone = [judged(monkeypatch, loop_result(0.2 * y, 0.2 * y, sizes))[0][name] for y in (bad, good)]
    assert is_worse(name, alone[0], alone[1])
    assert both == [alone[0]] * 2
    # An axis that never arrives, or whose output is no number at all, is worse than any that does.
    for lost in (np.full(2 * HALF, math.nan), np.full(2 * HALF, math.inf)):
        for pair in ((lost, 0.2 * good), (0.2 * good, lost)):
            found = judged(monkeypatch, loop_result(*(y.copy() for y in pair), sizes=sizes))[0][name]
            assert is_worse(name, found, alone[1])


def test_a_loop_that_diverged_is_infinitely_bad_in_every_metric(monkeypatch: pytest.MonkeyPatch) -> None:
    values, result = judged(monkeypatch, DataError("overflow"))
    assert result is None
    assert set(values) == {*AXIS, "max_rad", "limit_violation_s", "slack_s"}
    assert all(value == math.inf for value in values.values())


def test_only_an_axis_that_hardly_moves_is_not_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    good, still = 0.2 * (response(0.2, 0.06) / 0.2), np.zeros(2 * HALF)
    tiny = judged(monkeypatch, loop_result(good.copy(), still.copy(), (0.2, 0.2 * 0.05)))[0]
    assert tiny["rise_s"] < math.inf
    larger = judged(monkeypatch, loop_result(good.copy(), still.copy(), (0.2, 0.2 * 0.051)))[0]
    assert larger["rise_s"] == math.inf


def evidence_of(slack: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch, robot: Robot | None = None) -> Any:
    """Return the evidence of loops with (slack, payload); NaN: no tension outputs, inf: diverged."""
    names = (*AXIS, "max_rad", "limit_violation_s")
    runs = [
        LoopRun(f"run {k}", None, kg, 0.0, k, {**dict.fromkeys(names, 1.0 + k), "slack_s": value},
                None if math.isinf(value) else SimpleNamespace())  # pyright: ignore[reportArgumentType]
        for k, (value, kg) in enumerate(slack)
    ]  # fmt: skip
    asked = make_requirements({"sim": {"taut_up_to_kg": 0.5, "payloads_kg": [0.0, 0.5, 1.0]}}, robot=robot)
    empty: Any = SimpleNamespace(metrics={}, worse={})
    evidence = Evidence(None, None, [], empty, None, runs)  # pyright: ignore[reportArgumentType]
    controller: Any = SimpleNamespace(why="", block=SimpleNamespace(inputs=()), robot=Robot.preset())
    monkeypatch.setattr(_evidence, "_neck_describer", lambda *_: lambda row: {"name": runs[row].name})
    _evidence._fill_metrics(evidence, controller, asked, observer=False)
    return evidence


@pytest.mark.parametrize("name", [*AXIS, "max_rad", "limit_violation_s"])
def test_every_run_counts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = evidence_of([(0.0, 0.0), (0.1, 0.5), (0.0, 1.0)], monkeypatch).metrics[f"sim.{name}"]
    assert found.values.tolist() == [1.0, 2.0, 3.0]
    assert found.describe(2) == {"name": "run 2"}


@pytest.mark.parametrize(
    ("slack", "values", "last"),
    [
        ([(0.1, 0.0), (0.3, 0.5), (0.2, 0.0)], [0.1, 0.3, 0.2], 2),
        # Above 0.5 kg the payload takes the pretension, whatever the controller does.
        ([(0.1, 0.0), (9.0, 0.51), (0.2, 0.5)], [0.1, 0.2], 2),
        # A plant that does not tell its tensions hides no slack of another, and a diverged loop is none that does not.
        ([(math.nan, 0.0), (0.3, 0.0)], [0.3], 1),
        ([(math.nan, 0.0), (0.0, 0.0), (math.inf, 0.0)], [0.0, math.inf], 2),
        ([(math.nan, 0.0), (0.0, 0.0)], None, 0),
        ([(9.0, 0.6)], None, 0),
    ],
)  # fmt: skip
def test_slack_is_judged_wherever_it_is_known(
    slack: list[tuple[float, float]], values: list[float] | None, last: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = evidence_of(slack, monkeypatch)
    if values is None:
        assert "sim.slack_s" not in found.metrics
        assert found.not_computed["sim.slack_s"]
        return
    assert found.metrics["sim.slack_s"].values.tolist() == values
    assert found.metrics["sim.slack_s"].describe(len(values) - 1) == {"name": f"run {last}"}


def test_a_robot_without_tendons_hears_nothing_of_slack(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot.from_dict({
        "name": "joint", "motors": {"names": ["m"], "unit": "rad"}, "outputs": {"names": ["bend"], "unit": "rad"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    found = evidence_of([(math.nan, 0.0)], monkeypatch, robot)
    assert "sim.slack_s" not in {*found.metrics, *found.not_computed}


def test_draws_decide_for_what_they_tell_beside_experiments_on_the_user_s_plants() -> None:
    def values(*numbers: float, who: str) -> Values:
        return Values(np.array(numbers), lambda row: {"who": who, "row": row})

    crossing = Crossing("own", "both", "gain_up", 0.02, (0.0, 0.0), 1.3, 0.0)
    draws = SimpleNamespace(
        values={"axes.gain_margin": np.array([2.0, 3.0]), "sim.rise_s": np.array([0.5])},
        conditions={"axes.gain_margin": [{"name": "a"}, {"name": "b"}], "sim.rise_s": [{"name": "c"}]},
    )
    before = {"axes.gain_margin": values(9.0, who="linear"), "axes.sensitivity": values(1.1, who="linear"),
              "sim.rise_s": values(0.4, who="loop")}  # fmt: skip
    evidence: Any = SimpleNamespace(metrics=dict(before), crossings=[crossing], drawn=[draws])
    _evidence._add_drawn(evidence, set(draws.values))
    found = evidence.metrics
    assert found["axes.gain_margin"].values.tolist() == [1.3, 2.0, 3.0]
    assert found["axes.gain_margin"].describe(0)["kind"] == "experiment"
    assert [found["axes.gain_margin"].describe(row) for row in (1, 2)] == [
        {"kind": "draw", "name": "a"}, {"kind": "draw", "name": "b"},
    ]  # fmt: skip
    # Loops over other plants stay beside those of the draws, and what the draws do not tell stays as it was.
    assert found["sim.rise_s"].values.tolist() == [0.4, 0.5]
    assert found["axes.sensitivity"] is before["axes.sensitivity"]


def test_margins_over_the_recordings_and_by_experiment_are_added_to_their_groups() -> None:
    part: Any = SimpleNamespace(
        source="f", axis="roll", band=(1.0, 20.0), margins={"disk_margin": 0.7, "gain_margin": 2.4}, mu=0.9,
        at={"disk_margin": 5.0, "gain_margin": 6.0, "mu": 7.0},
    )  # fmt: skip
    crossing = Crossing("own", "pitch", "delay", 0.02, (0.0, 0.0), 0.05, 0.0)
    evidence: Any = SimpleNamespace(metrics={}, tested=[part], crossings=[crossing], not_computed={})
    _evidence._add_data_margins(evidence)
    table = {name: found.values.tolist() for name, found in evidence.metrics.items()}
    assert table == {
        "roll.disk_margin": [0.7], "axes.disk_margin": [0.7], "mimo.disk_margin": [0.7], "roll.gain_margin": [2.4],
        "axes.gain_margin": [2.4], "robust.mu": [0.9], "pitch.delay_margin_ms": [50.0], "axes.delay_margin_ms": [50.0],
    }  # fmt: skip
    facts = evidence.metrics["robust.mu"].describe(0)
    assert (facts["axis"], facts["frequency_rad_s"], facts["band_rad_s"]) == ("roll", 7.0, [1.0, 20.0])
    assert evidence.not_computed == {}
    nothing: Any = SimpleNamespace(metrics={}, tested=[], crossings=[], not_computed={})
    _evidence._add_data_margins(nothing)
    assert set(nothing.not_computed) == {"the band of the data", "margins by experiment"}


def test_margins_of_each_law_plant_and_search_stand_under_their_axis_and_under_all() -> None:
    margin_table = {
        "stability.radius": np.array([0.8, 0.9, 0.95]),
        "pitch.gain_margin": np.array([3.0, 2.5, 2.0]),
        "roll.gain_margin": np.array([4.0, 1.5, 5.0]),
        "mimo.disk_margin": np.array([0.5, 0.6, 0.7]),
    }
    plants = SimpleNamespace(axes=("pitch", "roll"))
    # Of two sources, the second of which has two boxes.
    boxes = [StructuredResult("pitch", np.array([1.0, 2.0]), np.array(upper)) for upper in ([0.3, 0.6], [0.9, 0.2])]
    rows = [boxes[:1], boxes]
    part: Any = SimpleNamespace(plants=plants, margins=margin_table, structured=rows,
                                found=SimpleNamespace(radius=0.99))  # fmt: skip
    evidence: Any = SimpleNamespace(metrics={}, plants=[0, 1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_evidence, "plant_facts", lambda _, row: {"row": row})
        _evidence._add_linear_margins(evidence, part)
        found = evidence.metrics
        assert found["stability.radius"].values.tolist() == [0.8, 0.9]
        # The plant of the search, and the largest radius that it met, which the same plant stands for.
        searched = found["stability.searched_radius"]
        assert searched.values.tolist() == [0.95, 0.99]
        assert [searched.describe(k)["row"] for k in (0, 1)] == [2, 2]
        assert found["axes.gain_margin"].values.tolist() == [3.0, 2.5, 2.0, 4.0, 1.5, 5.0]
        assert found["axes.gain_margin"].describe(4) == {"row": 1, "axis": "roll"}
        assert found["mimo.disk_margin"].describe(1) == {"row": 1, "axis": "both"}
        assert found["robust.mu"].describe(0)["frequency_rad_s"] == 2.0
        assert found["robust.mu"].describe(2)["frequency_rad_s"] == 1.0
        assert found["robust.mu"].values.tolist() == [0.6, 0.6, 0.9]


def test_what_was_not_computed_is_said() -> None:
    def absent(*, laws: int = 1, observer: bool = False, generations: int = 5, payload: bool = False) -> Any:
        parts: list[Any] = [SimpleNamespace() for _ in range(laws)]
        evidence = Evidence(None, None, parts, SimpleNamespace(metrics={}), None, [])  # pyright: ignore[reportArgumentType]
        ports = (SimpleNamespace(name="payload"),) if payload else ()
        controller: Any = SimpleNamespace(why="it has no ss()", block=SimpleNamespace(inputs=ports))
        asked = make_requirements({"sampling": {"search_generations": generations}})
        added.clear()
        _evidence._fill_metrics(evidence, controller, asked, observer=observer)
        assert added == parts
        return {key: why for key, why in evidence.not_computed.items()
                if key not in ("the band of the data", "margins by experiment")}  # fmt: skip

    added: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_evidence, "_add_linear_margins", lambda _, part: added.append(part))
        assert absent() == {}
        assert absent(laws=0) == dict.fromkeys(("stability", "axes", "mimo", "robust"), "it has no ss()")
        assert set(absent(observer=True)) == {"observer in the linear checks"}
        assert set(absent(observer=True, laws=0)) == {"stability", "axes", "mimo", "robust"}
        assert set(absent(generations=0)) == {"stability.searched_radius"}
        assert set(absent(payload=True)) == {"steps of other payloads"}


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("slack", [True, False])
@pytest.mark.parametrize("sim", [{}, {"decides": True}, {"preset": "n.toml"}])
def test_loops_decide_over_models_draws_and_what_is_asked_and_over_a_built_in_plant_for_nobody(
    own: bool, drawn: bool, slack: bool, sim: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Evidence(None, None, [], None, None, [])  # pyright: ignore[reportArgumentType]
    ran: list[Any] = []
    part = SimpleNamespace(values={"sim.rise_s": [0.4]})
    monkeypatch.setattr(_evidence, "compute_once", lambda compute, *_: compute())
    monkeypatch.setattr(_evidence, "_linear_evidence", lambda *_: whole)
    monkeypatch.setattr(_evidence, "_simulated", lambda *_, **more: ran.append(more) or (["run"], ["crossing"]))
    monkeypatch.setattr(_evidence, "why_no_virtual_plant", lambda *_: "")
    monkeypatch.setattr(_evidence, "judged_elsewhere", lambda *_: {"payload 2 kg": "judged at 1 kg"})
    monkeypatch.setattr(_evidence, "_fill_metrics", lambda *_: None)
    monkeypatch.setattr(_evidence, "draws_of", lambda _: {"f": "draws", "g": "draws"} if drawn else {})
    monkeypatch.setattr(_evidence, "run_drawn", lambda *_, **more: ran.append(more) or part)
    monkeypatch.setattr(_evidence, "_add_drawn", lambda _, names: ran.append(names))
    under: Any = SimpleNamespace(robot=Robot.preset(), order="sequential", block=None)
    plants: Any = [SimpleNamespace(name="own", thing=1)] * own
    asked = make_requirements({"sim": sim, "require": {"sim.slack_s": {"max": 0.1} if slack else False}})
    found = _evidence.gather(under, [], asked, observer=None, progress=lambda *_: None, families={}, own=plants,
                             attempt=3)  # fmt: skip
    assert found.foreign is not (own or drawn or bool(sim))
    simulated = own or not drawn
    assert (found.necks, found.crossings) == ((["run"], ["crossing"]) if simulated else ([], []))
    # Every family's draws, at this attempt; all that they tell decides, and what was judged elsewhere is said.
    assert found.drawn == [part] * (2 if drawn else 0)
    assert [item["attempt"] for item in ran if "attempt" in item] == [3] * len(found.drawn)
    assert ran[-1] == ({"sim.rise_s"} if drawn else set())
    assert found.not_computed["payload 2 kg"] == "judged at 1 kg"
    # Slack is of tendons: where nobody asks for it, nothing is missing.
    assert ("sim.slack_s" in found.not_computed) is (drawn and slack)


def test_further_values_of_a_metric_are_appended_each_with_its_own_facts() -> None:
    evidence: Any = SimpleNamespace(metrics={})
    for start in (0, 2, 5):
        _evidence._add(evidence, "m", Values(np.arange(start, start + 2.0), lambda row, s=start: {"row": s + row}))
    found = evidence.metrics["m"]
    assert found.values.tolist() == [0.0, 1.0, 2.0, 3.0, 5.0, 6.0]
    assert [found.describe(row)["row"] for row in range(6)] == [0, 1, 2, 3, 5, 6]


def test_the_worst_plant_of_each_requirement_is_written_as_what_it_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    written: list[Any] = []
    monkeypatch.setattr(_verify, "write_linear", lambda *args, **more: written.append((args, more)) or Path("linear"))
    monkeypatch.setattr(_verify, "write_neck", lambda *args, **more: written.append((args, more)) or Path("neck"))
    item = Requirement("axes.gain_margin", "min", 2.0, True)
    line = {"kind": "linear", "name": "b: n", "numerator": [1], "denominator": [2], "delay_samples": [3],
            "cross": [0.1], "sample_time_s": TS}  # fmt: skip

    worst = [{**line, "axis": "roll"}, {**line, "axis": "both"}, {"kind": "neck", "name": "k"}, {"kind": "draw"}, {}]
    verdicts = [Verdict(item, 1.0, False, one) for one in worst]
    under: Any = SimpleNamespace(robot=Robot.preset(), block="block")
    evidence: Any = None
    necks: Any = [SimpleNamespace(name="a", weights="W"), SimpleNamespace(name="b", weights="V")]
    found = Verification(verdicts=verdicts, evidence=evidence, controller=under, necks=necks, observer=True,
                         requirements=make_requirements({}))  # fmt: skip
    files = found.write_worst("to", controller="c.npz", observer="o.npz", force=True)
    assert files == {0: Path("linear"), 1: Path("linear"), 2: Path("neck")}
    assert [args[2]["axis"] for args, _ in written[:2]] == [1, 0]
    assert written[0][0][:2] == (Path("to"), "axes_gain_margin")
    assert (written[0][1]["weights"], written[0][1]["controller"], written[0][1]["force"]) == ("V", Path("c.npz"), True)
    assert written[2][0][2:] == ({"kind": "neck", "name": "k"}, Path("c.npz"), Path("o.npz"))
    found.write_worst("to", controller="c.npz")
    assert written[-1][0][-1] is None

    def full(folder: Path, name: str, *_args: Any, **_more: Any) -> Path:
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.py").write_text("a plant without its loop")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # On a full disk files of others stay, and what the call began is removed.
    monkeypatch.setattr(_verify, "write_linear", full)
    for known in ([], ["mine.toml"]):
        for name in known:
            (tmp_path / "full").mkdir()
            (tmp_path / "full" / name).write_text("")
        with pytest.raises(OSError, match="No space left"):
            found.write_worst(tmp_path / "full", controller="c.npz")
        assert [path.name for path in tmp_path.rglob("*")] == (["full", *known] if known else [])


# -- controllers, plants and their conditions -------------------------------------------------------------------------


def _controller(**more: Any) -> Any:
    block = SimpleNamespace(role="controller", kind="own", sample_time=TS)
    return SimpleNamespace(block=lambda: block, robot=Robot.preset(), **more)


@pytest.mark.parametrize(
    ("designed", "asked", "design", "observer", "extra"),
    [
        ("sequential", None, {}, True, 0), ("jacobi", "sequential", {"extra_delay": 5}, False, 0),
        ("jacobi", None, {"extra_delay": 5}, False, 5), ("jacobi", "jacobi", {}, False, 1),
        ("jacobi", None, {}, True, 2), ("sequential", "jacobi", {"extra_delay": 5}, True, 2),
    ],
)  # fmt: skip
def test_the_delay_that_an_order_adds_is_the_design_s_or_a_sample_for_each_part(
    designed: str, asked: str | None, design: dict[str, int], observer: bool, extra: int
) -> None:
    found = _linear.controller_under_test(_controller(order=designed, design=design), order=asked, observer=observer)
    assert (found.extra, found.order) == (extra, asked or designed)
    assert found.laws == {}
    assert "own has no linear form" in found.why


def test_a_controller_is_linear_by_its_form() -> None:
    form = CONTROLLER().ss()
    for name in ("ss", "to_lti"):
        assert list(_linear._laws(_controller(**{name: lambda: form}))[0]) == [""]
    laws, why = _linear._laws(_controller())
    assert (laws, "no linear form" in why) == ({}, True)
    for wrong in (SimpleNamespace(), SimpleNamespace(block=lambda: SimpleNamespace(role="plant", kind="p"))):
        with pytest.raises(SettingsError, match="a controller is needed"):
            _linear.controller_under_test(wrong, order=None, observer=False)


def test_the_radius_of_a_loop_is_that_of_its_slowest_pole() -> None:
    plants = all_plants([source_of_family(family(), "f")], 30, 0)
    law = LinearLaw.of(CONTROLLER().ss(), Robot.preset())
    expected = np.abs(_linear.closed_poles(plants, law)).max(axis=1)
    np.testing.assert_array_equal(margins(plants, law)["stability.radius"], expected)
    assert (expected > np.abs(_linear.closed_poles(plants, law)).min(axis=1)).all()


def test_samples_that_a_family_did_not_use_are_no_plants() -> None:
    whole = family()
    axis = replace(whole.axes["roll"], used=np.array([1.0, 0.0, 0.6, 0.5, 1.0, 0.0]))
    source = source_of_family(replace(whole, axes={**whole.axes, "roll": axis}), "f")
    np.testing.assert_array_equal(source.axes[1].samples, whole.axes["roll"].samples[[0, 2, 4]])
    assert source.axes[1].std is not None
    assert source.axes[1].std.shape == (3, 3)
    assert source.axes[0].samples.shape == (6, 3)
    none = replace(whole, axes={**whole.axes, "roll": replace(axis, used=np.zeros(6))})
    with pytest.raises(SettingsError, match="f: the family has no samples of roll"):
        source_of_family(none, "f")


@pytest.mark.parametrize("payload", ["inputs", ""])
def test_margins_by_experiment_are_of_each_axis_lightly_loaded_and_of_all_with_the_heaviest(payload: str) -> None:
    plant: Any = SimpleNamespace(name="own", payload=payload, payloads=lambda kg: sorted(kg) if payload else [0.0],
                                 quiet=lambda ts: ("quiet", ts), carrying=lambda kg: {"kg": kg})  # fmt: skip
    asked = make_requirements({"sim": {"payloads_kg": [0.5, 0.0, 1.0]}})
    block: Any = SimpleNamespace(sample_time=TS)
    loops = _neck_loops.loops_under_test(block, [plant], asked, order="parallel", observer=None)
    told = [(loop.name, loop.axes, loop.constants) for loop in loops]
    light = ("own, 0 kg" if payload else "own", ("pitch", "roll", "both"), {"kg": 0.0})
    assert told == ([light, ("own, 1 kg", ("both",), {"kg": 1.0})] if payload else [light])
    assert all((loop.order, loop.plant()) == ("parallel", ("quiet", TS)) for loop in loops)


def test_each_loop_has_a_payload_a_direction_and_a_noise_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked and judged: payloads and directions as they stand in the table, the size in both shares."""
    monkeypatch.setattr(_neck_loops, "step_loop", lambda *args, **more: (args, more))
    monkeypatch.setattr(_neck_loops, "judge_loop", lambda loop: ({"rise_s": 1.0}, loop))
    plant: Any = SimpleNamespace(name="own", payload="inputs", parameters=None, payloads=lambda kg: sorted(kg),
                                 make=lambda seed, ts: (seed, ts))  # fmt: skip
    asked = make_requirements({"sim": {"payloads_kg": [0.5, 0.0], "orientations_deg": [0.0, 90.0], "size_deg": 10.0}})
    block: Any = SimpleNamespace(sample_time=TS, parameters=())
    shares: list[float] = []
    runs = _neck_loops.run_loops(block, asked, order="sequential", observer=None, seed=40,
                                 progress=lambda share, _: shares.append(share), own=[plant])  # fmt: skip
    told = [(run.name, run.payload, round(math.degrees(run.orientation)), run.seed) for run in runs]
    assert told == [("own, 0 kg, 0 deg", 0.0, 0, 40), ("own, 0 kg, 90 deg", 0.0, 90, 41),
                    ("own, 0.5 kg, 0 deg", 0.5, 0, 42), ("own, 0.5 kg, 90 deg", 0.5, 90, 43)]  # fmt: skip
    results: list[Any] = [run.result for run in runs]
    assert [args[1] for args, _ in results] == [(seed, TS) for seed in (40, 41, 42, 43)]
    ends = [args[4].values for args, _ in results[:2]]
    size = math.radians(10.0)
    assert ends == [pytest.approx((size, 0.0), abs=1e-12), pytest.approx((0.0, size), abs=1e-12)]
    assert [more["duration"] for _, more in results] == [5.5] * 4
    assert shares == [0.0, 0.25, 0.5, 0.75]


def test_what_steps_is_a_simulation_model_and_what_has_a_linear_form_is_none() -> None:
    form = SimpleNamespace(tf=lambda name: name, robot=Robot.preset(), block=None)

    def fails(name: str) -> Any:
        raise SettingsError(name)

    nonlinear = SimpleNamespace(tf=fails, robot=Robot.preset(), block=None)
    found = [
        _neck_loops.is_simulation_model(thing)
        for thing in (
            form,
            nonlinear,
            SimpleNamespace(tf=fails, robot=Robot.preset()),
            SimpleNamespace(block=None),
            int,
            5,
        )
    ]
    assert found == [False, True, False, True, True, False]


def test_a_robot_without_a_virtual_plant_says_why_unless_one_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> Any:
        raise SettingsError("no tendons")

    monkeypatch.setattr(_neck_loops, "virtual_plant", fails)
    neck, arm = Robot.preset(), Robot.preset("arm")
    quiet = make_requirements({"sim": {"necks": 0}}, robot=arm)
    assert "switched off" in _neck_loops.why_no_virtual_plant(arm, quiet)
    bare = replace(arm, neck=None)
    assert "no virtual plant stands for" in _neck_loops.why_no_virtual_plant(bare, make_requirements({}, robot=bare))
    for robot, table in ((neck, {}), (bare, {"sim": {"preset": "paper"}})):
        with pytest.raises(SettingsError, match="no tendons"):
            _neck_loops.why_no_virtual_plant(robot, make_requirements(table, robot=robot))
    plant: Any = SimpleNamespace(robot=neck, parameters=SimpleNamespace(sample=lambda *_, **__: None))
    monkeypatch.setattr(_neck_loops, "VirtualNeck", fails)
    with pytest.raises(SettingsError, match="no random neck within a spread of"):
        _neck_loops._sample_neck(plant, np.random.default_rng(0), 0.1)


@pytest.mark.parametrize("what", ["gain_up", "gain_down", "delay"])
@pytest.mark.parametrize("sparse", [True, False])
def test_a_scan_begins_where_nothing_is_raised_and_ends_at_its_first_oscillation(what: str, sparse: bool) -> None:
    none, unit = (0.0, 3 * TS) if what == "delay" else (1.0, 1.0)
    tried: list[float] = []

    class Case:
        def __init__(self, ends: float) -> None:
            self.what, self.ends, self.sample_time = what, ends, TS
            self.loop = SimpleNamespace(samples=3)

        def oscillates(self, value: float, floor: float) -> bool:
            assert floor == 0.5
            tried.append(value)
            return value >= self.ends

    def crossing(ends: float, least: float = math.inf) -> float:
        tried.clear()
        return _experiments._first_crossing(Case(ends), 0.5, least, sparse)  # pyright: ignore[reportArgumentType]

    # Below the first scanned value: none is calm but no change at all.
    down = 2.0 ** (0.5 if sparse or what == "gain_down" else 0.25)
    first = (2.0 if sparse else 1.0) * unit if what == "delay" else down
    assert crossing(none) == none
    assert tried[0] == pytest.approx(first)
    ends = 2.5 * unit if what == "delay" else 2.6
    # 0.5 % of the bisection.
    assert crossing(ends) == pytest.approx(ends, rel=0.006)
    assert crossing(99.0) == math.inf
    last = 32.0 * unit if what == "delay" else 4.0 if what == "gain_down" else 16.0
    assert max(tried) == pytest.approx(last)
    # An earlier crossing ends a scan: there and not beyond.
    bound = 2.2 * unit if what == "delay" else 2.2
    assert crossing(99.0, bound) == math.inf
    assert max(tried) == bound


@pytest.mark.parametrize("what", ["gain_up", "gain_down", "delay"])
def test_a_scan_is_made_of_every_posture_and_step_and_ends_where_an_earlier_one_does(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans: list[tuple[tuple[float, ...], float, float]] = []
    values = iter([8.0, 9.0, 3.0, math.inf, 5.0, 4.0])

    def first(case: Any, floor: float, least: float, *_: Any) -> float:
        scans.append((case.posture, case.amplitude, least))
        return next(values)

    monkeypatch.setattr(_experiments, "_first_crossing", first)
    monkeypatch.setattr(_experiments.Experiment, "floor", lambda _: 0.0)
    loop = _experiments.LoopUnderTest(name="p", plant=lambda: None, controller=CONTROLLER().block(), size=2.0)  # pyright: ignore[reportArgumentType]
    found = _experiments._scan_group(loop, "both", what, math.inf)
    postures = loop.postures()[: 1 if what == "gain_down" else 3]
    assert len(set(loop.postures())) == 3
    assert [scan[:2] for scan in scans] == [
        (tuple(2.0 * angle for angle in lean), kick) for lean in postures for kick in loop.kicks
    ]
    assert len(set(loop.kicks)) == 2
    assert [scan[2] for scan in scans] == [math.inf, 8.0, 8.0, 3.0, 3.0, 3.0][: len(scans)]
    assert [item.value for item in found] == [8.0, 9.0, 3.0, math.inf, 5.0, 4.0][: len(scans)]


# -- margins ----------------------------------------------------------------------------------------------------------


def test_a_loop_whose_radius_is_no_number_has_no_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    plants = nominal_plants([source_of_family(family(), "f")])[0].take(np.array([0, 0, 0]))
    law = LinearLaw.of(CONTROLLER().ss(), Robot.preset())
    poles = _linear.closed_poles(plants, law).astype(complex)
    poles[1, -1], poles[2, -1] = math.nan, 1.0
    monkeypatch.setattr(_linear, "closed_poles", lambda *_: poles)
    for name, values in margins(plants, law).items():
        last = name.partition(".")[2]
        if last in (*LARGE, *SMALL):
            none = math.inf if last in SMALL else 1.0 if last == "gain_margin" else 0.0
            assert values[1] == values[2] == none
            assert is_worse(name, values[1], values[0]), name


def test_margins_by_experiment_are_those_of_their_axes() -> None:
    def crossing(axes: str, what: str, value: float) -> Crossing:
        return Crossing("p", axes, what, 0.1, (0.0, 0.0), value, 0.0)

    found = [
        crossing("pitch", "gain_up", 3.0), crossing("roll", "gain_up", 2.5), crossing("both", "gain_down", 4.0),
        crossing("pitch", "gain_down", 5.0), crossing("roll", "delay", 0.2), crossing("both", "delay", 0.1),
    ]  # fmt: skip
    table = {name: sorted(values.tolist()) for name, (values, _) in crossing_values(found).items()}
    assert table == {
        "pitch.gain_margin": [3.0, 5.0], "roll.gain_margin": [2.5], "axes.gain_margin": [2.5, 3.0, 4.0, 5.0],
        "roll.delay_margin_ms": [200.0], "axes.delay_margin_ms": [100.0, 200.0],
    }  # fmt: skip
    assert all(
        [item.value * (1e3 if "delay" in name else 1.0) for item in items] == values.tolist()
        for name, (values, items) in crossing_values(found).items()
    )


def test_mu_is_the_largest_bound_and_the_searched_radius_the_largest_met(monkeypatch: pytest.MonkeyPatch) -> None:
    check_worst("robust.mu", lambda v: StructuredResult("pitch", np.arange(1.0, len(v) + 1), np.array(v)).mu)
    source = source_of_family(family(), "f")
    law = LinearLaw.of(CONTROLLER().ss(), Robot.preset())

    def of(values: Any) -> float:
        sizes = iter(values)
        task = _Task(source, 0, (0,), law, 0)
        peaks: Any = SimpleNamespace(difference=np.ones((1, 2)))
        monkeypatch.setattr(_structured, "loops_of", lambda *_, **__: (peaks, np.array([next(sizes)])))
        for _ in values:
            task.badness(np.full((3, 1), 0.5))
        return task.radius

    check_worst("stability.radius", of)


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1)])
def test_a_search_goes_for_the_worst_of_its_axes_and_for_unstable_loops_first(
    axes: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    peaks: Any = SimpleNamespace(
        difference=np.array([[2.0, 5.0], [7.0, 3.0], [math.inf] * 2, [math.nan] * 2, [1.0, 1.0]])
    )
    radius = np.array([0.9, 0.8, 0.99, 0.7, 1.2])
    monkeypatch.setattr(_structured, "loops_of", lambda *_, **__: (peaks, radius))
    task = _Task(source_of_family(family(), "f"), 0, axes, LinearLaw.of(CONTROLLER().ss(), Robot.preset()), 0)
    found = task.badness(np.full((3 * len(axes), 5), 0.5))
    assert found[:2].tolist() == {(0,): [-2.0, -7.0], (1,): [-5.0, -3.0], (0, 1): [-5.0, -7.0]}[axes]
    assert found[4] < found[3] == found[2] == -1e3
    assert task.radius == 1.2


def test_a_gain_margin_is_the_smaller_of_both_directions_of_each_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    ones = np.ones((3, 2))
    made: Any = SimpleNamespace(
        gain=np.array([[3.0, 4.0], [1.5, math.inf], [math.inf, 9.0]]),
        gain_down=np.array([[0.5, 0.0], [0.5, 0.2], [0.0, 0.125]]), more=np.ones((3, 3)),
        **dict.fromkeys(("sensitivity", "complementary", "difference", "phase", "delay"), ones),
    )  # fmt: skip
    monkeypatch.setattr(_linear, "loops_of", lambda *_: (made, np.zeros(3)))
    plants = nominal_plants([source_of_family(family(), "f")])[0].take(np.array([0, 0, 0]))
    found = margins(plants, LinearLaw.of(CONTROLLER().ss(), Robot.preset()))
    assert found["pitch.gain_margin"].tolist() == [2.0, 1.5, math.inf]
    assert found["roll.gain_margin"].tolist() == [4.0, 5.0, 8.0]


def test_an_oscillation_is_the_largest_of_all_outputs() -> None:
    y = np.array([0.0, 1.0, 0.2, 0.9, 0.1])
    assert _experiments._oscillation(y, 10.0) == pytest.approx(0.9)
    # Creep is none, and a motion beyond the limit counts in full.
    assert _experiments._oscillation(np.arange(5.0), 10.0) == 0.0
    assert _experiments._oscillation(np.arange(5.0), 4.0) == 4.0
    assert math.isnan(_experiments._oscillation(np.array([0.0, math.nan]), 1.0))


def test_limits_of_a_robot_follow_its_smallest_output_and_its_order_changes_nothing() -> None:
    def size(*nominal: float) -> float:
        robot = Robot.from_dict({
            "name": "stage", "motors": {"names": ["a", "b"], "unit": "V", "nominal": 5.0, "setpoint_min": 0.0,
                                        "setpoint_max": 10.0},
            "outputs": {"names": ["x", "y"], "unit": "mm", "nominal": list(nominal)},
            "directions": {"kind": "matrix", "matrix": [[1.0, 0.0], [0.0, 1.0]]}, "time_constant_s": 0.2,
        })  # fmt: skip
        return Scale.of(robot).size

    assert size(2.0, 8.0) == size(8.0, 2.0) == size(2.0, 2.0) < size(8.0, 8.0)
