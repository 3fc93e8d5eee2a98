"""`choose`: ranking by free run, the simplest of those alike, failures that are told, remarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import Choice, Play, choose, refit
from softneck.identification.selection._auto import ALIKE, REFITTED, kinds_to_try

from ...data import neck_recording, slow_but

TRAIN, OTHER = neck_recording(900), neck_recording(500, seed=12)


@pytest.fixture(scope="module")
def choice() -> Choice:
    return choose(TRAIN, OTHER, kinds=("play", "rls", "nn", "residual", "ensemble"), other_excitation=True)


@pytest.mark.slow
def test_the_ranking_is_by_free_run_and_the_simplest_of_those_alike_is_chosen(choice: Choice) -> None:
    fits = [one.fit for one in choice.ranking]
    assert fits == sorted(fits, reverse=True)
    # The recording is that of a linear neck: nothing is much better than `rls`, and nothing is simpler.
    assert choice.chosen.kind == "rls"
    assert choice.chosen.fit > fits[0] - ALIKE
    assert "the simplest is taken" in choice.why or choice.ranking[0] is choice.chosen


@pytest.mark.slow
def test_a_kind_that_fails_is_listed_with_its_reason_and_costs_nothing_else(choice: Choice) -> None:
    failed = {one.kind: one for one in choice.ranking if one.model is None}
    assert set(failed) == {"nn"}
    assert "rows are fewer than the network's 951 weights" in failed["nn"].failure
    assert any("Not identified or diverged: nn" in remark for remark in choice.remarks)


@pytest.mark.slow
def test_the_residual_is_on_the_best_and_the_ensemble_of_the_others(choice: Choice) -> None:
    models = {one.kind: one.model for one in choice.ranking if one.model is not None}
    best = max((one for one in choice.ranking if one.kind in ("rls", "play")), key=lambda one: one.fit)
    assert models["residual"].settings["base"] == best.kind
    assert sorted(models["ensemble"].settings["members"]) == ["play", "rls"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds",
    slow_but([("play",), ("rls", "residual"), ("rls", "play", "ensemble")], [("play",)]),
)
def test_a_refit_is_the_chosen_kind_on_all_rows_and_keeps_the_scores_of_before(kinds: tuple[str, ...]) -> None:
    found = choose(TRAIN, OTHER, kinds=kinds, other_excitation=True)
    last = next(one for one in found.ranking if one.kind == kinds[-1])
    again = refit(replace(found, chosen=last), [TRAIN, OTHER])
    assert again.kind == kinds[-1]
    assert again.training_rows.size == len(TRAIN) + len(OTHER)
    assert again.findings["refit"] == {"hold_out_fit_before": last.fit, "remark": REFITTED}
    alone = Play().fit([TRAIN, OTHER])
    if kinds == ("play",):
        assert all(again.arrays[name].tobytes() == alone.arrays[name].tobytes() for name in alone.arrays)


@pytest.mark.slow
def test_rows_held_out_were_never_trained_on(choice: Choice) -> None:
    assert all(one.judged.rows_left_out == 0 for one in choice.ranking if one.judged is not None)


def test_a_hold_out_of_the_same_excitation_and_a_hopeless_one_are_remarked() -> None:
    head, tail = TRAIN.split(0.7)
    same = choose(head, tail, kinds=("rls",))
    assert "of the excitation that was trained on" in same.remarks[0]
    rng = np.random.default_rng(0)
    noise = OTHER.with_channels(pitch=0.1 * rng.standard_normal(500), roll=0.1 * rng.standard_normal(500))
    lost = choose(TRAIN, noise, kinds=("rls", "play"), other_excitation=True)
    assert any("No kind reaches 70 %" in remark for remark in lost.remarks)


def test_nothing_to_try_and_nothing_that_works_are_errors() -> None:
    assert {"rls", "play", "nn", "greybox", "residual", "ensemble"} <= set(kinds_to_try())
    with pytest.raises(SettingsError, match="`magic` cannot be tried"):
        choose(TRAIN, OTHER, kinds=("magic",))
    with pytest.raises(DataError, match=r"no kind could be identified: .*at least 100 are needed"):
        choose(TRAIN.rows(0, 60), OTHER, kinds=("rls", "play"))
