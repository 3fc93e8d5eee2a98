"""Novelty: 1 on the training set itself, more where a model must guess."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from softneck.core import DataError
from softneck.identification import PAPER_EQ21, Model, Novelty, Rls, validate
from softneck.identification.validation._novelty import QUANTILES
from softneck.signals import Recording

from ...data import neck_recording, recording_from

TRAINING = neck_recording(600, seed=3, noise=1e-3)


def found(model: Model, recording: Recording, training: Recording | None) -> Novelty:
    novelty = validate(model, recording, horizons=(1,), include_training=True, training=training).novelty
    assert novelty is not None
    return novelty


def rls() -> Model:
    return Rls(delay=0.06).fit(TRAINING)


def test_the_training_set_is_as_far_from_itself_as_its_own_spacing() -> None:
    novelty = found(rls(), TRAINING, TRAINING)
    # The same points but for the warm-up's 25 of 600, which stand apart: the neck is only starting.
    np.testing.assert_allclose(novelty.ratio, 1.0, atol=0.2)


def test_distances_are_those_of_a_plain_search() -> None:
    test = neck_recording(200, seed=9, noise=1e-3)
    novelty = found(rls(), test, TRAINING)

    def regressors(r: Recording, first: int) -> np.ndarray:
        sources = (r.outputs[:, [0] * 3], r.set_points, r.motor_positions)
        return np.array([[sources[int(s)][k - int(d), int(c)] for s, c, d in PAPER_EQ21] for k in range(first, len(r))])

    known, asked = regressors(TRAINING, 3), regressors(test, 25)
    spread = known.std(axis=0)
    unit = np.array([spread[0], *[np.sqrt(np.mean(spread[1:] ** 2))] * 9])
    expected = np.quantile(cdist(asked / unit, known / unit).min(axis=1), QUANTILES)
    np.testing.assert_allclose(novelty.distance[0], expected, rtol=1e-9)
    own = cdist(known / unit, known / unit) + np.diag(np.full(len(known), np.inf))
    np.testing.assert_allclose(novelty.spacing[0], np.quantile(own.min(axis=1), QUANTILES), rtol=1e-9)


def test_only_rows_that_the_model_has_seen_count_as_training() -> None:
    """A recording of which the first part was trained on may be given whole: the rest is no training."""
    head, tail = TRAINING.split(0.7)
    model = Rls(delay=0.06).fit(head)
    whole, part = found(model, tail, TRAINING), found(model, tail, head)
    np.testing.assert_array_equal(whole.distance, part.distance)
    assert (whole.distance > 0).all()
    with pytest.raises(DataError, match="the model was trained on none of the rows given as its training data"):
        validate(model, tail, training=tail)


def test_more_than_was_seen_is_more_novel() -> None:
    model = rls()
    same = neck_recording(500, seed=11, noise=1e-3)
    u = same.set_points
    ratios = []
    for factor in (1.0, 1.5, 2.5):
        larger = recording_from(factor * u, noise=1e-3, positions=True)
        ratios.append(found(model, larger, TRAINING).ratio[:, 1:])
    assert (ratios[1] > ratios[0]).all()
    assert (ratios[2] > ratios[1]).all()


def test_a_motor_that_stood_still_in_training_is_novel_when_it_moves() -> None:
    """Its own spread is zero: in that unit it would be infinitely far, or left out; it counts as the others do."""
    u = TRAINING.set_points.copy()
    u[:, 2] = 0.0
    still, moved = recording_from(u, noise=1e-3), u.copy()
    moved[:, 2] = 1.0
    model = Rls(delay=0.06).fit(still)
    novelty = found(model, recording_from(moved, noise=1e-3), still)
    # Two set-points of it and one position, each 1 rad away, in units of all motors' spread.
    motors = np.sqrt(np.mean(np.square([0, 0, *np.repeat(u[:, :2].std(axis=0), 2), *u[:, :2].std(axis=0), 0])))
    assert novelty.distance[0, 0] == pytest.approx(np.sqrt(3) / motors, rel=0.25)


def test_set_membership_knows_without_being_told(models: dict[str, Model]) -> None:
    test = neck_recording(300, seed=12, noise=1e-3)
    training = neck_recording(500, seed=3, noise=1e-3)  # what the shared models were trained on
    stored, told = found(models["nlsm"], test, None), found(models["nlsm"], test, training)
    # Its points were scaled by a weight and back: rounding.
    np.testing.assert_allclose(stored.distance, told.distance, rtol=1e-9)
    np.testing.assert_allclose(stored.spacing, told.spacing, rtol=1e-9)
    assert validate(models["rls"], test, horizons=(1,)).novelty is None
    assert validate(models["rls"], test, horizons=(1,)).as_dict()["novelty"] is None


def test_the_residual_form_measures_in_the_space_it_works_in(models: dict[str, Model]) -> None:
    near = found(models["residual"], neck_recording(500, seed=3, noise=1e-3), None)
    # The same points, but for how the base starts: with the validation's warm-up here, from one row in training.
    np.testing.assert_allclose(near.ratio, 1.0, atol=0.2)
    u = neck_recording(500, seed=12).set_points
    far = found(models["residual"], recording_from(2 * u), None)
    assert (far.ratio > near.ratio).all()


def test_missed_samples_have_no_regressor(models: dict[str, Model]) -> None:
    test = neck_recording(300, seed=12, noise=1e-3)
    pitch = test.channels["pitch"].copy()
    pitch[40:] = np.nan
    novelty = found(models["nlsm"], test.with_channels(pitch=pitch), None)
    assert np.isfinite(novelty.distance).all()
    pitch[:] = np.nan
    none = found(models["nlsm"], test.with_channels(pitch=pitch), None)
    assert np.isnan(none.distance[0]).all()
    assert np.isfinite(none.distance[1]).all()
