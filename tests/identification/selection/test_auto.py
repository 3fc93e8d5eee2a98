"""`choose`: ranking by free run, the simplest of those alike, failures that are told, remarks."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load, silent
from softneck.identification import Choice, Model, Network, OutputError, Play, Rls, SetMembership, choose, identify
from softneck.identification.models._arrays import members
from softneck.identification.models._fitting import known_rows, row_hashes
from softneck.identification.models._left_out import Fold, agreement, exams, folds, weighted_median
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
from softneck.identification.selection._examination import part_of_reference
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


def test_the_chosen_is_examined_as_one_kind_alone_is() -> None:
    """What is expected of other motions does not depend on how a kind was asked for."""
    chosen = choose(*TRAIN.split(0.7), kinds=("rls",)).chosen
    assert chosen.model is not None
    assert chosen.examination is not None
    alone = identify("rls", TRAIN).findings["examination"]
    assert chosen.examination.findings("rls", chosen.model.robot) == alone
    assert set(alone["parts"]) > {HOLD_OUT}


def test_a_hold_out_of_the_same_excitation_and_a_hopeless_one_are_remarked() -> None:
    head, tail = TRAIN.split(0.7)
    same = choose(head, tail, kinds=("rls",))
    assert "of the excitation that was trained on" in same.remarks[0]
    rng = np.random.default_rng(0)
    noise = OTHER.with_channels(pitch=0.1 * rng.standard_normal(500), roll=0.1 * rng.standard_normal(500))
    lost = choose(TRAIN, noise, kinds=("rls", "play"), other_excitation=True)
    assert any("No kind reaches 70 %" in remark for remark in lost.remarks)


def test_an_internal_error_of_one_kind_is_said_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not shown as a kind that the data do not determine, which nobody would report."""

    def fit(*_: object, **__: object) -> Model:
        raise IndexError("index 2 is out of bounds")

    monkeypatch.setattr(OutputError, "fit", fit)
    monkeypatch.delenv("SOFTNECK_TRACEBACK", raising=False)
    found = choose(TRAIN, OTHER, kinds=("rls", "oe"), other_excitation=True)
    said = "internal error in softneck: IndexError: index 2 is out of bounds (set SOFTNECK_TRACEBACK=1 and report"
    assert found.chosen.kind == "rls"
    assert {one.kind: one.failure.startswith(said) for one in found.ranking} == {"rls": False, "oe": True}
    assert any(remark.startswith(f"oe: {said}") for remark in found.remarks)
    monkeypatch.setenv("SOFTNECK_TRACEBACK", "1")
    with pytest.raises(IndexError, match="index 2"):
        choose(TRAIN, OTHER, kinds=("rls", "oe"), other_excitation=True)


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
        # It has no vote either, however much it was worth; nor has one that was worth nothing known.
        for told in (worth, worth | {"d": 99.0}):
            assert agreement({**runs, "d": [runs["a"][0], gone]}, told) == {**whole, "d": float("-inf")}
    for unknown in (float("-inf"), float("nan"), float("inf")):
        assert agreement({**runs, "d": runs["a"]}, worth | {"d": unknown}) == {**whole, "d": whole["a"]}
        assert agreement(runs, worth | {"a": unknown}) == {}
    # A model that is right to a percent weighs no more than that: two of them never outvote three by more.
    runs["e"] = [truth + 0.1 * rng.standard_normal(truth.shape) for _ in range(2)]
    assert agreement(runs, worth | {"a": 99.0, "e": 90.0}) == agreement(runs, worth | {"a": 99.99, "e": 90.0})
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
        raise np.linalg.LinAlgError("singular")

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
    monkeypatch.setattr(_auto, "fits_to_reference", lambda *_: ("", {}))
    trying.examine()
    assert voted == {"oe": 85.0, "play": 60.0, "nn": 50.0}
    assert [one.kind for one in trying.tried.values() if one.left_out.get(EXAM) == 33.0] == ["rls", "oe", "play", "nn"]
    # Another experiment tells what the kinds are worth: they do not vote on it.
    told = _Race(TRAIN, OTHER, [fold], 0, other_excitation=True)
    told.tried = {
        kind: replace(one, left_out={"fast": one.left_out.get("fast", 0.0)}) for kind, one in trying.tried.items()
    }
    told.examine()
    assert all(EXAM not in one.left_out for one in told.tried.values())


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
        race.short[model.kind, race.folds[0]] = model
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
    for (_, arrays), there in zip(held[1:], (best.model, race.short["play", race.folds[0]]), strict=True):
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


