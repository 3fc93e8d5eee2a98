"""How every model starts, which rows that takes, and that a memory is not taken for a model."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.identification import WARM_UP, Model, SetMembership, is_extrapolating, validate
from softneck.signals import SET_POINTS, Recording, concatenate

from ...data import neck_recording
from ._numbers import number

KINDS = ["rls", "nlsm", "residual", "nn"]


def with_outputs(recording: Recording, change: slice, by: float) -> Recording:
    y = recording.outputs.copy()
    y[change] += by
    return recording.with_channels(pitch=y[:, 0], roll=y[:, 1])


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_starts_from_the_same_25_rows_and_none_of_them_is_scored(
    models: dict[str, Model], kind: str
) -> None:
    recording, model = neck_recording(200, seed=15, noise=1e-3), models[kind]
    result = validate(model, recording)
    assert result.rows_scored == 200 - WARM_UP
    assert np.isnan(result.measured[:WARM_UP]).all()
    assert np.isfinite(result.measured[WARM_UP:]).all()
    # Measured outputs after the 25th row do not reach the free run, and those before it do.
    later = validate(model, with_outputs(recording, slice(WARM_UP, None), 0.05))
    np.testing.assert_array_equal(later.free_run, result.free_run)
    before = validate(model, with_outputs(recording, slice(0, WARM_UP), 0.05))
    assert np.abs(before.free_run[WARM_UP] - result.free_run[WARM_UP]).max() > 1e-4
    # What is scored is the same, though the start is not.
    np.testing.assert_array_equal(before.measured, result.measured)


@pytest.mark.parametrize("kind", KINDS)
def test_each_run_starts_by_itself(models: dict[str, Model], kind: str) -> None:
    runs = [neck_recording(120, seed=s, noise=1e-3) for s in (16, 17)]
    both = validate(models[kind], concatenate(runs))
    for index, run in enumerate(runs):
        np.testing.assert_array_equal(both.free_run[both.run == index], validate(models[kind], run).free_run)


def memoriser(recording: Recording) -> Model:
    """Set membership with so steep a cone that it is a look-up of its rows: perfect on them, lost elsewhere."""
    model = SetMembership(epsilon=1e-6, output_weight=10.0).fit(recording)
    return Model(
        kind="nlsm",
        sample_time=model.sample_time,
        arrays={**model.arrays, "bounds": np.array([[1e6, 1e-6]] * 2)},
        training_rows=model.training_rows,
    )


@pytest.mark.slow
def test_a_model_that_memorises_is_not_scored_on_what_it_has_seen() -> None:
    seen = neck_recording(500, seed=3, noise=2e-3)
    others = [neck_recording(700, seed=s, noise=2e-3) for s in (41, 42)]
    model = memoriser(seen)
    mixed = validate(model, concatenate([others[0], seen, others[1]]))
    clean = validate(model, concatenate(others))
    assert (mixed.rows_left_out, clean.rows_left_out) == (500, 0)
    told, expected = mixed.as_dict(), clean.as_dict()
    # Every number but the count of rows left out, and the numbers that the recording gives its runs.
    for entry in (*told["per_run"], *expected["per_run"]):
        entry.pop("run")
    assert {k: v for k, v in told.items() if k != "rows_left_out"} == {
        k: v for k, v in expected.items() if k != "rows_left_out"
    }
    flattered = validate(model, seen, horizons=(1,), include_training=True)
    assert number(flattered.fits["1"]["pitch"]) > 99.9  # it has seen exactly these rows
    assert number(flattered.fits["1"]["pitch"]) > number(clean.fits["1"]["pitch"]) + 5
    assert (flattered.rows_left_out, flattered.rows_trained) == (0, 500)
    half = validate(model, concatenate([others[0], seen]), horizons=(1,), include_training=True)
    assert (half.rows_trained, mixed.rows_trained) == (500, 0)


def test_rows_seen_inside_a_run_are_left_out_and_the_rest_stays_two_segments() -> None:
    run = neck_recording(900, seed=44, noise=2e-3)
    model = memoriser(run.rows(300, 600))
    result = validate(model, run)
    # The first 4 rows of what was trained on have other rows before them here, so their hashes differ.
    assert result.rows_left_out == 296
    assert [entry["rows_scored"] for entry in result.per_run] == [304 - WARM_UP, 300 - WARM_UP]
    assert np.unique(result.run).tolist() == [0, 1]
    assert {entry["run"] for entry in result.per_run} == {0}


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_those_of_set_membership_alone(models: dict[str, Model], kind: str) -> None:
    recording, model = neck_recording(300, seed=18, noise=1e-3), models[kind]
    result = validate(model, recording)
    if kind not in ("nlsm", "residual"):
        assert result.coverage_pct is None
        assert result.bounds_remarks == ()
        assert np.isnan(result.lower).all()
        return
    outputs = model.simulate(recording)
    names = [port.name for port in model.block().outputs]
    for axis, name in enumerate(("pitch", "roll")):
        low, high = outputs[:, names.index(f"{name}_lower")], outputs[:, names.index(f"{name}_upper")]
        # Nothing wider than what was measured is shown as a bound.
        useful = high - low <= np.ptp(recording.outputs[WARM_UP:, axis])
        np.testing.assert_array_equal(result.lower[:, axis], np.where(useful, low, np.nan))
        y = recording.outputs[WARM_UP:, axis]
        inside = (low[WARM_UP:] <= y) & (y <= high[WARM_UP:])
        assert result.coverage_pct is not None
        assert result.mean_width_deg is not None
        assert result.coverage_pct[name] == pytest.approx(100 * inside.mean(), abs=1e-9)
        assert result.mean_width_deg[name] == pytest.approx(np.degrees((high - low)[WARM_UP:].mean()), rel=1e-12)
        flagged = is_extrapolating(model, outputs)[WARM_UP:, axis]
        assert result.outside_pct is not None
        assert result.outside_pct[name] == pytest.approx(100 * flagged.mean(), abs=1e-9)


def test_what_was_never_seen_is_told_as_a_share_of_the_rows(models: dict[str, Model]) -> None:
    recording = neck_recording(300, seed=18, noise=1e-3)
    wild = recording.with_channels(**{name: 3.0 * recording.channels[name] for name in SET_POINTS})
    shares = [validate(models["residual"], r).as_dict()["outside_pct"] for r in (recording, wild)]
    for axis in ("pitch", "roll"):
        assert shares[0][axis] < shares[1][axis], shares  # three times the motion of training lies outside it
    assert max(shares[1].values()) > 50.0


def test_rows_where_nothing_was_measured_are_not_judged() -> None:
    recording = neck_recording(200, seed=3, noise=1e-3)
    gap = {name: np.where(np.arange(200) < 60, np.nan, recording.channels[name]) for name in ("pitch", "roll")}
    result = validate(memoriser(neck_recording(200, seed=4)), recording.with_channels(**gap))
    assert result.rows_scored == 200 - 60
    assert result.as_dict()["per_run"][0]["rows_scored"] == 200 - 60


def test_a_cold_start_knows_the_first_row_only_and_is_scored_on_the_same_rows(models: dict[str, Model]) -> None:
    recording, model = neck_recording(300, seed=15, noise=1e-3), models["rls"]
    result = validate(model, recording)
    state, cold = model.initial_state(recording), [recording.outputs[0]]
    for u in recording.set_points[:-1]:
        state, outputs = model.step(state, u)
        cold.append(outputs[:2])
    there = slice(WARM_UP, None)
    y, yhat = recording.outputs[there], np.array(cold)[there]
    error = np.linalg.norm(y - yhat, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    # The same sums in another order.
    np.testing.assert_allclose(np.array(list(result.cold_fits.values()), dtype=float), 100.0 * (1.0 - error), atol=1e-9)
    assert result.as_dict()["cold_fits"] == result.cold_fits
    # A start that is wrong by 0.3 rad costs a cold run, as much as is left of it after the 25 rows that are not scored.
    wrong = validate(model, with_outputs(recording, slice(0, 1), 0.3))
    drops = np.array(list(result.cold_fits.values())) - list(wrong.cold_fits.values())
    warm = np.abs(np.array(list(result.fits["inf"].values())) - list(wrong.fits["inf"].values()))
    assert (drops > 10.0 * warm).all()
