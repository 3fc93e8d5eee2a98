"""All kinds as one model: step, simulate and predict agree, and a file keeps every bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError, load
from softneck.identification import WARM_UP, Model, embed_model, embedded_model
from softneck.signals import Recording, concatenate

from ..data import TS, neck_recording

# By the name of the shared models: "residual" is the other form of kind "nlsm".
KINDS = (
    "rls",
    "nlsm",
    "residual",
    "play",
    "nn",
    "greybox",
    "guarded",
    "mimo",
    "oe",
    "oe2",
)
UNSEEN = neck_recording(120, seed=21)


@pytest.mark.parametrize("kind", KINDS)
def test_a_loop_over_step_is_simulate(models: dict[str, Model], kind: str) -> None:
    model = models[kind]
    Y = model.simulate(UNSEEN)
    state = model.initial_state(UNSEEN)
    assert state.outputs.tobytes() == Y[0].tobytes()
    for k in range(len(UNSEEN) - 1):
        measured = np.concatenate([UNSEEN.outputs[k], UNSEEN.motor_positions[k]]) if k < WARM_UP else None
        state, y = model.step(state, UNSEEN.set_points[k], measured=measured)
        assert y.tobytes() == Y[k + 1].tobytes(), k


@pytest.mark.parametrize("kind", KINDS)
def test_a_free_run_sees_no_measurement_after_its_warm_up(models: dict[str, Model], kind: str) -> None:
    model = models[kind]
    spoilt = {name: UNSEEN.channels[name].copy() for name in ("pitch", "roll", "motor_position_1")}
    for values in spoilt.values():
        values[WARM_UP:] = 0.3
    np.testing.assert_array_equal(model.simulate(UNSEEN.with_channels(**spoilt)), model.simulate(UNSEEN))
    # With motors="measured" the logged positions count throughout, for those kinds that look at them.
    given = model.simulate(UNSEEN.with_channels(**spoilt), motors="measured")
    assert (np.abs(given[:, :2] - model.simulate(UNSEEN)[:, :2]).max() > 0) == (kind not in ("rls", "mimo", "oe2"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("horizon", [1, 4])
def test_predict_is_a_restart_from_what_was_known(models: dict[str, Model], kind: str, horizon: int) -> None:
    model = models[kind]
    predicted = model.predict(UNSEEN, horizon)
    for k in (horizon, 30, 77):
        # Measured until k - horizon, then free: simulate with that warm-up says the same of row k.
        free = model.simulate(UNSEEN, warm_up=k - horizon + 1)
        assert free[k].tobytes() == predicted[k].tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_not_measured_is_simulated(models: dict[str, Model], kind: str) -> None:
    model = models[kind]
    state = model.initial_state(UNSEEN)
    _, free = model.step(state, UNSEEN.set_points[0])
    for measured in ([np.nan] * 2, [np.nan] * 5):
        assert model.step(state, UNSEEN.set_points[0], measured=measured)[1].tobytes() == free.tobytes()
    assert model.step(state, UNSEEN.set_points[0], measured=[0.2, 0.2])[1].tobytes() != free.tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_runs_are_simulated_one_by_one(models: dict[str, Model], kind: str) -> None:
    model, other = models[kind], neck_recording(90, seed=22)
    both = model.simulate(concatenate([UNSEEN, other]))
    np.testing.assert_array_equal(both, np.vstack([model.simulate(UNSEEN), model.simulate(other)]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_keeps_every_bit(models: dict[str, Model], kind: str, tmp_path: Path) -> None:
    model = models[kind]
    model.save(tmp_path / "m.npz")
    back = load(tmp_path / "m.npz")
    assert list(back.arrays) == list(model.arrays)
    assert all(back.arrays[name].tobytes() == model.arrays[name].tobytes() for name in model.arrays)
    assert back.simulate(UNSEEN).tobytes() == model.simulate(UNSEEN).tobytes()
    assert back.summary() == model.summary()
    np.testing.assert_array_equal(back.training_rows, model.training_rows)
    assert load(tmp_path / "m.npz").kind == model.kind


CRAFTED = [
    ("rls", "a", lambda a: a * np.nan, "`a` is not of finite floats"),
    ("rls", "history", lambda a: a * 0 + 1e12, "history in samples is not a whole number"),
    ("rls", "delay", lambda a: a + 1e6, "a dead time is not a whole number"),
    ("rls", "drive", lambda a: a - 50.0, "a drive's delay"),
    ("rls", "redefinition", lambda a: a[:1], "the number of redefined inputs"),
    ("mimo", "A", lambda a: a[:, :-1], "`A` has shape"),
    ("oe", "source", lambda a: a + 1.0, "the source is not a whole number"),
    ("oe2", "delay", lambda a: a + 1e6, "a dead time is not a whole number"),
    ("mimo", "K", lambda a: a[:-1], "`K` has shape"),
    ("nlsm", "table", lambda a: a + 100.0, "a regressor's source"),
    ("nlsm", "points", lambda a: a[:, :, :5], "`(points|values)` has shape"),
    ("nlsm", "nodes", lambda a: a[:, :4], "`nodes` is not the tree over its points"),
    ("nlsm", "nodes", lambda a: a * 0.0, "`nodes` is not the tree over its points"),
    ("nlsm", "nodes", lambda a: a + 1.0, "`nodes` is not the tree over its points"),
    ("nlsm", "frame", lambda a: 1.001 * a, "`frame` are not orthogonal"),
    ("nlsm", "frame", lambda a: a[:, :-1], "`frame` are not orthogonal"),
    ("nlsm", "frame", lambda a: a[:, ::-1], "`nodes` is not the tree over its points"),
    ("residual", "delay", lambda a: a + 1e6, "a dead time"),
    ("residual", "a", lambda a: a[:1], "`a` has shape"),
    ("residual", "table", lambda a: np.where(a == [3, 1, 1], [3, 2, 1], a), "a regressor's output"),
    ("play", "table", lambda a: a + 100.0, "a term's signal"),
    ("play", "chain", lambda a: a + 0.5, "the order of the filters"),
    ("play", "echo", lambda a: a[:1], "`echo` has shape"),
    ("play", "memory", lambda a: a * 1e9, "its memory in samples"),
    ("greybox", "neck", lambda a: a * 1e6, "(drive_rate of .* is out of range|directions of its tendons)"),
    ("greybox", "sensor", lambda a: a + 0.5, "the sensor's dead time"),
    ("guarded", "memory", lambda a: a * 1e9, "its memory in samples"),
    ("guarded", "3.nn.w3", lambda a: a * np.nan, "`w3` is not of finite floats"),
    ("nn", "W2", lambda a: a[:, :, :-1], "`W2` has shape"),
]


@pytest.mark.parametrize(("kind", "name", "change", "message"), CRAFTED)
def test_a_crafted_file_never_reaches_the_compiled_code(
    kind: str, name: str, change: Callable, message: str, models: dict[str, Model], tmp_path: Path
) -> None:
    arrays = dict(models[kind].arrays)
    arrays[name] = np.ascontiguousarray(change(arrays[name]))
    Model(kind=models[kind].kind, sample_time=TS, arrays=arrays).save(tmp_path / "m.npz")
    with pytest.raises(FileFormatError, match=message):
        load(tmp_path / "m.npz")


def test_another_sample_time_is_refused(models: dict[str, Model]) -> None:
    slow = Recording(UNSEEN.time * 1.05, 0.021, UNSEEN.channels)
    for judge in (models["rls"].simulate, models["rls"].predict):
        with pytest.raises(DataError, match=r"identified at 0\.02 s and the recording is at 0\.021 s"):
            judge(slow)


def test_wrong_sizes_and_horizons_are_refused(models: dict[str, Model]) -> None:
    model = models["rls"]
    state = model.initial_state()
    with pytest.raises(DataError, match="`inputs` must have 3 entries; got 2"):
        model.step(state, [0, 0])
    with pytest.raises(DataError, match="`measured` must have 2 or 5 entries"):
        model.step(state, [0, 0, 0], measured=[0, 0, 0])
    with pytest.raises(SettingsError, match="`horizon` must be a whole number between 1 and"):
        model.predict(UNSEEN, 0)
    with pytest.raises(DataError, match="a run needs at least 2 rows; got 1"):
        model.simulate(UNSEEN.rows(0, 1))


def test_a_state_at_rest_starts_where_it_is_told(models: dict[str, Model]) -> None:
    state = models["rls"].initial_state(pitch_start=0.1, roll_start=-0.2)
    np.testing.assert_array_equal(state.outputs[:-1], [0.1, -0.2, 0, 0, 0])


def test_noise_has_its_size_and_leaves_the_state_alone(models: dict[str, Model]) -> None:
    block = models["rls"].block()
    U = np.zeros((4000, 8))
    clean, noisy = (block.run(block.initial_state(noise_std=s, noise_seed=3), U)[1][:, :2] for s in (0.0, 0.01))
    error = noisy - clean
    # Standard error of a standard deviation of 8,000 numbers: 0.8 %; five of those.
    assert error.std() == pytest.approx(0.01, rel=0.04)
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 5 / np.sqrt(4000)


@pytest.mark.parametrize(
    "seen", [{"min": [0.0] * 3}, {"min": [0.0] * 2, "max": [1.0] * 2}, [0.0], {"min": 0, "max": 1}]
)
def test_a_file_with_half_a_range_of_set_points_is_refused(models: dict[str, Model], seen: object) -> None:
    header, arrays = embed_model(models["rls"])
    with pytest.raises(FileFormatError, match="a minimum and a maximum for each motor"):
        embedded_model({**header, "findings": {"set_points_rad": seen}}, arrays)