# -- a race of kinds whose fits are formulas ---------------------------------------------------------------------------


FITS = {"pitch": 80.0, "roll": 60.0}


def part(name: str, fits: dict[str, float] = FITS, error: float = 2.0) -> Any:
    return SimpleNamespace(name=name, fits=lambda _: (fits, error))


def racing(monkeypatch: pytest.MonkeyPatch, *, judged: int = 1, more: int = 0, fails: str = "") -> tuple[_Race, list]:
    """Return a race whose trainings are recorded, of which those of a kind fail."""
    fitted: list[Any] = []

    @dataclass(frozen=True)
    class Settings:
        kind: str
        seed: int
        other: Any
        short: bool = False
        output_weight: float | None = None
        epsilon: float | None = None

        def fit(self, recording: Any) -> Any:
            fitted.append((self, recording))
            if self.kind == fails:
                raise DataError("it saturates")
            return f"{self.kind} of {len(recording)}"

    monkeypatch.setattr(_auto, "settings_of", Settings)
    monkeypatch.setattr(_auto, "shortened", lambda settings, kind: replace(settings, short=kind == settings.kind))
    monkeypatch.setattr(_auto, "all_rows", lambda name, _: part(name, {"pitch": 90.0, "roll": 50.0}, 3.0))
    monkeypatch.setattr(_auto, "numbers_of", lambda model: len(str(model)))
    monkeypatch.setattr(_Race, "_validate", lambda *_: SimpleNamespace(fits={_auto.INFINITE: FITS}, cold_fits=FITS))

    def examine(again: Any, model: Any, train: Any, hold_out: Any, left_out: Any, *, other_excitation: bool) -> Any:
        """Tell what is examined, and by which short trainings."""
        assert (train, hold_out) == (TRAIN, OTHER)
        return ([again(fold) for fold in left_out], other_excitation), f"{model}, examined"

    monkeypatch.setattr(_auto, "examine", examine)
    monkeypatch.setattr(_auto, "noise_si", lambda _: np.array([0.1, 0.2]))
    folds = [Fold(TRAIN.rows(0, 800), tuple(map(part, "abc"[:judged])))]
    folds += [Fold(TRAIN.rows(0, 700 - k), (part(f"run {k}", FITS),)) for k in range(more)]
    return _Race(TRAIN, OTHER, folds, 5), fitted


def ran(kind: str, fit: float = 70.0, **more: Any) -> KindTrial:
    return KindTrial(kind, 1.0, **{"model": f"{kind} made", "left_out": {"a": fit}, "whole": False, **more})


def test_a_short_training_is_scored_on_each_part_and_a_failure_costs_its_own_time_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    race, fitted = racing(monkeypatch, judged=2, fails="oe")
    known: list[Any] = []
    monkeypatch.setattr(_auto, "as_found", lambda settings, model: known.append(model) or settings)
    begin = time.perf_counter()
    for kind in ("rls", "oe", "nlsm", "greybox"):
        race.screen(kind)
    one = race.tried["rls"]
    assert (one.left_out, one.errors) == ({"a": 70.0, "b": 70.0, HOLD_OUT: 70.0}, {"a": 2.0, "b": 2.0, HOLD_OUT: 3.0})
    assert (one.model, one.whole, one.failure, one.examination) == ("rls of 800", False, "", None)
    failed = race.tried["oe"]
    assert (failed.model, failed.failure, failed.fit) == (None, "it saturates", float("-inf"))
    # A grey box has the parts and the dead time that all rows have, which are trained on once.
    sizes = {"rls": [800], "oe": [800], "nlsm": [800], "greybox": [900, 800]}
    assert [(told.kind, told.seed, len(rows)) for told, rows in fitted] == [
        (kind, 5, number) for kind, numbers in sizes.items() for number in numbers
    ]
    assert known == ["greybox of 900"]
    # A set's epsilon is eight deviations of the louder output's noise; a grey box is of the cheaper settings.
    nlsm, whole, short = (told for told, _ in fitted[2:])
    assert (nlsm.output_weight, nlsm.epsilon) == (5.0, pytest.approx(8.0 * 0.2))
    assert (nlsm.short, whole.short, short.short) == (True, False, True)
    race.whole("greybox")
    assert len(fitted) == 5
    assert 0.0 <= sum(one.seconds for one in race.tried.values()) <= time.perf_counter() - begin


