"""Certificates by loops over draws: one bad draw fails them, attempts are counted, and the linear test is shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.cli._verify import _attempt_of, _tried
from softneck.core import certificate_contents, write_certificate
from softneck.identification import Draws, Family
from softneck.identification.uncertainty import _draws
from softneck.verification import make_requirements, verify
from softneck.verification._drawn import certified_content
from softneck.verification._experiments import crossing_values, crossings
from softneck.verification._neck_loops import loops_under_test, make_simulation_model

from .necks import COUNT, QUICK, family, pi, small_draws

ASKED = {**QUICK, "sim": {**QUICK["sim"], "size_deg": 10.0}}


@pytest.fixture(scope="module")
def drawn() -> Draws:
    return small_draws()


def with_draws(draws: Draws, bad: int | None = None) -> Family:
    """The family with these draws; of the first certificate's the one of number `bad` has five times the gain."""
    if bad is not None:
        weights = draws.arrays["weights"].copy()
        weights[_draws.SEARCH_DRAWS + bad] *= 5.0
        draws = replace(draws, arrays={"weights": weights})
    return replace(family(spread=0.6), draws=draws)


@pytest.mark.parametrize(("share", "least"), [(0.95, 59), (0.99, 299)])
def test_as_many_draws_as_wilks_asks_for_are_needed(share: float, least: int) -> None:
    assert certified_content(least) >= share > certified_content(least - 1)
    # Each attempt has its part of the 5 %: the second says less than the first, by the same draws.
    assert certified_content(least, 2) < share


@pytest.mark.slow
def test_draws_decide_and_the_linear_test_is_shown_beside(drawn: Draws) -> None:
    found = verify(pi(), {"family": with_draws(drawn)}, make_requirements(ASKED))
    verdicts = {v.requirement.metric: v for v in found.verdicts}
    for name in ("axes.gain_margin", "axes.delay_margin_ms", "sim.overshoot_pct", "sim.load_rms_deg"):
        assert verdicts[name].worst["kind"] == "draw"
    assert verdicts["sim.load_rms_deg"].requirement.limit == verdicts["step.load_rms_deg"].requirement.limit
    beside = [v for v in found.verdicts if v.requirement.metric.startswith(("stability", "robust", "step", "mimo"))]
    for verdict in beside:  # a linear test that fails decides nothing
        assert verdict.value is not None
        assert verdict.holds is (True if verdict.requirement.holds(verdict.value) else None)
        assert ("the draws of the family decide" in verdict.note) is (verdict.holds is None)
    assert {verdict.holds for verdict in beside} == {True, None}
    [part] = found.evidence.drawn
    assert part.count == COUNT
    assert found.contents()["draws"][0]["content"] == certified_content(COUNT)
    # Stated requirements count, whatever decides.
    stated = {**ASKED, "require": {"axes.sensitivity": {"max": 1.01}}}
    assert [v.requirement.metric for v in verify(pi(), {"family": with_draws(drawn)}, stated).failed] == [
        "axes.sensitivity"
    ]


@pytest.mark.slow
def test_one_draw_that_fails_fails_the_certificate_and_another_attempt_has_others(drawn: Draws) -> None:
    plants = {"family": with_draws(drawn, bad=2)}
    found = verify(pi(), plants, make_requirements(ASKED))
    [part] = found.evidence.drawn
    assert part.failed == (2,)
    assert part.content == 0.0
    assert not found.holds
    assert f"1 of {COUNT} draws of family fail" in found.summary()
    again = verify(pi(), plants, make_requirements(ASKED), attempt=2)
    assert again.holds
    assert again.evidence.drawn[0].content == certified_content(COUNT, 2)


@pytest.mark.slow
def test_the_margin_of_equal_draws_is_that_by_the_scan_of_one(drawn: Draws) -> None:
    same = replace(drawn, arrays={"weights": np.repeat(drawn.arrays["weights"][:1], 8 + 2 * COUNT, axis=0)})
    asked = make_requirements(ASKED)
    [part] = verify(pi(), {"family": with_draws(same)}, asked).evidence.drawn
    one = make_simulation_model(same.for_search(1)[0], "one", asked.robot)
    loops = loops_under_test(pi().block(), [one], asked, order="sequential", observer=None)
    scanned = crossing_values(crossings(loops))
    # Both bisect to half a percent, at their own steps and postures; a linear plant has one margin at all of them.
    for name in ("axes.gain_margin", "axes.delay_margin_ms"):
        assert part.values[name].min() == pytest.approx(scanned[name][0].min(), rel=0.03)


@pytest.mark.slow
def test_steps_larger_than_any_recorded_motion_are_refused(drawn: Draws) -> None:
    small = replace(drawn, conditions={**drawn.conditions, "motion": [0.08, 0.09]})
    found = verify(pi(), {"family": with_draws(small)}, make_requirements(ASKED))
    notes = {v.requirement.metric: v.note for v in found.failed}
    assert "steps of 10 deg, the recordings move 4.58 deg; record larger motions" in notes["sim.overshoot_pct"]


def test_attempts_over_a_family_are_counted_from_the_certificates_of_a_folder(tmp_path: Path) -> None:
    def attempt(controller: str, family: str, name: str) -> tuple[int, list[str]]:
        files = {"controller": (f"{name}.npz", controller), "plant 1": ("f.npz", family)}
        this, tried = _attempt_of(files), _tried(tmp_path, [family])
        earlier = tried[: tried.index(this)] if this in tried else tried
        kept = {"requirements": [], "attempts": {"plants": [family], "tried": [*earlier, this]}}
        path = tmp_path / f"{name}.certificate.json"
        write_certificate(path, certificate_contents("verify", holds=False, files=files, more=kept), force=True)
        return len(earlier) + 1, [*earlier, this]

    assert attempt("a" * 64, "f" * 64, "one")[0] == 1
    assert attempt("b" * 64, "f" * 64, "two")[0] == 2
    # The same controller again is the same attempt; another family begins anew.
    assert attempt("a" * 64, "f" * 64, "one")[0] == 1
    assert attempt("b" * 64, "e" * 64, "other")[0] == 1
    # A certificate that replaces the only file of an earlier attempt still tells of it.
    assert attempt("c" * 64, "f" * 64, "two")[0] == 3
    assert attempt("d" * 64, "f" * 64, "two")[0] == 4
    (tmp_path / "note.json").write_text("{}", encoding="utf-8")
    assert attempt("d" * 64, "f" * 64, "two")[0] == 4
