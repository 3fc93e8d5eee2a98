"""`choose`: ranking by free run, the simplest of those alike, failures that are told, remarks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load, silent
from softneck.identification import Choice, Model, Network, OutputError, Play, Rls, SetMembership, choose
from softneck.identification.models._arrays import members
from softneck.identification.models._fitting import known_rows, row_hashes
from softneck.identification.models._left_out import agreement, exams, folds, weighted_median
from softneck.identification.selection import _auto
from softneck.identification.selection._auto import (
    ALIKE,
    COLD,
    EXAM,
    HOLD_OUT,
    KindTrial,
    _explain_choice,
    _explain_guarded,
    _Race,
    best_others,
    kinds_to_try,
    numbers_of,
)
from softneck.identification.uncertainty import _guarded
from softneck.identification.uncertainty._guarded import Base, Guarded
from softneck.signals import Recording, concatenate

from ...data import ROOT, neck_recording

TRAIN, OTHER = neck_recording(900), neck_recording(500, seed=12)


@pytest.fixture(scope="module")
def choice() -> Choice:
    return choose(TRAIN, OTHER, kinds=("play", "rls", "nn"), other_excitation=True)


@pytest.mark.slow
def test_the_ranking_is_by_free_run_and_the_simplest_of_those_alike_is_chosen(choice: Choice) -> None:
    fits = [one.fit for one in choice.ranking]
    assert fits == sorted(fits, reverse=True)
    # The recording is that of a linear neck: nothing is much better than `rls`, and nothing has fewer numbers.
    assert choice.chosen.kind == "rls"
    assert choice.chosen.fit > fits[0] - ALIKE
    assert "fewest parameters" in choice.why or choice.ranking[0] is choice.chosen


@pytest.mark.slow
def test_all_are_judged_by_what_was_left_out_and_the_best_of_each_form_is_trained_on_all(choice: Choice) -> None:
    ran = [one for one in choice.ranking if one.model is not None]
    # 900 rows are fewer than a screening takes: nothing follows them, and the other recording is left out as a whole.
    assert {"largest motions", "fastest motions", "other excitation"} <= set(choice.chosen.scores)
    # `rls` and `play` alone have no middle.
    assert all(EXAM not in one.scores for one in ran)
    assert [one.kind for one in ran if "trained on the other" in one.scores] != []
    # The chosen one, and the best of the other form: of linear kinds there is `rls` alone.
    whole = {one.kind for one in ran if one.whole}
    assert choice.chosen.kind in whole
    assert sorted(kind == "rls" for kind in whole) == [False, True]
    assert choice.chosen.model is not None
    assert choice.chosen.model.training_rows.size == len(TRAIN)
    assert set(choice.chosen.scores) >= {HOLD_OUT, COLD}
    assert choice.chosen.fit == min(choice.chosen.scores.values())
    assert all(0.0 < error < 20.0 for one in ran for error in one.errors.values())


@pytest.mark.slow
def test_a_kind_that_fails_is_listed_with_its_reason_and_costs_nothing_else(choice: Choice) -> None:
    failed = {one.kind: one for one in choice.ranking if one.model is None}
    assert set(failed) == {"nn"}
    assert "rows are fewer than the network's 951 weights" in failed["nn"].failure
    assert any("Not identified or diverged: nn" in remark for remark in choice.remarks)


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


def test_an_internal_error_of_one_kind_is_its_reason_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def fit(*_: object, **__: object) -> Model:
        raise IndexError("index 2 is out of bounds")

    monkeypatch.setattr(OutputError, "fit", fit)
    found = choose(TRAIN, OTHER, kinds=("rls", "oe"), other_excitation=True)
    assert found.chosen.kind == "rls"
    failed = {one.kind: one.failure for one in found.ranking if one.model is None}
    assert failed == {"oe": "IndexError: index 2 is out of bounds"}


@pytest.mark.parametrize(("held_out", "said"), [(92.0, False), (60.0, True), (float("nan"), True)])
def test_that_no_kind_is_good_is_said_of_the_rows_held_out_alone(held_out: float, said: bool) -> None:
    one = KindTrial("rls", 0.0, left_out={"largest motions": 40.0, HOLD_OUT: held_out})
    remarks = _auto._remarks((one,), other_excitation=True)
    assert any("No kind reaches 70 %" in remark for remark in remarks) is said


def test_nothing_to_try_and_nothing_that_works_are_errors() -> None:
    assert {"rls", "play", "nn", "greybox"} <= set(kinds_to_try())
    with pytest.raises(SettingsError, match="`magic` cannot be tried"):
        choose(TRAIN, OTHER, kinds=("magic",))
    with pytest.raises(DataError, match=r"no kind could be identified: .*at least 100 are needed"):
        choose(TRAIN.rows(0, 60), OTHER, kinds=("rls", "play"))
    still = TRAIN.with_channels(**{f"motor_setpoint_{j}": np.ones(len(TRAIN)) for j in (1, 2, 3)})
    with pytest.raises(DataError) as said:
        choose(still, OTHER, kinds=("rls", "oe", "play"))
    assert str(said.value).count("constant") == 1, "a reason that all share is said once"


def test_the_best_of_the_other_sort_ran_free() -> None:
    fits = {"rls": 80.0, "oe": 85.0, "play": 70.0, "nn": 75.0, "nlsm": float("-inf")}
    linear = load(ROOT / "tests" / "golden" / "oe.npz")
    trials = {
        kind: KindTrial(kind, 0.0, left_out={"hold-out": fit}, model=linear if kind in ("rls", "oe") else None)
        for kind, fit in fits.items()
    }
    ranking = list(trials.values())
    for chosen, sort, other in (("rls", "nonlinear", "nn"), ("play", "linear", "oe")):
        found = best_others(ranking, trials[chosen])
        assert {name: one.kind for name, one in found.items()} == {sort: other}
    assert best_others(ranking[:2], trials["rls"]) == {}
    assert best_others(ranking[-1:], trials["rls"]) == {}, "what diverged is no plant"


def test_what_a_fold_judges_is_missing_from_its_training_and_no_set_point_is() -> None:
    long = neck_recording(3000)
    (fold,) = folds(long, OTHER, other_excitation=False)
    assert [part.name for part in fold.judged] == ["largest motions", "fastest motions", "later block"]
    missing = np.asarray(np.isnan(fold.train.outputs).all(axis=1))
    for part in fold.judged[:2]:
        assert missing[part.rows].all()
        assert part.rows.mean() > 0.1
    far = np.linalg.norm(fold.train.set_points / fold.train.set_points.std(axis=0), axis=1)
    assert missing[np.argmax(far)]
    assert 0.2 < missing.mean() < 0.6
    np.testing.assert_array_equal(fold.train.set_points, long.set_points[: len(fold.train)])
    assert fold.judged[2].recording.time[0] > fold.train.time[-1]


def test_every_run_is_left_out_once_and_so_is_each_of_two_recordings() -> None:
    runs = [neck_recording(400, seed=seed) for seed in (1, 2, 3)]
    first, *others = folds(concatenate(runs), OTHER, other_excitation=True)
    assert first.judged[-1].name == "other excitation"
    left = [part.recording.outputs for fold in others[:-1] for part in fold.judged]
    np.testing.assert_array_equal(np.concatenate(left), concatenate(runs).outputs)
    for fold, run in zip(others[:-1], runs, strict=True):
        assert not known_rows(fold.train, row_hashes(run)).any()
    np.testing.assert_array_equal(others[-1].train.outputs, OTHER.outputs)


def test_the_exam_stays_within_the_trained_set_points_and_moves_as_fast() -> None:
    for motion in exams(TRAIN):
        U = motion.set_points
        assert (TRAIN.set_points.min(axis=0) <= U).all()
        assert (TRAIN.set_points.max(axis=0) >= U).all()
        assert (U.std(axis=0) > 0.5 * TRAIN.set_points.std(axis=0)).all()
    slow = Recording(5.0 * TRAIN.time, 5.0 * TRAIN.sample_time, TRAIN.channels)
    # Of a record that is five times slower the exam is the same row by row, as that is all that a model sees.
    np.testing.assert_allclose(exams(slow)[0].set_points, exams(TRAIN)[0].set_points, atol=1e-9)


def test_a_model_that_parts_from_the_others_where_nobody_measured_agrees_least() -> None:
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((400, 2))
    errors = {"a": 0.1, "b": 0.1, "c": 0.1, "lost": 1.0}
    runs = {name: [truth + size * rng.standard_normal(truth.shape)] for name, size in errors.items()}
    found = agreement(runs, {"a": 90.0, "b": 90.0, "c": 90.0, "lost": 99.0})
    # The one that is best on what was recorded weighs a hundred times as much as another: three do not outvote it.
    assert min(found, key=lambda name: found[name]) != "lost"
    found = agreement(runs, {"a": 90.0, "b": 90.0, "c": 90.0, "lost": 93.0})
    assert min(found, key=lambda name: found[name]) == "lost"
    # Independent errors of a tenth leave 90 %; the median, which errs less, has part in each.
    assert all(85.0 < found[name] < 97.0 for name in "abc")
    assert agreement({"a": runs["a"], "b": runs["b"]}, {"a": 90.0, "b": 90.0}) == {}


def test_what_diverges_agrees_with_nothing_and_an_output_at_rest_hides_no_other() -> None:
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((400, 2))
    runs = {name: [truth + 0.1 * rng.standard_normal(truth.shape) for _ in range(2)] for name in "abc"}
    worth = dict.fromkeys("abc", 90.0)
    whole = agreement(runs, worth)
    # The least of all motions counts, in whatever order they stand.
    poor = {**runs, "a": [runs["a"][0], runs["a"][1] + rng.standard_normal(truth.shape)]}
    assert agreement(poor, worth)["a"] < whole["a"] - 20.0
    assert agreement({name: free[::-1] for name, free in poor.items()}, worth) == agreement(poor, worth)
    for lost in (np.nan, np.inf):
        gone = runs["a"][1].copy()
        gone[3, 1] = lost
        found = agreement({**runs, "d": [runs["a"][0], gone]}, worth)
        assert found == {**whole, "d": float("-inf")}
    still = {name: [free * np.array([1.0, 0.0]) for free in each] for name, each in runs.items()}
    alone = {name: [free[:, :1] for free in each] for name, each in runs.items()}
    assert agreement(still, worth) == agreement(alone, worth)


def test_a_kind_is_worth_its_worst_test_and_no_fit_of_an_output_vanishes() -> None:
    one = KindTrial("rls", 0.0, left_out={"fast": 60.0, "large": 40.0, "later": 50.0})
    assert (one.fit, one.worst) == (40.0, "large")
    lost = replace(one, left_out={**one.left_out, "later": float("-inf")})
    assert (lost.fit, lost.worst) == (float("-inf"), "later")
    assert KindTrial("rls", 0.0).worst == ""
    assert _auto._mean({"pitch": 90.0, "roll": 60.0}) == 75.0
    for fits in ({"pitch": 90.0, "roll": None}, {"pitch": None, "roll": 90.0}, {"pitch": None}, {}):
        assert _auto._mean(fits) == float("-inf")


def test_a_kind_that_fails_without_a_part_is_infinitely_bad_there(monkeypatch: pytest.MonkeyPatch) -> None:
    part: Any = SimpleNamespace(name="excitation 1", fits=lambda _: ({"pitch": 80.0, "roll": 60.0}, 2.0))
    fold: Any = SimpleNamespace(train=TRAIN, judged=(part,))
    trying = _Race(TRAIN, OTHER, [fold], 0)
    trying.tried["rls"] = KindTrial("rls", 1.0, left_out={"fast": 90.0})
    monkeypatch.setattr(_Race, "_short", lambda *_: "model")
    trying._leave_out("rls", fold)
    assert trying.tried["rls"].left_out == {"fast": 90.0, "excitation 1": 70.0}

    def fails(*_: Any) -> Any:
        raise ValueError("singular")

    monkeypatch.setattr(_Race, "_short", fails)
    trying._leave_out("rls", fold)
    assert trying.tried["rls"].left_out == {"fast": 90.0, "excitation 1": float("-inf")}


def test_of_the_linear_kinds_the_best_alone_votes_and_all_are_examined(monkeypatch: pytest.MonkeyPatch) -> None:
    fold: Any = SimpleNamespace(train=TRAIN, judged=(1,))
    trying, voted = _Race(TRAIN, OTHER, [fold], 0), dict[str, float]()
    for kind, fit in (("rls", 70.0), ("oe", 85.0), ("play", 60.0), ("nn", 50.0)):
        trying.tried[kind] = KindTrial(kind, 1.0, "model", left_out={"fast": fit})  # pyright: ignore[reportArgumentType]
    trying.tried["nlsm"] = KindTrial("nlsm", 1.0, failure="no")
    monkeypatch.setattr(_auto, "exams", lambda _: ["motion"])
    monkeypatch.setattr(_auto, "free_runs", lambda model, _: model)
    monkeypatch.setattr(_auto, "agreement", lambda runs, worth: voted.update(worth) or dict.fromkeys(runs, 33.0))
    trying.examine()
    assert voted == {"oe": 85.0, "play": 60.0, "nn": 50.0}
    assert [one.kind for one in trying.tried.values() if one.left_out.get(EXAM) == 33.0] == ["rls", "oe", "play", "nn"]


def test_a_weighted_median_is_that_of_values_repeated_as_often() -> None:
    rng = np.random.default_rng(1)
    values, weights = rng.standard_normal((4, 50)), np.array([1, 2, 1, 3])
    repeated = np.median(np.repeat(values, weights, axis=0), axis=0)
    np.testing.assert_array_equal(weighted_median(values, weights.astype(float)), repeated)


def test_numbers_are_those_found_from_data() -> None:
    rls = Rls().fit(TRAIN)
    # Two dead times and two coefficients of each axis, a pole and a dead time of each motor.
    assert numbers_of(rls) == 2 * 3 + 3 * 2
    # Both networks: 10-25-25-1 with thresholds; drives with their load and what corrects disturbances.
    nn = Network(starts=1, iterations=1, refine=0).fit(neck_recording(1200))
    assert numbers_of(nn) == 2 * (25 * 11 + 25 * 26 + 26) + 6 + 4 + 4
    nlsm = SetMembership(epsilon=1e-3, output_weight=10.0).fit(TRAIN)
    points = nlsm.arrays["points"].size + nlsm.arrays["values"].size
    assert points < numbers_of(nlsm) < points + 20


@pytest.fixture(scope="module")
def race() -> _Race:
    """A race that `play` has won before `oe`."""
    race = _Race(TRAIN, OTHER, [], 0)
    for model, fit in ((Play().fit(TRAIN), 85.0), (OutputError(delay=0.06).fit(TRAIN), 80.0)):
        judged = race._validate(model.kind, model)
        race.tried[model.kind] = KindTrial(model.kind, 1.0, model, judged, left_out={"largest motions": fit})
        race.short[model.kind] = model
    return race


def test_the_guarded_form_of_a_learned_winner_is_taken(race: _Race, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Guarded] = []

    def fit(settings: Guarded, recording: Recording, **_: object) -> Model:
        asked.append(settings)
        line = race.tried["oe"].model
        play = race.tried["play"].model
        assert line is not None
        assert play is not None
        return settings.around(Base(line, np.full(2, 0.01), np.array([80.0, 80.0])), [play, play], recording)

    monkeypatch.setattr(Guarded, "fit", fit)
    best = race.tried["play"]
    # Not its own: to compile each combination of kinds takes half a minute.
    monkeypatch.setattr(_Race, "_validate", lambda *_: best.judged)
    chosen = race.guard_best(best, silent)
    assert (asked[0].of, asked[0].base) == ("play", "oe")
    assert chosen.kind == "guarded"
    # It is ranked by what its kind was worth elsewhere.
    assert chosen.scores["largest motions"] == 85.0
    assert set(chosen.scores) == {"largest motions", HOLD_OUT, COLD}
    assert "Its guarded form is taken: 5 models of play that fade to `oe`" in _explain_guarded(best, chosen)
    # A guarded form that costs more than two points on the rows held out is none.
    monkeypatch.setattr(KindTrial, "hold_out_fit", property(lambda one: {"guarded": 90.0, "play": 92.5}[one.kind]))
    assert race.guard_best(best, silent) is best
    assert _explain_guarded(best, best) == ""


def test_over_greybox_the_members_are_those_that_are_there(race: _Race, monkeypatch: pytest.MonkeyPatch) -> None:
    best, line = race.tried["play"], race.tried["oe"].model
    assert best.model is not None
    assert line is not None
    base = Base(line, np.full(2, 0.01), np.array([80.0, 80.0]))
    monkeypatch.setitem(race.tried, "greybox", KindTrial("greybox", 1.0, line, best.judged))
    monkeypatch.setattr(_auto, "fitted_base", lambda *_: base)
    # Not its own: to compile each combination of kinds takes half a minute.
    monkeypatch.setattr(_Race, "_validate", lambda *_: best.judged)
    monkeypatch.setattr(_guarded, "with_validity_region", lambda model, _: model)
    model = race.guard_best(best, silent).model
    assert model is not None
    held = members(model.arrays)
    assert [kind for kind, _ in held] == ["oe", "play", "play"]
    for (_, arrays), there in zip(held[1:], (best.model, race.short["play"]), strict=True):
        assert all(np.array_equal(arrays[name], there.arrays[name]) for name in arrays)
    assert (model.findings["members"], model.settings["members"]) == ("2 of play", 2)


def test_a_line_or_equations_are_not_guarded_and_no_base_is_no_guard(race: _Race) -> None:
    assert race.guard_best(race.tried["oe"], silent) is race.tried["oe"]
    alone = _Race(TRAIN, OTHER, [], 0)
    alone.tried = {"play": race.tried["play"]}
    assert alone.guard_best(alone.tried["play"], silent) is alone.tried["play"]


def test_a_guarded_form_that_cannot_be_trained_is_listed_with_its_reason(
    race: _Race, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fit(*_: object, **__: object) -> Model:
        raise DataError("there is no base to fall back to")

    monkeypatch.setattr(Guarded, "fit", fit)
    assert race.guard_best(race.tried["play"], silent) is race.tried["play"]
    assert race.tried["guarded"].failure == "there is no base to fall back to"


def test_the_choice_says_fit_and_size_of_the_chosen_and_of_those_alike() -> None:
    chosen, other = (SimpleNamespace(kind=kind, fit=fit, worst="largest motions", numbers=numbers)
                     for kind, fit, numbers in (("play", 69.04, 38), ("ensemble", 69.4, 10_481)))  # fmt: skip
    said = "Chosen: play. Worst simulation fit 69.0 % (largest motions), 38 parameters."
    alone: Any = chosen
    assert _explain_choice(alone, []) == f"{said} The worst fit of every other kind is lower."
    beside: Any = [other]
    assert _explain_choice(alone, beside) == (
        f"{said} ensemble reaches 69.4 % with 10,481. Within 0.5 points the kind with the fewest parameters is chosen."
    )


@pytest.mark.parametrize("test", [_auto.EXAM, "largest motions"])
def test_agreement_is_explained_where_it_was_computed(test: str) -> None:
    one = KindTrial("rls", 0.0, left_out={test: 40.0, HOLD_OUT: 90.0})
    said = " Agreement: fit to the median of all kinds on motions that nobody recorded."
    assert _auto._explain_agreement((KindTrial("nn", 0.0), one)) == (said if test == _auto.EXAM else "")
