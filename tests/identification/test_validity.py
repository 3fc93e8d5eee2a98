"""The output `validity`: last of every kind, a probability, falling with the distance from what was seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError, load
from softneck.identification import Model, OutputError, Play, validate
from softneck.identification.models._arrays import without_validity
from softneck.identification.models._validity import (
    find_farthest_motor,
    has_validity,
    tolerance_of,
    with_tolerance,
    with_validity_region,
)
from softneck.identification.models._validity_runtime import ground_outside
from softneck.report._validation_page import validation_page
from softneck.signals import Excitation, Recording, signal

from ..data import ROOT

TS, ROWS = 0.02, 1500
GOLDEN = ROOT / "tests" / "golden"
PLANTS = (
    "rls",
    "oe",
    "nlsm",
    "play",
    "greybox",
    "nn",
    "guarded",
)
PLAY = Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4)


def recorded(excitation: Excitation, gain: float = 1.0) -> Recording:
    """A neck of two slow poles, bent a little: something that a line misses by a degree or two."""
    P = excitation.set_points
    drive = np.column_stack([P[:, 0] - 0.5 * (P[:, 1] + P[:, 2]), 0.866 * (P[:, 1] - P[:, 2])])
    y = np.zeros((len(P), 2))
    for k in range(len(P) - 1):
        y[k + 1] = 0.92 * y[k] + 0.007 * np.tanh(0.6 * gain * drive[k]) / 0.6
    names = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "pitch", "roll")
    return Recording(excitation.time, TS, dict(zip(names, np.column_stack([P, y]).T, strict=True)))


@pytest.fixture(scope="module")
def training() -> Recording:
    return recorded(signal("eq22", duration=ROWS * TS))


@pytest.fixture(scope="module")
def line(training: Recording) -> Model:
    return OutputError(delay=0.0).fit(training)


@pytest.mark.parametrize("kind", PLANTS)
def test_the_last_output_of_every_kind_is_validity(kind: str) -> None:
    model = load(GOLDEN / f"{kind}.npz")
    assert model.block().outputs[-1].name == "validity"
    assert [port.name for port in model.block().outputs].count("validity") == 1


def test_it_is_a_probability_in_everything_that_a_model_returns(line: Model, training: Recording) -> None:
    for outputs in (line.simulate(training), line.predict(training), line.predict(training, 5)):
        assert ((outputs[:, -1] > 0.0) & (outputs[:, -1] <= 1.0)).all()
    state = line.initial_state(training)
    state, outputs = line.step(state, training.set_points[0])
    assert 0.0 < outputs[-1] <= 1.0
    assert state.outputs[-1] == outputs[-1]


def test_the_other_outputs_are_to_the_bit_what_they_are_without_it(line: Model, training: Recording) -> None:
    bare = replace(line, arrays=without_validity(line.arrays))
    np.testing.assert_array_equal(line.simulate(training)[:, :-1], bare.simulate(training)[:, :-1])
    assert (bare.simulate(training)[:, -1] == 0.0).all()


def test_it_falls_with_the_distance_of_the_motors(line: Model) -> None:
    rows = np.full((400, len(line.block().inputs)), np.nan)
    least = 1.0
    for size in (0.0, 2.0, 4.0, 8.0, 16.0):
        rows[:, :3] = size
        settled = line.block().run(line.initial_state(use_measurement=0.0), rows)[1][-1, -1]
        assert settled <= least
        least = settled
    assert least < 0.2


def test_what_is_held_is_farther_than_what_passes_by(line: Model, training: Recording) -> None:
    """Eq. 22 never stays: held long at a place that it passes, the motors are where they have never been held."""
    place = training.set_points[int(np.argmax(training.set_points[:, 0]))]
    rows = np.full((300, len(line.block().inputs)), np.nan)
    rows[:, :3] = place
    outputs = line.block().run(line.initial_state(training), rows)[1]
    assert outputs[-1, -1] < 0.5 * line.simulate(training)[:, -1].mean()


def test_the_runtime_computes_what_the_formula_says(line: Model, training: Recording) -> None:
    """validity = 1 / (1 + max(v + slope outside)), of the motors and of where they have been held for a second."""
    outputs = line.simulate(training)
    # These motors are where they are sent.
    m, slow = training.set_points, training.set_points[0].copy()
    ground, doubt = line.arrays["ground"], line.arrays["doubt"]
    for k in range(300):
        slow += 0.02 * (m[k] - slow)
        outside = max(np.sum((ground[:, 1:] @ np.concatenate([m[k], slow]) - ground[:, 0]) ** 2) - 1.0, 0.0)
        expected = 1.0 / (1.0 + np.max(doubt[:, 0] + doubt[:, 1] * outside))
        # Sums in another order.
        assert outputs[k + 1, -1] == pytest.approx(expected, rel=1e-9)


def test_within_the_training_three_of_four_rows_are_inside(line: Model, training: Recording) -> None:
    outputs = line.simulate(training)
    inside = 1.0 / outputs[26:, -1] - 1.0 <= line.arrays["doubt"][:, 0].max() * (1.0 + 1e-9)
    assert inside.mean() == pytest.approx(0.75, abs=0.01)


def test_a_model_that_misses_more_in_training_is_trusted_less(line: Model, training: Recording) -> None:
    worse = with_validity_region(replace(line, arrays={**line.arrays, "b": 2.0 * line.arrays["b"]}), training)
    assert worse.simulate(training)[:, -1].mean() < line.simulate(training)[:, -1].mean()


def test_a_file_keeps_it(line: Model, training: Recording, tmp_path: Path) -> None:
    line.save(tmp_path / "line.npz")
    again = load(tmp_path / "line.npz")
    np.testing.assert_array_equal(again.simulate(training), line.simulate(training))
    tolerance = tolerance_of(again)
    assert tolerance is not None
    # Two degrees to the twelve digits of a file.
    np.testing.assert_allclose(np.degrees(tolerance), 2.0, rtol=1e-10)


def test_another_tolerance_scales_what_is_doubted(line: Model, training: Recording) -> None:
    """doubt is variance over the tolerance squared: validity 1/(1 + x) becomes 1/(1 + x (2/5)^2), in the file too."""
    wider = with_tolerance(line, 5.0)
    odds = [1.0 / model.simulate(training)[:, -1] - 1.0 for model in (line, wider)]
    np.testing.assert_allclose(odds[1], odds[0] * (2.0 / 5.0) ** 2, rtol=1e-9)  # the digits of the finding, twice
    assert wider.findings["validity_within_deg"] == [5.0, 5.0]
    asked = validate(line, training, include_training=True, horizons=("inf",), tolerance=5.0)
    assert asked.validity == validate(wider, training, include_training=True, horizons=("inf",)).validity
    with pytest.raises(SettingsError, match=r"`tolerance` must be positive \[deg\]; got 0"):
        with_tolerance(line, 0.0)
    with pytest.raises(DataError, match="which this model does not have: identify it again"):
        with_tolerance(load(GOLDEN / "oe.npz"), 5.0)


def test_an_older_file_says_that_it_has_none(training: Recording) -> None:
    model, network = load(GOLDEN / "oe.npz"), load(GOLDEN / "nn.npz")
    assert network.summary().count("guarded form exists") == 1
    assert not has_validity(model)
    assert (model.simulate(training)[:, -1] == 0.0).all()
    assert "no validity in this file: identify it again" in model.summary()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("ground", lambda a: a[:, :-1], "its array `ground` has shape"),
        ("ground", lambda a: a * np.nan, "`ground` is not of finite floats"),
        ("doubt", lambda a: -a, "must hold three variances"),
        ("doubt", lambda a: a[:1], "must hold three variances"),
    ],
)
def test_a_broken_file_says_what_is_wrong(line: Model, tmp_path: Path, name: str, change: object, message: str) -> None:
    broken = replace(line, arrays={**line.arrays, name: np.ascontiguousarray(change(line.arrays[name]))})  # pyright: ignore
    broken.save(tmp_path / "broken.npz")
    with pytest.raises(FileFormatError, match=message):
        load(tmp_path / "broken.npz")


def test_the_motor_to_blame_is_named(line: Model) -> None:
    motors = np.zeros((500, 3))
    motors[:, 1] = 9.0
    place, _, value, times = find_farthest_motor(line.block(), motors)
    assert (place, value) == (1, pytest.approx(9.0, rel=1e-3))
    assert times > 2.0


def test_linear_systems_have_no_validity_and_derivatives_do(line: Model) -> None:
    assert line.linearize().noutputs == 5
    state = line.initial_state()
    for _ in range(10):
        state, _ = line.step(state, [3.0, -1.0, 2.0])
    u, h, n = np.array([2.9, -1.0, 2.0]), 1e-6, state.values.size
    J = line.jacobian(state, u)
    assert J.C.shape == (6, n)
    dx, du = np.random.default_rng(0).standard_normal(n), np.array([1.0, -2.0, 0.5])
    dx[np.abs(state.values) > 1e3] = 0.0  # the generator of random numbers
    ends = [line.step(replace(state, values=state.values + s * dx), u + s * du)[1][-1] for s in (h, -h)]
    # h^2 times the third derivative, and 1e-16 / h of rounding.
    assert J.C[-1] @ dx + J.D[-1] @ du == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-6)


def test_validate_scores_it_on_rows_that_were_not_trained_on(line: Model) -> None:
    steps = recorded(signal("steps"))
    result = validate(line, steps, horizons=(1, "inf"))
    assert "Brier score" in validation_page([result])
    found = result.as_dict()["validity"]
    assert 0.0 < found["least"] <= found["mean"] <= 1.0
    assert found["brier_base_rate"] == pytest.approx(found["held"] * (1.0 - found["held"]))
    assert sum(row["rows"] for row in found["reliability"]) == len(steps) - 25
    errors = np.abs(steps.outputs - line.simulate(steps)[:, :2])[25:]
    assert found["held"] == pytest.approx((errors <= np.radians(2.0)).all(axis=1).mean())


def test_where_no_motor_has_been_every_direction_is_outside() -> None:
    class Numbers:
        motors = 1
        ground = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

    slow = np.zeros(1)
    assert ground_outside(Numbers(), np.array([0.5]), slow) == 0.0  # pyright: ignore
    assert ground_outside(Numbers(), np.array([3.0]), slow) == pytest.approx(8.0 + slow[0] ** 2)  # pyright: ignore
