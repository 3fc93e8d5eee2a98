"""Validation: honest about rows that were trained on, about divergence, and about residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import DataError, SettingsError
from softneck.identification import WARM_UP, Model, Rls, nrmse_fit, validate
from softneck.identification.models._fitting import row_hashes
from softneck.identification.models._scores import r_squared, rmse, worst_error
from softneck.identification.validation._score_tables import predict
from softneck.signals import concatenate, signal

from ...data import neck_recording, recording_from, short_neck
from ._numbers import number, span

CLEAN = recording_from(signal("aprbs", duration=16.0, seed=4).set_points)


def perfect() -> Model:
    return Rls(delay=None, max_delay=0.1).fit(recording_from(signal("aprbs", duration=30.0, seed=2).set_points))


def test_the_fit_is_the_papers() -> None:
    y = np.array([1.0, 2.0, 4.0, 1.0])
    assert nrmse_fit(y, y) == 100.0
    assert nrmse_fit(y, np.full(4, y.mean())) == pytest.approx(0.0, abs=1e-13)
    assert nrmse_fit(y, y + 1) == pytest.approx(100 * (1 - 2 / np.linalg.norm(y - 2)))
    assert rmse(y, y + 1) == 1.0
    gap = np.array([1.0, np.nan, 4.0, 1.0])
    assert nrmse_fit(gap, gap + 1) == nrmse_fit(y[[0, 2, 3]], y[[0, 2, 3]] + 1)
    assert np.isnan(nrmse_fit(np.ones(3), np.ones(3)))


def test_r2_is_another_word_for_the_fit_and_the_worst_error_has_its_time() -> None:
    result = validate(perfect(), neck_recording(400, seed=8, noise=2e-3))
    for h, fits in result.fits.items():
        for axis, fit in fits.items():
            # Both are sums of the same 375 squares: rounding.
            assert result.r2[h][axis] == pytest.approx(1 - (1 - number(fit) / 100) ** 2, abs=1e-12)
    error = np.degrees(np.abs(result.measured - result.free_run)[:, 1])
    assert result.worst_deg["inf"]["roll"] == np.nanmax(error)
    assert result.worst_time["inf"]["roll"] == result.time[np.nanargmax(error)]
    assert worst_error(np.array([1.0, np.nan, 2.0]), np.array([1.5, 0.0, np.nan])) == (np.inf, 2)
    assert np.isnan(r_squared(np.ones(3), np.ones(3)))


def test_each_run_is_scored_as_if_it_were_alone() -> None:
    runs = [neck_recording(n, seed=s, noise=2e-3) for n, s in ((150, 5), (220, 6))]
    model = perfect()
    both = validate(model, concatenate(runs))
    assert both.run.tolist() == [0] * 150 + [1] * 220
    for entry, run in zip(both.per_run, runs, strict=True):
        alone = validate(model, run)
        assert entry["rows_scored"] == alone.rows_scored
        assert (entry["fits"], entry["rmse_deg"], entry["r2"]) == (alone.fits, alone.rmse_deg, alone.r2)
        assert entry["worst_deg"] == alone.worst_deg


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rls", "nlsm", "residual", "nn"])
def test_rows_shared_out_to_threads_are_predicted_as_by_one(
    models: dict[str, Model], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = neck_recording(90, seed=77)
    for workers in (2, 3, 7):
        monkeypatch.setattr("os.cpu_count", lambda n=workers: n)
        monkeypatch.setattr("softneck.identification.validation._score_tables._WORTH_A_THREAD", 0)
        for horizon in (2, 25, 60):
            shared = predict(models[kind], [run, run], horizon, motors="simulated")
            alone = models[kind].predict(run, horizon)
            np.testing.assert_array_equal(shared, np.vstack([alone, alone]))


@pytest.mark.parametrize("kind", ["rls", "nlsm", "residual", "nn"])
def test_of_a_long_record_every_nth_row_is_predicted_as_before(
    models: dict[str, Model], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = neck_recording(100, seed=78)
    every = models[kind].predict(run, 25)
    for workers, stride in ((1, 3), (2, 7), (3, 40)):
        monkeypatch.setattr("os.cpu_count", lambda n=workers: n)
        some = predict(models[kind], [run], 25, motors="simulated", stride=stride)
        rows = np.arange(25, 100, stride)
        np.testing.assert_array_equal(some[rows], every[rows])
        assert np.isnan(np.delete(some, rows, axis=0)).all()


@pytest.mark.slow
def test_rows_of_a_long_record_are_judged_alike_for_model_and_baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, model = neck_recording(1500, seed=8, noise=2e-3), perfect()
    whole = validate(model, recording)
    monkeypatch.setattr("softneck.identification.validation._score_tables._MOST_STEPS", 7500)
    some = validate(model, recording)
    assert whole.rows_by_horizon == {"1": 1475, "5": 1475, "25": 1475, "inf": 1475}
    assert some.rows_by_horizon == {"1": 1475, "5": 1475, "25": 295, "inf": 1475}
    assert (some.fits["5"], some.fits["inf"], some.intervals["1"]) == (
        whole.fits["5"],
        whole.fits["inf"],
        whole.intervals["1"],
    )
    rows, y = np.arange(25, 1500, 5), recording.outputs
    held = nrmse_fit(y[rows, 0], y[rows - 25, 0])
    assert some.persistence["25"]["pitch"] == pytest.approx(held, abs=1e-12)
    # A fifth of the rows tells the fit to a few hundredths of what is left to 100.
    assert some.fits["25"]["pitch"] == pytest.approx(number(whole.fits["25"]["pitch"]), abs=0.3)
    low, high = span(some.intervals["25"]["pitch"])
    assert low < number(some.fits["25"]["pitch"]) < high


def test_a_perfect_model_scores_100_at_every_horizon() -> None:
    result = validate(perfect(), CLEAN)
    for fits in result.fits.values():
        # 1e-7 of error in the parameters is 1e-5 % of fit.
        assert fits["pitch"] == pytest.approx(100, abs=1e-4)
        assert fits["roll"] == pytest.approx(100, abs=1e-4)
    assert result.diverged is None
    assert (result.rows_scored, result.rows_left_out) == (len(CLEAN) - WARM_UP, 0)


@pytest.mark.parametrize("horizon", [1, 5, 25])
def test_persistence_repeats_the_sample_before(horizon: int) -> None:
    result = validate(perfect(), CLEAN, horizons=(horizon,))
    y = CLEAN.outputs
    for axis, name in enumerate(("pitch", "roll")):
        expected = nrmse_fit(y[WARM_UP:, axis], y[WARM_UP - horizon : len(y) - horizon, axis])
        assert result.persistence[str(horizon)][name] == pytest.approx(expected, abs=1e-12)


def test_rows_of_the_training_are_never_scored(models: dict[str, Model]) -> None:
    """A set membership model remembers its data: scored on it, it would look far better than it is."""
    seen, unseen = short_neck(), neck_recording(300, seed=31)
    model = models["nlsm"]
    with pytest.raises(DataError, match="nothing is left to judge: all 500 rows were used to train the model"):
        validate(model, seen)
    flattered = validate(model, seen, horizons=(1,), include_training=True)
    assert (flattered.rows_scored, flattered.rows_left_out) == (500 - WARM_UP, 0)
    honest = validate(model, concatenate([seen, unseen]), horizons=(1,))
    assert (honest.rows_scored, honest.rows_left_out) == (300 - WARM_UP, 500)
    alone = validate(model, unseen, horizons=(1,))
    assert honest.fits == alone.fits


def test_the_end_of_a_run_is_judged_alone() -> None:
    whole = neck_recording(600, seed=41)
    head, tail = whole.split(0.7)
    assert tail is not None
    model = Rls(delay=0.06).fit(head)
    both, rest = validate(model, whole), validate(model, tail)
    assert (both.rows_scored, both.rows_left_out) == (180 - WARM_UP, 420)
    assert both.fits == rest.fits
    assert both.time[0] == tail.time[0]


def test_rows_are_known_in_any_order_and_by_their_past() -> None:
    a, b = neck_recording(60, seed=1), neck_recording(60, seed=2)
    hashes = row_hashes(concatenate([a, b]))
    assert np.isin(row_hashes(concatenate([b, a])), hashes).all()
    # At rest all rows look alike; after five of them they do, and are not told apart.
    assert np.unique(row_hashes(a)[10:]).size == 50
    assert not np.isin(row_hashes(neck_recording(60, seed=3))[15:], hashes).any()


def test_several_runs_are_scored_together_and_started_apart() -> None:
    model = perfect()
    runs = [neck_recording(150, seed=s, noise=2e-3) for s in (5, 6)]
    result = validate(model, concatenate(runs), horizons=("inf",))
    assert result.rows_scored == 2 * (150 - WARM_UP)
    y = np.concatenate([r.outputs[WARM_UP:] for r in runs])
    free = np.concatenate([model.simulate(r)[WARM_UP:, :2] for r in runs])
    assert result.fits["inf"]["pitch"] == pytest.approx(nrmse_fit(y[:, 0], free[:, 0]), abs=1e-12)
    assert result.rmse_deg["inf"]["roll"] == pytest.approx(np.degrees(rmse(y[:, 1], free[:, 1])), rel=1e-12)


def test_divergence_is_reported_with_its_time() -> None:
    stable = perfect()
    model = Model(kind="rls", sample_time=stable.sample_time, arrays={**stable.arrays, "a": np.full((2, 1), -1.2)})
    result = validate(model, CLEAN)
    assert result.fits["inf"] == {"pitch": None, "roll": None}
    assert result.rmse_deg["inf"] == {"pitch": None, "roll": None}
    # Further than three times the larger range from the middle of what is scored, as the docs say.
    y, free = CLEAN.outputs[WARM_UP:], model.simulate(CLEAN)[:, :2]
    middle = 0.5 * (y.min(axis=0) + y.max(axis=0))
    reach = 3 * np.ptp(y, axis=0).max()
    first = np.argmax(((np.abs(free - middle) > reach) | (np.abs(free) >= np.pi)).any(axis=1))
    assert result.diverged == CLEAN.time[first]
    assert result.as_dict()["diverged"] == result.diverged
    assert result.fits["1"]["pitch"] is not None
    for table in (result.r2, result.worst_deg, result.intervals):
        assert table["inf"] == {"pitch": None, "roll": None}


def test_a_run_that_diverges_leaves_the_others_their_scores() -> None:
    """A model with a pole beyond 1 that starts at rest stays there; it runs away where it is moved."""
    rest = np.zeros((300, 3))
    still = recording_from(rest).with_channels(pitch=1e-3 * np.sin(np.arange(300)), roll=1e-3 * np.cos(np.arange(300)))
    still = still.with_channels(
        **{c: np.where(np.arange(300) <= WARM_UP, 0, still.channels[c]) for c in ("pitch", "roll")}
    )
    stable = perfect()
    model = Model(kind="rls", sample_time=stable.sample_time, arrays={**stable.arrays, "a": np.full((2, 1), -1.2)})
    result = validate(model, concatenate([still, CLEAN]))
    first, second = result.per_run
    assert first["diverged"] is None
    assert first["fits"]["inf"]["pitch"] == pytest.approx(0.0, abs=0.5)  # it says 0 where the mean is about 0
    assert second["fits"]["inf"] == {"pitch": None, "roll": None}
    assert second["diverged"] == result.diverged
    assert result.fits["inf"] == {"pitch": None, "roll": None}


def test_a_gain_that_is_twice_too_high_has_not_diverged() -> None:
    """Bad is a number; only what has left the data's range is none."""
    model = perfect()
    result = validate(Model(kind="rls", sample_time=0.02, arrays={**model.arrays, "b": 2 * model.arrays["b"]}), CLEAN)
    assert result.diverged is None
    # Twice the signal: the error is the signal itself, whose mean square is no less than that about its mean.
    assert -50.0 < number(result.fits["inf"]["pitch"]) <= 1.0


