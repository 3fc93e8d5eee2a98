"""Adapting a model: it never gets worse on what it is judged by, and what says nothing changes nothing."""

from __future__ import annotations

import time

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load
from softneck.identification import (
    WARM_UP,
    GreyBox,
    Model,
    Network,
    OutputError,
    Play,
    Rls,
    nrmse_fit,
)
from softneck.identification._adapt import (
    ADAPTING,
    Adaptation,
    FreeParameters,
    derivatives,
    reference,
    simulate_outputs,
)
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

from ...data import slow_but

# Fitting the others takes seconds.
KINDS = slow_but(ADAPTING, ("oe", "play"))
NECK = VirtualNeck(NeckParameters.rough())
SETTINGS = {
    "oe": OutputError(),
    "play": Play(rate=6.0, widths=(0.3,), degree=2),
    "greybox": GreyBox(sensor_delay=2, evaluations=10),
    "nn": Network(hidden=(6, 6), starts=1, iterations=6, refine=3),
}


def loaded(motion: str, payload: float, seed: int, seconds: float = 30.0) -> Recording:
    made = record(signal(motion), NECK, seed=seed, payload=payload)
    return made.rows(0, round(seconds / made.sample_time))


@pytest.fixture(scope="module")
def empty() -> Recording:
    return loaded("eq22", 0.0, 1, 60.0)


@pytest.fixture(scope="module")
def window() -> Recording:
    return loaded("rotation", 1.0, 7)


class Trained(dict[str, Model]):
    """Models of the empty neck, each fitted when it is first asked for."""

    def __missing__(self, kind: str) -> Model:
        self[kind] = SETTINGS[kind].fit(loaded("eq22", 0.0, 1, 60.0))
        return self[kind]


@pytest.fixture(scope="module")
def old() -> Trained:
    return Trained()


def fits(model: Model, run: Recording) -> list[float]:
    free = model.simulate(run)[WARM_UP + 1 :]
    return [nrmse_fit(run.outputs[WARM_UP + 1 :, axis], free[:, axis]) for axis in range(2)]


def same_arrays(one: Model, other: Model) -> bool:
    return all(np.array_equal(array, other.arrays[name]) for name, array in one.arrays.items())


@pytest.mark.parametrize("kind", KINDS)
def test_an_adapted_model_follows_the_neck_it_saw_and_is_better_on_a_run_it_did_not(
    old: Trained, window: Recording, kind: str, tmp_path
) -> None:
    new = old[kind].adapt(window)
    said = new.findings["adaptation"]
    assert said["adapted"]
    assert all(after >= before for before, after in zip(said["fit_before"], said["fit_after"], strict=True))
    # The same motion with other noise: a law only in so far as the change is one that the numbers can follow.
    again = loaded("rotation", 1.0, 8)
    assert sum(fits(new, again)) > sum(fits(old[kind], again)) + 1.0
    new.save(tmp_path / "new.npz")
    np.testing.assert_array_equal(load(tmp_path / "new.npz").simulate(again), new.simulate(again))


@pytest.mark.parametrize("kind", KINDS)
def test_thirty_seconds_take_less_than_two_of_processor_time(old: Trained, window: Recording, kind: str) -> None:
    old[kind].adapt(window)  # compiles
    begun = time.process_time()
    old[kind].adapt(window)
    assert time.process_time() - begun < 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_neck_that_stands_still_changes_nothing_but_what_is_said(old: Trained, kind: str) -> None:
    held = loaded("rotation", 1.0, 3)
    U = np.full(len(held), 1.0)
    still = held.with_channels(
        **dict.fromkeys(held.robot.set_points, U), pitch=np.full(len(held), 0.2), roll=np.full(len(held), 0.1)
    )
    new = old[kind].adapt(still)
    assert same_arrays(new, old[kind])
    assert new.training_rows.tobytes() == old[kind].training_rows.tobytes()
    assert "hardly moves" in new.findings["adaptation"]["why"]