@pytest.mark.parametrize("judged", [0, 1])
@pytest.mark.parametrize("kind", ["rls", "greybox"])
def test_a_whole_training_is_judged_again_and_examined_by_its_short_ones(
    judged: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    race, fitted = racing(monkeypatch, judged=judged)
    race.short[kind, race.folds[0]] = "short"  # pyright: ignore[reportArgumentType]
    race.tried[kind] = ran(kind, errors={"a": 1.5})
    begin = time.perf_counter()
    race.whole(kind)
    one = race.tried[kind]
    assert (one.model, one.whole) == (f"{kind} of 900, examined", True)
    assert [(told.short, len(rows)) for told, rows in fitted] == [(False, 900)]
    assert one.examination == (["short"] * judged, False)
    assert one.errors == {"a": 1.5, HOLD_OUT: 3.0}
    assert one.scores == {"a": 70.0, HOLD_OUT: 70.0, COLD: 70.0}
    assert 1.0 <= one.seconds <= 1.0 + time.perf_counter() - begin


@pytest.mark.parametrize("made", [True, False])
def test_a_kind_that_fails_in_its_whole_training_keeps_its_reason(made: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    race, fitted = racing(monkeypatch, fails="oe")
    race.tried["oe"] = ran("oe") if made else ran("oe", model=None, failure="too short")
    race.whole("oe")
    one = race.tried["oe"]
    assert (one.model, one.failure, one.fit, one.seconds) == (
        None, "it saturates" if made else "too short", float("-inf"), 1.0,
    )  # fmt: skip
    assert len(fitted) == made  # one that could not be made short is not made whole


def test_later_parts_are_left_out_of_the_best_alone_until_no_other_could_win(monkeypatch: pytest.MonkeyPatch) -> None:
    race, fitted = racing(monkeypatch, more=3)
    fits = {"rls": 60.0, "oe": 90.0, "play": 75.0, "greybox": float("-inf"), "nlsm": 69.0, "nn": 50.0}
    race.tried = {kind: ran(kind, fit) for kind, fit in fits.items()}
    race.short["oe", race.folds[0]] = "short"  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(_auto, "numbers_of", lambda model: 5 + (not str(model).startswith("oe")))
    said: list[tuple[float, str]] = []
    begin = time.perf_counter()
    found = race.train_best(lambda share, what: said.append((share, what)))
    # All score 70 on a later part: `oe` falls behind `play`, which then falls to it; 69 could not have won.
    # What it was trained on for its scores, it is examined by.
    assert [(told.kind, len(rows)) for told, rows in fitted] == [
        ("oe", 700), ("play", 700), ("oe", 699), ("oe", 698), ("oe", 900),
    ]  # fmt: skip
    assert (found.kind, found.whole) == ("oe", True)
    assert said == [
        (0.125, "oe without run 0"), (0.125, "play without run 0"), (0.25, "oe without run 1"),
        (0.375, "oe without run 2"), (0.5, "oe on all rows to train on"),
    ]  # fmt: skip
    assert race.tried["oe"].left_out == {"a": 90.0, "run 0": 70.0, "run 1": 70.0, "run 2": 70.0}
    assert race.tried["rls"].left_out == {"a": 60.0}
    assert all(1.0 <= one.seconds <= 1.0 + time.perf_counter() - begin for one in race.tried.values())


@pytest.mark.parametrize("seed", range(20))
def test_the_winner_is_the_one_that_all_parts_of_all_kinds_would_choose(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, kinds, parts = np.random.default_rng(seed), ("rls", "oe", "play", "nlsm"), 4
    race, _ = racing(monkeypatch, more=parts - 1)
    # No two of them are alike, and training on all rows changes none.
    told = dict(zip(kinds, rng.permutation(len(kinds) * parts).reshape(-1, parts) * 5.0, strict=True))
    race.tried = {kind: ran(kind, told[kind][0]) for kind in kinds}
    number = {id(fold): k for k, fold in enumerate(race.folds)}
    left: list[tuple[str, int]] = []

    def leave_out(kind: str, fold: Any) -> None:
        k = number[id(fold)]
        left.append((kind, k))
        one = race.tried[kind]
        race.tried[kind] = replace(one, left_out={**one.left_out, str(k): told[kind][k]})

    monkeypatch.setattr(race, "_leave_out", leave_out)
    monkeypatch.setattr(race, "whole", lambda kind: race.tried.update({kind: replace(race.tried[kind], whole=True)}))
    best = max(kinds, key=lambda kind: told[kind].min())
    found = race.train_best(silent)
    assert (found.kind, found.fit) == (best, told[best].min())
    assert len(set(left)) == len(left)  # no part twice


@pytest.mark.parametrize(
    ("whole", "trained", "best"),
    [
        # It is trained, and stays the best.
        ({"rls": 80.0, "oe": 90.0, "play": 85.0}, ["oe"], "oe"),
        # It falls behind the next, which is trained too.
        ({"rls": 60.0, "oe": 70.0, "play": 85.0}, ["oe", "play"], "play"),
        # Two at most: then the better of those that were trained.
        ({"rls": 60.0, "oe": 70.0, "play": 71.0}, ["oe", "play"], "play"),
        ({"rls": 60.0, "oe": 70.0, "play": 69.0}, ["oe", "play"], "oe"),
        # One that fails is no result: a third is trained.
        ({"rls": 60.0, "oe": float("-inf"), "play": float("-inf")}, ["oe", "play", "rls"], "rls"),
    ],
)
def test_at_most_two_kinds_are_trained_on_all_rows_until_the_best_one_is(
    whole: dict[str, float], trained: list[str], best: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    race, _ = racing(monkeypatch)
    race.tried = {kind: ran(kind, fit) for kind, fit in (("rls", 72.0), ("oe", 92.0), ("play", 86.0))}
    made: list[str] = []

    def train(kind: str) -> None:
        made.append(kind)
        fit = whole[kind]
        race.tried[kind] = replace(race.tried[kind], left_out={"a": fit}, whole=fit > float("-inf"))

    monkeypatch.setattr(race, "whole", train)
    said: list[str] = []
    found = race.train_best(lambda _, what: said.append(what))
    assert (made, found.kind) == (trained, best)
    assert said == [f"{kind} on all rows to train on" for kind in trained]
    # Where nothing at all can be made, that is an error.
    race.tried = {"rls": ran("rls", float("-inf"), failure="no")}
    with pytest.raises(DataError, match="no kind could be identified: no"):
        race.train_best(silent)


@pytest.mark.parametrize(
    ("fits", "numbers", "chosen"),
    [
        ({"rls": 80.0, "oe": 80.4}, {"rls": 5, "oe": 6}, "rls"),
        ({"rls": 80.0, "oe": 80.5}, {"rls": 5, "oe": 6}, "oe"),  # half a point is no longer alike
        ({"rls": 80.0, "oe": 80.4}, {"rls": 7, "oe": 6}, "oe"),
        ({"oe": 80.4, "rls": 80.0}, {"rls": 6, "oe": 6}, "rls"),  # of equal size the one that is easier to read
        ({"nn": 80.4, "play": 80.0, "greybox": 80.3}, {"nn": 6, "play": 6, "greybox": 6}, "greybox"),
    ],
)
def test_of_kinds_within_half_a_point_the_one_of_fewest_numbers_is_taken(
    fits: dict[str, float], numbers: dict[str, int], chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    race, _ = racing(monkeypatch)
    monkeypatch.setattr(_auto, "numbers_of", lambda model: numbers[str(model).split()[0]])
    race.tried = {kind: ran(kind, fit) for kind, fit in fits.items()}
    assert race._simplest_of_the_best().kind == chosen
    assert ran("rls", model=None).numbers == 0


def test_a_guarded_form_costs_its_own_time_and_tells_its_own_rows_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    race, _ = racing(monkeypatch)
    # Over the better of two bases.
    race.tried = {"greybox": ran("greybox", 50.0), "oe": ran("oe", 60.0), "rls": ran("rls", 90.0)}
    best = ran("play", errors={"a": 1.0})
    said: list[str] = []
    monkeypatch.setattr(Guarded, "fit", lambda settings, *_, **__: f"guarded {settings.of} {settings.base}")
    begin = time.perf_counter()
    chosen = race.guard_best(best, lambda _, what: said.append(what))
    assert (chosen.kind, chosen.model, said) == ("guarded", "guarded play oe, examined", ["guarded form of play"])
    # Short forms of what it is made of stand for it.
    assert chosen.examination == (["play of 800"], False)
    assert (chosen.left_out, chosen.errors, race.tried["guarded"]) == (best.left_out, best.errors, chosen)
    assert 0.0 <= chosen.seconds <= time.perf_counter() - begin
    # What diverged is no base, and a kind that failed has no guarded form.
    race.tried = {"oe": ran("oe", float("-inf")), "rls": ran("rls", 90.0)}
    assert race.guard_best(best, silent) is best
    race.tried["oe"] = ran("oe", 60.0)
    none = ran("play", model=None)
    assert race.guard_best(none, silent) is none

    def fails(*_: Any, **__: Any) -> Any:
        raise DataError("no base")

    monkeypatch.setattr(Guarded, "fit", fails)
    assert race.guard_best(best, silent) is best
    assert race.tried["guarded"].failure == "no base"
    assert 0.0 <= race.tried["guarded"].seconds <= time.perf_counter() - begin


@pytest.mark.parametrize("whole", [True, False])
def test_the_best_of_the_other_sort_is_trained_on_all_rows_once(whole: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    race, made = racing(monkeypatch)
    race.tried = {"rls": ran("rls", 80.0), "play": ran("play", 70.0, whole=whole), "nn": ran("nn", 60.0)}
    race.short["play", race.folds[0]] = "short"  # pyright: ignore[reportArgumentType]
    assert race.finish(race.tried["rls"], silent) is race.tried["rls"]
    assert [told.kind for told, _ in made] == ([] if whole else ["play"])
    assert race.tried["play"].whole


@pytest.mark.parametrize("fit", [50.0, float("-inf")], ids=["worse", "failed"])
def test_what_is_the_best_of_the_others_in_the_end_is_trained_on_all_rows(
    fit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file had the short form, without a fit on the rows held out."""
    race, _ = racing(monkeypatch)
    race.tried = {"rls": ran("rls", 80.0), "play": ran("play", 70.0, whole=False), "nn": ran("nn", 60.0, whole=False)}
    after = {"play": fit, "nn": 55.0}
    monkeypatch.setattr(_Race, "_trained", lambda _, kind: ran(kind, after[kind], whole=True))
    race.finish(race.tried["rls"], silent)
    other = _auto.best_others(race.ranking(), race.tried["rls"])["nonlinear"]
    assert (other.kind, other.whole, other.fit) == ("nn", True, 55.0)


def test_no_exam_without_parts_left_out_and_none_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(_auto, "exams", lambda rows: made.append(len(rows)) or ["motion"])
    monkeypatch.setattr(_auto, "free_runs", lambda model, _: made.append(model) or [])
    monkeypatch.setattr(_auto, "agreement", lambda runs, _: dict.fromkeys(runs, 33.0))
    monkeypatch.setattr(_auto, "fits_to_reference", lambda *_: ("play", FITS))
    race, _ = racing(monkeypatch, judged=0)
    race.tried = {"rls": ran("rls")}
    race.examine()
    assert (made, race.tried["rls"].left_out) == ([], {"a": 70.0})
    race, _ = racing(monkeypatch)
    race.tried = {"rls": ran("rls"), "oe": ran("oe", model=None)}
    race.examine()
    race.examine()
    assert made == [800, "rls made"]
    assert race.tried["rls"].left_out == {"a": 70.0, EXAM: 33.0}
    assert race.tried["oe"].left_out == {"a": 70.0}


def test_where_the_grey_box_stands_for_the_robot_it_has_the_only_vote(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds that share a bias agree: on a neck with friction and slack they outvoted the equations that were right."""
    monkeypatch.setattr(_auto, "agreement", lambda *_: pytest.fail("nobody else is asked"))
    told = {"rls": ("greybox", FITS), "greybox": ("", {}), "play": ("play", FITS)}
    monkeypatch.setattr(_auto, "fits_to_reference", lambda model, *_: told[model.split()[0]])
    race, _ = racing(monkeypatch)
    race.tried = {"oe": ran("oe", model=None), **{kind: ran(kind) for kind in told}}
    race.examine()
    left_out = {kind: one.left_out for kind, one in race.tried.items()}
    own = {kind: {"a": 70.0} for kind in race.tried}
    assert left_out == {**own, "rls": {"a": 70.0, part_of_reference("greybox"): 70.0}}


def test_a_choice_says_how_far_it_is_and_what_is_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds are screened in a fixed order; those within half a point of the best are named beside it."""
    racing(monkeypatch)
    monkeypatch.setattr(_auto, "folds", lambda *_, **__: [Fold(TRAIN, (part("a"),))])
    monkeypatch.setattr(_Race, "examine", lambda _: None)
    monkeypatch.setattr(_Race, "guard_best", lambda _, best, tell: tell(0.5, "guard") or best)
    fits = {"rls": 80.0, "oe": 79.6, "play": 60.0, "nlsm": 79.0}

    def screen(self: _Race, kind: str) -> None:
        self.tried[kind] = ran(kind, fits[kind])

    def whole(self: _Race, kind: str) -> None:
        self.tried[kind] = replace(self.tried[kind], whole=True)

    monkeypatch.setattr(_Race, "screen", screen)
    monkeypatch.setattr(_Race, "whole", whole)
    said: list[tuple[float, str]] = []
    found = choose(TRAIN, OTHER, kinds=("nlsm", "play", "rls", "oe"), other_excitation=False, seed=4,
                   progress=lambda *told: said.append(told))  # fmt: skip
    assert found.chosen.kind == "oe"  # fewer letters, which stand for numbers
    assert [one.kind for one in found.ranking] == ["rls", "oe", "nlsm", "play"]
    assert "rls reaches 80.0 %" in found.why
    assert "nlsm" not in found.why
    assert [share for share, _ in said] == pytest.approx([0.0, 0.2125, 0.425, 0.6375, 0.9, 0.975, 1.0])
    assert [text for _, text in said] == [
        "rls", "oe (best so far rls, 80.0 %)", "play (best so far rls, 80.0 %)", "nlsm (best so far rls, 80.0 %)",
        "oe on all rows to train on", "guard", "chosen: oe",
    ]  # fmt: skip
    # What was chosen is linear: the best nonlinear kind is trained on all rows too.
    assert [one.kind for one in found.ranking if one.whole] == ["oe", "nlsm"]


@pytest.mark.parametrize("samples", [(2, 2), (1, 2), (2, 1), (0, 0)])
def test_two_samples_of_each_output_are_the_least_to_judge_by(
    samples: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    y = np.full((500, 2), np.nan)
    y[0] = OTHER.outputs[0]  # aligns the run and is not judged
    for k, count in enumerate(samples):
        y[30 : 30 + count, k] = OTHER.outputs[30 : 30 + count, k]
    monkeypatch.setattr(_auto, "folds", lambda *_, **__: pytest.fail("they are enough") if min(samples) < 2 else [])
    monkeypatch.setattr(_Race, "screen", lambda *_: (_ for _ in ()).throw(KeyError("screened")))
    held = OTHER.with_channels(pitch=y[:, 0], roll=y[:, 1])
    if min(samples) >= 2:
        with pytest.raises(KeyError, match="screened"):
            choose(TRAIN, held, kinds=("rls",))
    else:
        name = "pitch" if samples[0] < 2 else "roll"
        with pytest.raises(DataError, match=rf"`{name}` has {min(samples)} sample\(s\) in the rows held out"):
            choose(TRAIN, held, kinds=("rls",))


def test_what_is_wary_of_a_ranking_is_said_of_it() -> None:
    lost, good = KindTrial("nn", 0.0, failure="no"), KindTrial("rls", 0.0, left_out={HOLD_OUT: 70.0})
    assert _auto._remarks((good,), other_excitation=True) == ()
    [same] = _auto._remarks((good,), other_excitation=False)
    assert "Give a second recording" in same
    assert _auto._remarks((good, lost), other_excitation=True) == ("Not identified or diverged: nn.",)
    assert _auto._failure_reasons([lost, KindTrial("oe", 0.0, failure="no")]) == "no"
    assert _auto._failure_reasons([lost, good]) == "nn: no; rls: its simulation diverged"
    assert _auto._progress_text("oe", []) == _auto._progress_text("oe", [lost]) == "oe"
    # Outputs at rest have no fit; a part in which none moves says nothing, of a diverged simulation it does.
    nan, lost_fit = float("nan"), float("-inf")
    still = {
        "still": ({"pitch": nan}, nan),
        "half": ({"pitch": 80.0, "roll": nan}, 0.0),
        "lost": ({"a": lost_fit}, nan),
    }
    assert _auto._with(good, still).left_out == {HOLD_OUT: 70.0, "half": 80.0, "lost": lost_fit}
    told = _auto._with(good, {"a": (FITS, nan), "b": (FITS, 0.0)})
    assert (told.left_out, told.errors) == ({HOLD_OUT: 70.0, "a": 70.0, "b": 70.0}, {"b": 0.0})


@pytest.mark.parametrize("kind", kinds_to_try())
def test_kinds_that_start_at_random_have_the_seed_of_the_choice(kind: str) -> None:
    made = _auto.settings_of(kind, 7, {})
    assert getattr(made, "seed", 7) == 7
    if kind == "nlsm":
        assert made.form == "residual"
        assert _auto.settings_of(kind, 7, {"epsilon": 0.5}).epsilon == 0.5
