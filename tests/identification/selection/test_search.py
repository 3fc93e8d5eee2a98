"""A search over settings: each trial is what a user would get by hand, and the choice follows its rule."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load
from softneck.identification import INFINITE, Model, Rls, Search, SetMembership, search, validate
from softneck.identification.models._fitting import row_hashes
from softneck.identification.selection._trials import _diverged
from softneck.robot import Robot
from softneck.signals import Recording

from ...data import Truth, first_order, neck_recording

# Both axes with one dead time of 3 samples, which a search can find.
TRUTH = Truth(delay=(3, 3))
TRAIN = neck_recording(700, seed=1, truth=TRUTH)
HOLD_OUT = neck_recording(400, seed=2, truth=TRUTH)
GRID = {"na": [1, 2], "delay": [0.02, 0.06, 0.1]}


@pytest.fixture(scope="module")
def found() -> Search:
    return search(Rls(), GRID, TRAIN, HOLD_OUT)


def test_each_trial_is_the_fit_that_a_user_makes_by_hand(found: Search) -> None:
    assert [tuple(trial.settings.values()) for trial in found.trials] == [
        (na, delay) for na in GRID["na"] for delay in GRID["delay"]
    ]
    for trial in found.trials:
        judged = validate(Rls(**trial.settings).fit(TRAIN), HOLD_OUT, horizons=(1, INFINITE))
        assert trial.free_run == judged.fits[INFINITE]
        assert trial.one_step == judged.fits["1"]
        assert trial.size == trial.settings["na"] + 1


def test_a_search_is_of_any_robot_and_of_one() -> None:
    finger, antagonist = Robot.preset("finger"), Robot.preset("antagonist")
    train, hold_out = (one.split(0.6)[part] for part, one in enumerate([one_pole(finger)] * 2))
    done = search(Rls(), {"na": [1, 2], "delay": [0.02, 0.06]}, train, hold_out)
    assert done.best == {"na": 1, "delay": 0.06}
    assert list(done.chosen.free_run) == ["pitch"]
    assert [len(row) for row in done.curves["na"]] == [3, 3]
    assert done.model.robot.hash == finger.hash
    # What runs away does so by the range that was measured, in whatever unit.
    assert _diverged(hold_out, np.full((len(hold_out), 1), 1e6), hold_out.outputs) == hold_out.time[0]
    with pytest.raises(DataError, match="the recordings of a search of two robots"):
        search(Rls(), {"na": [1]}, train, one_pole(antagonist))


def one_pole(robot: Robot) -> Recording:
    """`TRUTH` along one direction."""
    U = np.repeat(np.random.default_rng(2).uniform(-2.0, 2.0, (60, len(robot.motors.names))), 10, axis=0)
    weights = robot.weights()
    assert weights is not None
    y = first_order(U @ weights[0], 0.88, 0.011, 3) + 5e-4 * np.random.default_rng(3).standard_normal(len(U))
    channels = dict(zip(robot.set_points, U.T, strict=True)) | {"pitch": y}
    return Recording(0.02 * np.arange(len(U)), 0.02, channels, robot=robot)


def test_the_dead_time_that_made_the_data_is_found(found: Search) -> None:
    # With the true order and dead time only noise is left: a second pole gains nothing, and costs one number.
    assert found.best == {"na": 1, "delay": 0.06}


def test_the_smallest_within_one_standard_error_is_chosen(found: Search) -> None:
    best = max(found.trials, key=lambda trial: trial.score)
    by_score = dataclasses.replace(found, rule="best")
    assert by_score.chosen is best
    as_good = [t for t in found.trials if t.score >= best.score - best.error]
    assert found.chosen in as_good
    assert found.chosen.size == min(t.size for t in as_good)
    assert best.error > 0.0


def test_the_model_is_fitted_on_the_training_rows_alone_and_keeps_the_costs(found: Search, tmp_path: Path) -> None:
    assert sorted(found.model.training_rows) == sorted(row_hashes(TRAIN))
    found.model.save(tmp_path / "m.npz")
    kept = load(tmp_path / "m.npz").findings["search"]
    assert kept["best"] == found.best
    assert [t["score"] for t in kept["trials"]] == [t.score for t in found.trials]
    assert kept["curves"].keys() == GRID.keys()


def test_the_table_and_the_curves_hold_every_trial(found: Search) -> None:
    table = found.frame()
    assert list(table["na"]) == [1, 1, 1, 2, 2, 2]
    assert list(table["score"]) == [t.score for t in found.trials]
    assert list(table["chosen"]) == [t is found.chosen for t in found.trials]
    for value, pitch, roll, *_ in found.curves["delay"]:
        best = max((t for t in found.trials if t.settings["delay"] == value), key=lambda trial: trial.score)
        assert {"pitch": pitch, "roll": roll} == best.free_run


def test_threads_and_coordinates_change_no_fit(found: Search) -> None:
    alone = search(Rls(), GRID, TRAIN, HOLD_OUT, workers=1)
    assert [t.score for t in alone.trials] == [t.score for t in found.trials]
    steps = search(Rls(), GRID, TRAIN, HOLD_OUT, strategy="coordinate", rule="best")
    score = {tuple(t.settings.values()): t.score for t in found.trials}
    assert all(score[tuple(t.settings.values())] == t.score for t in steps.trials)
    # No coordinate of where it stopped can be bettered alone: what a coordinate search promises.
    na, delay = steps.best.values()
    assert score[na, delay] >= max(*(score[n, delay] for n in GRID["na"]), *(score[na, d] for d in GRID["delay"]))


def test_what_cannot_be_fitted_stays_in_the_table_with_its_reason() -> None:
    estimator = SetMembership(epsilon=0.01)
    found = search(estimator, {"scale": [(1.0,), "none"]}, TRAIN, HOLD_OUT)
    failed, fitted = found.trials
    assert failed.reason == "`scale` has 1 entries; the regressor has 10 components."
    assert failed.free_run == {"pitch": None, "roll": None}
    assert fitted.reason == ""
    assert found.best == {"scale": "none"}
    with pytest.raises(DataError, match="none of 1 settings can run free on the hold-out; the first: `scale` has 1"):
        search(estimator, {"scale": [(1.0,)]}, TRAIN, HOLD_OUT)


def test_a_hold_out_of_training_rows_is_refused_and_one_of_the_same_excitation_remarked() -> None:
    with pytest.raises(DataError, match="400 rows of the hold-out are training rows"):
        search(Rls(), GRID, HOLD_OUT, HOLD_OUT)
    head, tail = TRAIN.split(0.6)
    (remark,) = search(Rls(), {"na": [1]}, head, tail).remarks
    assert "same excitation" in remark
    assert search(Rls(), {"na": [1]}, TRAIN, HOLD_OUT).remarks == ()


def test_a_hold_out_too_short_to_run_free_is_refused() -> None:
    with pytest.raises(DataError, match="no run of the hold-out is longer than 50 rows"):
        search(Rls(), GRID, TRAIN, HOLD_OUT.rows(0, 50))


def test_a_free_run_that_leaves_all_bounds_is_no_fit_but_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = Rls.fit

    def run_away(settings: Rls, recording: Recording) -> Model:
        model = fit(settings, recording)
        # A pole of 1.05 multiplies what it starts from by 10 in 47 samples.
        unstable = {"a": np.full((2, 1), -1.05)} if settings.delay == 0.02 else {}
        return dataclasses.replace(model, arrays={**model.arrays, **unstable})

    monkeypatch.setattr(Rls, "fit", run_away)
    diverged, fitted = search(Rls(), {"delay": [0.02, 0.06]}, TRAIN, HOLD_OUT).trials
    assert diverged.free_run == {"pitch": None, "roll": None}
    assert diverged.diverged is not None
    assert 0.5 < diverged.diverged < 8.0
    assert "the free run left the neck's range at" in diverged.reason
    assert fitted.diverged is None


def test_ctrl_c_keeps_what_is_done() -> None:
    def interrupt(done: float, word: str) -> None:
        del word
        if done >= 0.5:
            raise KeyboardInterrupt

    found = search(Rls(), GRID, TRAIN, HOLD_OUT, workers=1, progress=interrupt)
    assert found.interrupted
    assert 3 <= len(found.trials) < 6
    assert isinstance(found.model, Model)


def test_ctrl_c_before_any_fit_is_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    def fit(*_given: object, **_more: object) -> Model:
        raise KeyboardInterrupt

    monkeypatch.setattr(Rls, "fit", fit)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        search(Rls(), GRID, TRAIN, HOLD_OUT, workers=1)


@pytest.mark.parametrize(
    ("vary", "more", "message"),
    [
        ({}, {}, "there is nothing to vary"),
        ({"order": [1]}, {}, "there is no setting `order` to search; this kind has .*delay"),
        ({"na": []}, {}, "there is no value of `na` to try"),
        ({"na": [1]}, {"strategy": "magic"}, "`strategy` must be one of grid, coordinate"),
        ({"na": [1]}, {"rule": "magic"}, "`rule` must be one of one_standard_error, best"),
        ({"na": [1]}, {"workers": 0}, "`workers` must be a whole number between 1 and 256"),
        ({"na": [*range(200)], "nb": [*range(200)]}, {}, "a grid of 40000 settings is too large"),
    ],
)
def test_a_search_that_makes_no_sense_is_refused(vary: dict, more: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        search(Rls(), vary, TRAIN, HOLD_OUT, **more)