def test_where_nothing_is_better_on_the_rows_held_out_the_old_model_is_kept(old: Trained) -> None:
    # The model is exact on the rows held out, every third block of 2 s, and 20 % off between them.
    run = loaded("rotation", 0.0, 4)
    exact = old["oe"]
    told = exact.simulate(run)
    perfect = run.with_channels(pitch=told[:, 0].copy(), roll=told[:, 1].copy())
    for name in ("pitch", "roll"):
        values = perfect.channels[name].copy()
        blocks = np.arange(len(run)) // 100
        values[blocks % 3 != 2] *= 1.2
        perfect = perfect.with_channels(**{name: values})
    new = exact.adapt(perfect)
    assert same_arrays(new, exact)
    assert new.findings["adaptation"]["why"] == "no adapted model is better on the rows held out"


def test_one_output_does_not_pay_for_another(old: Trained) -> None:
    # Pitch answers a fifth more everywhere; roll a little more where it is learnt from, and worse where it is judged.
    run = loaded("rotation", 0.0, 4)
    told = old["oe"].simulate(run)
    known = np.arange(len(run)) // 100 % 3 != 2
    seen = run.with_channels(pitch=1.2 * told[:, 0], roll=np.where(known, 1.02, 1.0) * told[:, 1])
    new = old["oe"].adapt(seen)
    assert new.findings["adaptation"]["why"] == "no adapted model is better on the rows held out"
    assert same_arrays(new, old["oe"])


def test_missing_stretches_are_not_learnt_from(old: Trained, window: Recording) -> None:
    holes = {name: window.channels[name].copy() for name in ("pitch", "roll")}
    for values in holes.values():
        values[300:450] = np.nan
        values[:10] = np.nan
    spoilt = window.with_channels(**holes)
    new = old["play"].adapt(spoilt)
    assert new.findings["adaptation"]["adapted"]
    assert all(np.isfinite(array).all() for array in new.arrays.values())
    # What stood in the holes does not matter: only what was measured is looked at.
    assert sum(fits(new, loaded("rotation", 1.0, 8))) > sum(fits(old["play"], loaded("rotation", 1.0, 8)))


@pytest.mark.parametrize("seconds", [None, 0.5], ids=["never measured", "too short"])
def test_a_window_without_a_run_measured_keeps_the_model_and_says_so(
    old: Trained, window: Recording, seconds: float | None
) -> None:
    nothing = np.full(len(window), np.nan)
    unseen = window if seconds else window.with_channels(pitch=nothing, roll=nothing)
    new = old["oe"].adapt(unseen, window=seconds or 30.0)
    assert same_arrays(new, old["oe"])
    assert "no run of the window goes on for more than 0.52 s" in new.findings["adaptation"]["why"]


def test_an_output_that_is_not_measured_cannot_be_judged(old: Trained, window: Recording) -> None:
    pitch = window.channels["pitch"].copy()
    pitch[30:] = np.nan
    new = old["oe"].adapt(window.with_channels(pitch=pitch))
    assert same_arrays(new, old["oe"])
    assert "an output was measured in too few" in new.findings["adaptation"]["why"]


def test_only_the_latest_seconds_count(old: Trained, window: Recording) -> None:
    early = {name: window.channels[name].copy() for name in ("pitch", "roll")}
    for values in early.values():
        values[:500] = 0.4
    changed = old["play"].adapt(window.with_channels(**early), window=20.0)
    assert same_arrays(changed, old["play"].adapt(window, window=20.0))


@pytest.mark.slow
def test_motion_of_one_direction_is_refused_and_the_missing_one_named(old: Trained, window: Recording) -> None:
    theta = np.repeat(window.set_points[:, :1], 3, axis=1) * [1.0, -0.5, -0.5]
    names = window.robot.set_points
    one = window.with_channels(**dict(zip(names, theta.T, strict=True)))
    new = old["oe"].adapt(one)
    assert same_arrays(new, old["oe"])
    assert new.findings["adaptation"]["why"] == "the window moves the robot along one direction; add motion of roll"
    assert not old["oe"].adapt(window).findings["adaptation"]["why"].startswith("the window")


