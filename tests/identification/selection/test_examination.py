"""The first figure of a model: the worst fit on what a training did not see, with the name of that part."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from softneck.core import DataError, silent
from softneck.identification import Model, Play, SetMembership, identify, with_tolerance
from softneck.identification.models._left_out import folds
from softneck.identification.models._validity import calibrate_validity, tolerance_of
from softneck.identification.selection._examination import (
    Examination,
    examine,
    other_motion,
    shortened,
    unseen_rows,
)
from softneck.identification.structured._greybox import GreyBox
from softneck.robot import Robot
from softneck.signals import Recording, concatenate

from ...data import neck_recording, recording_from


@pytest.fixture(scope="module")
def model() -> Model:
    return identify("rls", neck_recording(1500))


def test_the_hold_out_is_a_part_and_the_worst_of_all_parts_is_the_figure(model: Model) -> None:
    found = model.findings["examination"]
    each = {(part, name): fit for part, fits in found["parts"].items() for name, fit in fits.items()}
    # The same rows by another way: `validate` has its own scores.
    assert found["parts"]["hold-out"] == pytest.approx(model.findings["hold_out"]["fit"], abs=1e-9)
    assert found["fit"] == min(each.values()) == each[found["part"], found["output"]]
    assert {"largest motions", "fastest motions", "second training"} <= found["parts"].keys()


def test_a_line_misses_the_largest_motions_of_what_saturates_and_no_motion_of_a_line(model: Model) -> None:
    recording = neck_recording(1500)
    size = np.nanstd(recording.outputs, axis=0)
    bent = {name: np.tanh(y / s) for name, y, s in zip(("pitch", "roll"), recording.outputs.T, size, strict=True)}
    missed = identify("rls", recording.with_channels(**bent)).findings["examination"]["parts"]
    assert missed["largest motions"]["pitch"] < missed["hold-out"]["pitch"] - 2.0
    line = model.findings["examination"]["parts"]
    # Noise alone is left: both parts differ by what a few hundred rows of it do.
    assert line["largest motions"]["pitch"] == pytest.approx(line["hold-out"]["pitch"], abs=2.0)


def test_the_summary_begins_with_it_and_says_what_to_record(model: Model) -> None:
    found, line = model.findings["examination"], model.summary().splitlines()[1]
    assert f"{found['fit']:.1f} % at its worst ({found['part']}, {found['output']})" in line
    assert f"on other motions {found['expected']:.0f} % ({found['low']:.0f} to {found['high']:.0f} %)" in line
    assert "one motion is too little" in line
    assert "softneck record mixed" in line


def test_two_motions_leave_each_other_out_as_a_whole() -> None:
    two = identify("rls", [neck_recording(1500), recording_from(2.0 * neck_recording(1500, seed=2).set_points)])
    found = two.findings["examination"]
    assert {"excitation 1", "excitation 2"} <= found["parts"].keys()
    assert not found["parts"].keys() & {"largest motions", "fastest motions", "later block"}
    assert "one motion" not in two.summary()


def test_the_same_motion_twice_is_one_motion() -> None:
    one, other = neck_recording(600), recording_from(2.0 * neck_recording(600).set_points)
    assert not other_motion(concatenate([one, one]))
    assert other_motion(concatenate([one, other]))


@pytest.mark.parametrize(
    ("fits", "worst"),
    [
        ({"a": {"x": 50.0, "y": float("nan")}, "b": {"x": 60.0, "y": 40.0}}, ("b", "y", 40.0)),
        ({"a": {"x": 50.0, "y": 40.0}, "b": {"x": float("-inf"), "y": 90.0}}, ("b", "x", float("-inf"))),
        ({"a": {"x": float("nan")}}, ("", "", float("nan"))),
    ],
    ids=["an output at rest has no fit", "diverged is the worst", "nothing moved"],
)
def test_the_worst_of_what_is_no_number(fits: dict[str, dict[str, float]], worst: tuple[str, str, float]) -> None:
    examined = Examination(fits, other_motion=False)
    assert examined.worst == pytest.approx(worst, nan_ok=True) if math.isnan(worst[2]) else examined.worst == worst
    # JSON has neither: they are null in the file.
    assert examined.findings("rls", Robot.preset("neck"))["fit"] == (worst[2] if math.isfinite(worst[2]) else None)


def test_given_settings_stay_in_the_short_form() -> None:
    assert shortened(GreyBox(sensor_delay=3), "greybox") == GreyBox(sensor_delay=3, evaluations=15, body="rigid")
    assert shortened(GreyBox(body="creep"), "greybox") == GreyBox(body="creep", evaluations=15, sensor_delay=2)
    assert shortened(Play(), "play") == Play()


@dataclass(frozen=True)
class _Refuses:
    def fit(self, recording: Recording) -> Model:
        raise DataError(f"{len(recording)} rows are too short")


def test_a_motion_that_the_rest_does_not_determine_is_no_part() -> None:
    head, tail = neck_recording(1500).split(0.7)
    fitted = identify("rls", head, train=1.0)
    found, same = examine(_Refuses(), fitted, head, tail, silent)
    assert list(found.parts) == ["hold-out"]
    assert same is fitted


def test_validity_of_set_membership_is_what_held_of_motions_left_out() -> None:
    recording = neck_recording(1200, noise=5e-3)
    fold = folds(recording, recording, other_excitation=False)[0]
    again = with_tolerance(SetMembership(epsilon=0.02).fit(fold.train), 0.5)
    rows = unseen_rows(fold)
    calibrated = calibrate_validity(again, again, *rows)
    allowed = tolerance_of(again)
    assert allowed is not None
    before, after = (np.asarray(model.simulate(recording))[rows[1]] for model in (again, calibrated))
    held = float((np.abs(recording.outputs[rows[1]] - after[:, :2]) <= allowed).all(axis=1).mean())
    assert held < before[:, -1].mean() - 0.02, "it was too sure of itself"
    # The factor is known to 1 %, and v is that of the worse output for both.
    assert after[:, -1].mean() == pytest.approx(held, abs=0.02)
    # The simulation itself stays.
    assert np.array_equal(before[:, :-1], after[:, :-1])
    line = identify("rls", recording, train=1.0)
    assert calibrate_validity(line, line, *rows) is line


@pytest.mark.slow
def test_bounds_are_told_with_what_they_held_and_their_width() -> None:
    found = identify("nlsm", neck_recording(1500), form="residual")
    bounds = found.findings["examination"]["bounds"]
    assert set(bounds["held_pct"]) == set(bounds["width"]) == {"pitch", "roll"}
    least = min(bounds["held_pct"].values())
    assert f"{least:.0f} % of motions left out" in found.summary()
    assert ("are no 90 % bounds" in found.summary()) == (least < 90.0)
