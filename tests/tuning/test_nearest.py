"""Defaults that no candidate keeps: which of them the result may hold all but."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.cli._tune import _why
from softneck.loop.default_limits import NECK_RISE_S
from softneck.report._tune import _verdict_rows, failing_requirement, requirement_rows, tune_verdict
from softneck.tuning import _compare
from softneck.tuning._compare import Loosened, relaxations
from softneck.tuning._requirements import TuneRequirements, make_tune_requirements, relax_limits
from softneck.tuning._search import Candidate
from softneck.verification._decision import verdict_values
from softneck.verification._requirements import Requirement
from softneck.verification._verify import Verdict

ASKED = make_tune_requirements({})


def bound(metric: str, asked: TuneRequirements = ASKED) -> Requirement:
    return next(item for item in asked.bounds if item.metric == metric)


def failed(metric: str, value: float | None, asked: TuneRequirements = ASKED) -> Verdict:
    return Verdict(bound(metric, asked), value, False, {})


def told(failing: list[Verdict]) -> Any:
    """Return a verification that no draws were run for."""
    return SimpleNamespace(failed=failing, evidence=SimpleNamespace(drawn=[]))


def candidate(**metrics: float) -> Candidate:
    named = {name.replace("__", "."): value for name, value in metrics.items()}
    return Candidate("pi", {}, np.zeros(1), "all", named)


def test_a_slower_rise_than_the_default_is_told_and_certified_with_some_room() -> None:
    found = relaxations(candidate(), [failed("sim.rise_s", 0.6)], ASKED)
    assert list(found) == ["sim.rise_s"]
    assert (found["sim.rise_s"].default, found["sim.rise_s"].reached) == (NECK_RISE_S, 0.6)
    assert 0.6 < found["sim.rise_s"].limit <= 0.6 * 1.05 + 0.01  # the room, up to the next hundredth
    asked = relax_limits(ASKED, {"sim.rise_s": found["sim.rise_s"].limit})
    assert asked.limit("sim.rise_s") == found["sim.rise_s"].limit
    assert [b for b in asked.bounds if b.metric != "sim.rise_s"] == [
        b for b in ASKED.bounds if b.metric != "sim.rise_s"
    ]
    # A file of it asks for the same.
    again = make_tune_requirements({key: value for key, value in asked.table.items() if key != "version"})
    assert again.bounds == asked.bounds


@pytest.mark.parametrize("metric", ["sim.overshoot_pct", "sim.steady_rms_deg", "sim.settling_s", "track.ahead_rms_deg"])
def test_a_relaxed_limit_keeps_its_reserve_and_a_file_of_it_asks_for_the_same(metric: str) -> None:
    limit = 1.5 * bound(metric).limit
    asked = relax_limits(ASKED, {metric: limit})
    assert asked.limit(metric) == limit
    assert (asked.robot_limit(metric) or 0.0) - limit == pytest.approx(ASKED.reserve.get(metric, 0.0), abs=1e-9)
    again = make_tune_requirements({key: value for key, value in asked.table.items() if key != "version"})
    assert again.limit(metric) == pytest.approx(limit, rel=1e-9)  # a file has 12 digits
    assert [(b.metric, b.bound) for b in again.bounds] == [(b.metric, b.bound) for b in asked.bounds]
    assert again.certificate.sim["duration_s"] == asked.certificate.sim["duration_s"]
    assert asked.certificate.bounds == tuple(b for b in asked.bounds if not b.metric.startswith("track."))


def test_the_worse_of_the_loops_with_noise_and_of_verify_counts() -> None:
    found = relaxations(candidate(sim__rise_s=0.7), [failed("sim.rise_s", 0.6)], ASKED)
    assert found["sim.rise_s"].reached == 0.7
    assert relaxations(candidate(sim__rise_s=0.6), [failed("sim.rise_s", 0.7)], ASKED) == found
    assert list(relaxations(candidate(track__ahead_rms_deg=1.7), [], ASKED)) == ["track.ahead_rms_deg"]
    assert relaxations(candidate(sim__rise_s=0.7), [], ASKED) == found


@pytest.mark.parametrize(
    ("metric", "value"),
    [("axes.gain_margin", 1.9), ("robust.mu", 1.01), ("stability.radius", 1.0), ("sim.rise_s", 1.0),
     ("sim.rise_s", float("inf")), ("sim.rise_s", None), ("step.load_rms_deg", 2.1)],
)  # fmt: skip
def test_margins_loads_and_what_is_far_off_are_never_loosened(metric: str, value: float | None) -> None:
    assert relaxations(candidate(), [failed(metric, value)], ASKED) == {}
    # Nor is anything beside them.
    assert relaxations(candidate(), [failed("sim.settling_s", 2.6), failed(metric, value)], ASKED) == {}


def test_what_somebody_asks_for_stands() -> None:
    asked = make_tune_requirements({"require": {"sim.rise_s": {"max": 0.4}}})
    assert relaxations(candidate(), [failed("sim.rise_s", 0.44, asked)], asked) == {}
    assert relaxations(candidate(), [failed("sim.rise_s", 0.6)], replace(ASKED, stated=frozenset())) != {}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"track.circle_rms_deg": 3.7, "step.rise_s": 0.5}, "Only track.circle_rms_deg fails: 3.7, required <= 3."),
        (
            {"track.circle_rms_deg": 2.7, "step.rise_s": 0.7},
            "pi fails step.rise_s. Another candidate fails track.circle_rms_deg alone: 3.7, required <= 3.",
        ),
    ],
)
def test_what_fails_is_said_of_the_controller_that_is_written(values: dict[str, float], said: str) -> None:
    bounds = [
        Requirement(name, "max", limit, asked=False)
        for name, limit in (("track.circle_rms_deg", 3.0), ("step.rise_s", 0.55))
    ]
    best = Candidate(kind="pi", settings={}, x=np.zeros(0), metrics=values)
    found: Any = SimpleNamespace(
        holds=False, best=best, binding="track.circle_rms_deg", nearest=3.7, verification=told([]),
        task=SimpleNamespace(bounds=bounds, tested=False, asked=SimpleNamespace(bounds=bounds)),
    )  # fmt: skip
    assert failing_requirement(found) == said


@pytest.mark.parametrize("binding", [None, "step.rise_s"])
@pytest.mark.parametrize("nearest", [None, 0.52])
def test_what_was_not_computed_is_said_first_and_no_limit_is_said_to_make_it_hold(
    binding: str | None, nearest: float | None
) -> None:
    """`adaptive` was picked with all its margins "-", and `tune` ended "at 0.52 all the rest would hold"."""
    why, off = "not computed: no linear form", "not computed: switched off"
    unknown = [replace(failed(name, None), note=note) for name, note in
               (("axes.gain_margin", why), ("stability.searched_radius", off), ("robust.mu", why))]  # fmt: skip
    bounds = [bound("step.load_rms_deg"), *(item.requirement for item in unknown)]
    best = Candidate("adaptive", {}, np.zeros(0), "all", {"step.load_rms_deg": 0.5, "step.rise_s": 0.52})
    found: Any = SimpleNamespace(
        holds=False, best=best, binding=binding, nearest=nearest, evaluations=6,
        verification=told([failed("step.load_rms_deg", 3.0), *unknown]),
        task=SimpleNamespace(bounds=bounds, tested=False, asked=SimpleNamespace(bounds=bounds)),
    )  # fmt: skip
    said = failing_requirement(found)
    assert said == (
        f"axes.gain_margin, robust.mu of adaptive: {why}; stability.searched_radius of adaptive: {off}."
        + (" step.rise_s fails." if binding else "")
    )
    assert "0.52" not in said
    advice = _why(found, Path("out"))
    assert said in advice
    assert "oosen" not in advice
    assert advice.endswith("name kinds with a linear form in --kinds, such as pi or lqg.")
    found.verification.failed = unknown[1:2]
    assert "give what is missing, or leave the requirement out" in _why(found, Path("out"))


def test_a_result_holds_nothing_that_its_certificate_has_not() -> None:
    """In rows of the table, of the JSON and of the decision no None, NaN and infinite value counts as holding."""
    values = (None, math.nan, math.inf, 0.5)
    rows = [Verdict(bound("step.load_rms_deg"), value, value == 0.5, {}, "") for value in values]
    best = Candidate("pi", {}, np.zeros(0), "all", {"step.load_rms_deg": 0.5})
    asked = SimpleNamespace(bounds=[bound("track.ahead_rms_deg")])
    found: Any = SimpleNamespace(
        verification=SimpleNamespace(verdicts=rows), best=best, task=SimpleNamespace(asked=asked, own={"p": 1})
    )
    assert [row[4] for row in requirement_rows(found)] == ["not computed", "fails", "fails", "holds", "not computed"]
    told = verdict_values(_verdict_rows(found))
    assert (told["requirements"], len(told["failed"])) == (5, 4)
    assert [row["value"] for row in told["failed"]] == [None] * 4
    # A circle that was not simulated fails where there is a model, and decides nothing where there is none.
    for circle, own, held in ((None, {"p": 1}, False), (None, {}, None), (math.nan, {"p": 1}, False),
                              (math.inf, {"p": 1}, False), (1.4, {"p": 1}, True), (1.4, {}, True)):  # fmt: skip
        best.metrics |= {} if circle is None else {"track.ahead_rms_deg": circle}
        found.task.own = own
        assert _verdict_rows(found)[-1]["holds"] is held
    # Loops of tuning alone that are worse than those of `verify` count; of no number nothing is better.
    for metric, value, tuned, held in (("sim.rise_s", 0.4, 0.9, False), ("sim.rise_s", 0.4, math.inf, False),
                                       ("sim.rise_s", 0.4, math.nan, False), ("sim.rise_s", 0.4, 0.3, True),
                                       ("sim.rise_s", None, 0.3, None)):  # fmt: skip
        found.verification.verdicts = [Verdict(bound(metric), value, None if value is None else True, {}, "")]
        best.metrics[metric] = tuned
        assert _verdict_rows(found)[0]["holds"] is held, (value, tuned)


def test_what_was_not_computed_is_not_said_to_hold() -> None:
    known, open_ = failed("step.load_rms_deg", 0.5), replace(failed("sim.rise_s", None), holds=None)
    found: Any = SimpleNamespace(loosened={}, verification=SimpleNamespace(verdicts=[known, open_]))
    assert tune_verdict(found) == "All requirements that were computed hold; not computed: sim.rise_s."
    found.verification.verdicts = [known]
    assert tune_verdict(found) == "All requirements hold."


@given(st.floats(1e-6, 1e6))
def test_a_limit_that_is_told_is_above_what_was_reached_by_five_percent_in_two_digits(value: float) -> None:
    found, wanted = _compare._round_up(value), 1.05 * value
    digit = 10.0 ** (math.floor(math.log10(wanted)) - 1)
    assert wanted * (1.0 - 1e-9) <= found <= wanted + digit * (1.0 + 1e-6)
    assert found == pytest.approx(float(f"{found:.2g}"), rel=1e-11)
    # What another value of the same decade needs is never less for a larger one.
    assert _compare._round_up(1.01 * value) >= found * (1.0 - 1e-12)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_what_was_not_reached_has_no_limit(value: float) -> None:
    assert _compare._round_up(value) == math.inf


def test_the_limits_that_are_told_by_hand() -> None:
    # 1.05 of it, up to the next in two digits; one that is exact stays.
    rounded = [_compare._round_up(value) for value in (1.0, 0.1, 2.0, 0.96, 9.6, 95.0)]
    assert rounded == [1.1, 0.11, 2.1, 1.1, 11.0, 100.0]
    words = Loosened(0.4, 0.4444, 0.47).in_words("sim.rise_s")
    assert words == "sim.rise_s: 0.444, by default 0.4 is required (certified: 0.47)"


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["sim.rise_s", "step.rise_s"], ["sim.rise_s"]), (["step.rise_s"], ["step.rise_s"]),
        (["axes.gain_margin", "axes.sensitivity"], ["axes.sensitivity", "axes.gain_margin"]),
        (["step.load_rms_mm", "step.steady_rms_mm", "sim.steady_rms_mm"], ["step.load_rms_mm", "sim.steady_rms_mm"]),
        (["track.variation_bar_s", "track.circle_rms_deg", "step.overshoot_pct"],
         ["step.overshoot_pct", "track.circle_rms_deg", "track.variation_bar_s"]),
        (["sim.settling_s"], []), ([], []),
    ],
)  # fmt: skip
def test_a_front_is_over_the_first_metric_of_each_kind_that_all_have(given: list[str], named: list[str]) -> None:
    full: Any = SimpleNamespace(metrics=dict.fromkeys([*given, "sim.max_rad"], 1.0))
    more: Any = SimpleNamespace(metrics=dict.fromkeys([*given, "robust.mu"], 1.0))
    none: Any = SimpleNamespace(metrics={})
    assert _compare.objectives([full, more]) == _compare.objectives([more, full]) == named
    assert _compare.objectives([full, none]) == _compare.objectives([]) == []