def test_payload_and_a_biased_sensor_at_once(old: Trained, window: Recording) -> None:
    both = window.with_channels(pitch=window.channels["pitch"] + np.radians(2.0))
    judged = loaded("rotation", 1.0, 8)
    judged = judged.with_channels(pitch=judged.channels["pitch"] + np.radians(2.0))
    for kind in ("play", "greybox"):
        new = old[kind].adapt(both)
        assert new.findings["adaptation"]["adapted"]
        assert fits(new, judged)[0] > fits(old[kind], judged)[0] + 1.0


def test_a_stronger_prior_leaves_more_of_what_the_window_does_not_move(old: Trained) -> None:
    # All motors: data of one direction alone would leave the model as it is.
    run = loaded("steps", 1.0, 5, 26.0)
    motion = reference(old["play"])
    before = simulate_outputs(old["play"], motion)
    moved = [
        float(np.abs(simulate_outputs(Adaptation(strength=s).of(old["play"], run), motion) - before).mean())
        for s in (0.1, 100)
    ]
    assert moved[1] < moved[0]


@pytest.mark.parametrize("kind", slow_but(SETTINGS, ("oe", "play")))
def test_numbers_that_move_together_have_the_derivatives_they_have_alone(
    old: Trained, window: Recording, kind: str
) -> None:
    free, run = FreeParameters.of(old[kind]), window.rows(0, 200)
    J = derivatives(free, free.start(), lambda model: simulate_outputs(model, run))
    for place in (0, J.shape[0] // 2, J.shape[0] - 1):
        x = free.start()
        x[place] += 1e-4 * free.sizes()[place]
        alone = (simulate_outputs(free.at(x), run) - simulate_outputs(old[kind], run)) / 1e-4
        # Differences of the same step: only rounding over the step is left, 1e-16 / 1e-4 with a margin of 1e4.
        np.testing.assert_allclose(J[place], alone, atol=1e-8)


def test_the_numbers_are_those_of_the_model(old: Trained, window: Recording) -> None:
    for kind in ("oe", "play", "greybox"):
        free = FreeParameters.of(old[kind])
        # Logarithms of the grey box go there and back: rounding.
        np.testing.assert_allclose(
            simulate_outputs(free.at(free.start()), window), simulate_outputs(old[kind], window), atol=1e-9
        )


def test_a_weak_prior_ends_where_the_estimator_does(window: Recording, old: Trained) -> None:
    """Independent method: output error on the same rows, whose optimum a warm start without prior must reach."""
    model = Adaptation(strength=1e-9, block=0.04).of(old["oe"], window)
    refit = OutputError(delay=float(old["oe"].arrays["delay"][0]) * window.sample_time).fit(window)
    # A third of the rows is not learnt from, and starts are found otherwise: a fit within half a point.
    assert fits(model, window)[0] > fits(refit, window)[0] - 0.5


def test_an_adapted_model_knows_its_rows_and_doubts_itself_no_less(old: Trained, window: Recording) -> None:
    new = old["play"].adapt(window)
    assert new.training_rows.size == old["play"].training_rows.size + len(window)
    assert (new.arrays["doubt"][:, 0] >= old["play"].arrays["doubt"][:, 0]).all()


def test_a_kind_that_cannot_adapt_says_so(empty: Recording, window: Recording) -> None:
    with pytest.raises(SettingsError, match="kind `rls` cannot adapt; oe, play, nn, greybox can"):
        Rls().fit(empty).adapt(window)


def test_another_sample_time_is_refused(old: Trained, window: Recording) -> None:
    slow = Recording(2.0 * window.time, 2.0 * window.sample_time, window.channels)
    with pytest.raises(DataError, match="resample"):
        old["oe"].adapt(slow)
    with pytest.raises(SettingsError, match="window"):
        old["oe"].adapt(window, window=0.0)