def test_missed_samples_are_not_scored_and_do_no_harm() -> None:
    pitch = CLEAN.channels["pitch"].copy()
    pitch[100:140:2] = np.nan
    result = validate(perfect(), CLEAN.with_channels(pitch=pitch))
    assert result.fits["inf"]["pitch"] == pytest.approx(100, abs=1e-4)
    assert result.persistence["1"]["pitch"] is not None


def test_an_axis_that_was_never_measured_has_no_fit() -> None:
    result = validate(perfect(), CLEAN.with_channels(pitch=np.full(len(CLEAN), np.nan)))
    assert result.fits["inf"]["pitch"] is None
    assert result.diverged is None
    assert result.fits["inf"]["roll"] == pytest.approx(100, abs=1e-4)


def test_a_horizon_is_scored_only_where_there_is_so_much_past() -> None:
    model, horizon = perfect(), len(CLEAN) - 10
    jumped = CLEAN.with_channels(pitch=np.where(np.arange(len(CLEAN)) < horizon, 1.0, CLEAN.channels["pitch"]))
    told = validate(model, jumped, horizons=(horizon,)).fits[str(horizon)]["pitch"]
    predicted = model.predict(jumped, horizon)[horizon:, 0]
    assert told == pytest.approx(nrmse_fit(jumped.outputs[horizon:, 0], predicted))


