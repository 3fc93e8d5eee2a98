"""Models that hold others: the median of several, and set membership on any base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError
from softneck.identification import Ensemble, Model, Play, Residual, SetMembership, combine
from softneck.identification.models._arrays import check_arrays
from softneck.runtime import bundle
from softneck.runtime._bundle import prefixed

from ...data import neck_recording, short_neck

UNSEEN = neck_recording(200, seed=31)


def test_an_ensemble_is_the_median_of_its_members_and_its_bounds_are_their_range(models: dict[str, Model]) -> None:
    members = [models[kind] for kind in ("rls", "play", "nn")]
    joined = combine(members).simulate(UNSEEN)
    each = np.array([member.simulate(UNSEEN)[:, :5] for member in members])
    # Each member's start is held as long as the slowest asks for; after 2 s that has died out.
    joined, each = joined[100:], each[:, 100:]
    np.testing.assert_allclose(joined[:, :2], np.median(each[:, :, :2], axis=0), rtol=0, atol=1e-8)
    np.testing.assert_allclose(joined[:, [5, 7]], each[:, :, :2].min(axis=0), rtol=0, atol=1e-8)
    np.testing.assert_allclose(joined[:, [6, 8]], each[:, :, :2].max(axis=0), rtol=0, atol=1e-8)
    np.testing.assert_allclose(joined[:, 2:5], each[0][:, 2:5], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_two_equal_members_are_the_member(models: dict[str, Model]) -> None:
    twice = combine([models["play"], models["play"]])
    np.testing.assert_allclose(twice.predict(UNSEEN)[:, :5], models["play"].predict(UNSEEN)[:, :5], rtol=0, atol=1e-12)


@pytest.mark.parametrize("still", [("roll",), ("pitch", "roll")])
def test_a_residual_takes_an_output_that_stands_still_where_it_is_judged(still: tuple[str, ...]) -> None:
    neck = short_neck()
    stopped = {name: neck.channels[name].copy() for name in still}
    for values in stopped.values():
        values[-len(neck) // 4 :] = 0.1  # such a stretch has no fit: the others decide, or the noise alone
    model = Residual(base="rls").fit(neck.with_channels(**stopped))
    assert np.isfinite(model.simulate(UNSEEN)).all()


def test_a_residual_on_rls_is_set_membership_of_form_residual() -> None:
    recording = short_neck()
    ours = Residual(base="rls", epsilon=0.02).fit(recording)
    theirs = SetMembership(form="residual", base="rls", epsilon=0.02, output_weight=5.0).fit(recording)
    assert ours.findings["gamma"] == pytest.approx(theirs.findings["gamma"], rel=1e-12)
    # Two programs of one method: rounding only.
    np.testing.assert_allclose(ours.simulate(UNSEEN)[:, :-1], theirs.simulate(UNSEEN)[:, :-1], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_bounds_of_a_residual_hold_on_the_rows_it_was_made_of() -> None:
    recording = short_neck()
    model = Residual(base="play").fit(recording)
    Y = model.simulate(recording, warm_up=1)[150:]
    y = recording.outputs[150:]
    # Up to what the warm-up of one sample still moves after three seconds.
    assert (Y[:, [5, 7]] - 1e-6 <= y).all()
    assert (y <= Y[:, [6, 8]] + 1e-6).all()


def test_what_the_set_adds_is_bounded_and_never_fed_back(models: dict[str, Model]) -> None:
    base = Play(rate=15.0, widths=(), degree=2, ridge=1e-4).fit(short_neck())
    model = Residual().on(base, short_neck())
    added = model.simulate(UNSEEN, warm_up=1)[100:, :2] - base.simulate(UNSEEN, warm_up=1)[100:, :2]
    points = model.arrays["values"]
    reach = np.abs(points).max() + model.arrays["bounds"][:, 1].max()
    assert np.abs(added).max() <= reach
    rng = np.random.default_rng(1)
    for _ in range(100):
        U = np.full((150, 8), np.nan)
        U[:, :3] = np.repeat(rng.uniform(-6, 6, (15, 3)), 10, axis=0)
        y = model.block().run(model.block().initial_state(), U)[1][:, :2]
        assert np.abs(y).max() <= np.abs(base.arrays["range"]).max() + reach + 1.0


def test_members_are_named_and_cannot_hold_others(models: dict[str, Model]) -> None:
    with pytest.raises(SettingsError, match="needs at least two models; got 1"):
        combine([models["rls"]])
    with pytest.raises(SettingsError, match="holds others itself"):
        combine([combine([models["rls"], models["play"]]), models["rls"]])
    with pytest.raises(SettingsError, match="must have one sample time"):
        combine([models["rls"], replace(models["play"], sample_time=0.01)])
    with pytest.raises(SettingsError, match="at least two members; got rls"):
        Ensemble(members=("rls",))
    with pytest.raises(SettingsError, match="unknown kind of model `magic`"):
        Ensemble(members=("rls", "magic"))
    with pytest.raises(SettingsError, match="cannot be a member"):
        Ensemble(members=("rls", "residual"))
    with pytest.raises(SettingsError, match="cannot be a base"):
        Residual(base="ensemble")


def test_an_ensemble_is_fitted_by_name() -> None:
    model = Ensemble(members=("rls", "play")).fit(short_neck())
    assert model.findings["members"] == "rls, play"
    assert model.training_rows.size == 500
    assert "members: rls, play" in model.summary()


def test_crafted_members_are_refused(models: dict[str, Model]) -> None:
    arrays = dict(combine([models["rls"], models["play"]]).arrays)
    check_arrays("ensemble", arrays)
    renamed = {name.replace("1.play", "1.ensemble"): array for name, array in arrays.items()}
    with pytest.raises(FileFormatError, match="belongs to no member in order"):
        check_arrays("ensemble", renamed)
    with pytest.raises(FileFormatError, match="cannot have 2 members"):
        check_arrays(
            "residual", {**models["any"].arrays, **{f"1.{n[2:]}": a for n, a in arrays.items() if n[0] == "0"}}
        )
    swapped = {**arrays, "0.rls.delay": arrays["0.rls.delay"] + 1e6}
    with pytest.raises(FileFormatError, match="a dead time"):
        check_arrays("ensemble", swapped)


def test_names_of_a_member_get_a_prefix_and_nothing_else_changes() -> None:
    text = "SIZE = 2\nCOMPILED = 0\n\ndef size(SIZE):\n    return SIZE\n\ndef f(x):\n    return size(x) + SIZE"
    space: dict = {}
    exec(prefixed(text, "m0_"), space)
    assert space["m0_f"](3) == 5
    assert space["COMPILED"] == 0
    assert "f" not in space


def test_a_module_without_members_takes_none() -> None:
    plain = "softneck.identification.linear._rls_runtime"
    with pytest.raises(SettingsError, match="does not declare its Arrays"):
        bundle(f"softneck.runtime._members_runtime({plain}:6)")