def test_the_residual_tests_do_not_depend_on_the_horizons_asked_for() -> None:
    all_of_them, free_only = validate(perfect(), CLEAN), validate(perfect(), CLEAN, horizons=("inf",))
    assert (all_of_them.white, all_of_them.uncorrelated) == (free_only.white, free_only.uncorrelated)
    assert set(free_only.fits) == {"inf"}


def test_what_is_too_short_or_unknown_is_refused() -> None:
    with pytest.raises(DataError, match="nothing is left to judge: 25 rows are too few"):
        validate(perfect(), CLEAN.rows(0, WARM_UP))
    with pytest.raises(SettingsError, match="`motors` must be one of simulated, measured"):
        validate(perfect(), CLEAN, motors="felt")


def test_the_residuals_of_an_exact_structure_are_white() -> None:
    """ARX noise enters before the pole here: one-step errors of the true model are the white noise itself."""
    rng = np.random.default_rng(6)
    model, r = perfect(), CLEAN
    y = r.outputs + np.column_stack([lfilter([1], [1, -p], 1e-3 * rng.standard_normal(len(r))) for p in (0.88, 0.92)])
    result = validate(model, r.with_channels(pitch=y[:, 0], roll=y[:, 1]), horizons=(1,))
    assert result.white
    assert result.uncorrelated
