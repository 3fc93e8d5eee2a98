"""Bounds that hold, or none: what they held, when they are of no use, and those that whole records allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softneck.core import Matrix
from softneck.identification import WARM_UP, Model, SetMembership, validate
from softneck.identification.validation._error_statistics import (
    LEAST_RECORDS,
    calibrated_bounds,
    judged_bounds,
    useful_parts,
)
from softneck.identification.validation._score_tables import Rows
from softneck.robot import Robot
from softneck.signals import SET_POINTS, concatenate

from ...data import neck_recording, short_neck


def rows_of(measured: Matrix, records: int = 1) -> Rows:
    n = len(measured)
    segment = np.arange(n) * records // n
    return Rows(
        time=np.arange(n) * 0.02, segment=segment, since=np.arange(n), measured=measured,
        set_points=np.zeros((n, 3)), robot=Robot.preset(),
    )  # fmt: skip


def drawn(records: int, rng: np.random.Generator, rows: int = 50) -> Matrix:
    """Errors of free runs: constant over each record, as wrong ones are, and some noise; both axes alike."""
    e = np.repeat(0.02 * rng.standard_normal(records), rows) + 0.005 * rng.standard_normal(records * rows)
    return np.column_stack([e, e])


MOTION = np.column_stack([np.sin(np.linspace(0.0, 60.0, 1000)), np.cos(np.linspace(0.0, 60.0, 1000))])


def test_a_further_record_is_held_as_often_as_promised() -> None:
    """Rows by the thousand, and ten records: whoever counts rows promises 90 % and holds far less."""
    rng = np.random.default_rng(0)
    path, point = [], []
    for _ in range(150):
        rows = rows_of(np.resize(MOTION, (600, 2)), records=12)
        found = calibrated_bounds(rows, drawn(12, rng))
        new = np.abs(drawn(1, rng)[:, 0])
        path.append((new <= np.radians(found["path"]["pitch"]["half_width"])).all())
        point.append((new <= np.radians(found["pointwise"]["pitch"]["half_width"])).mean())
    # 12 of 13 by exchangeability; 150 draws know that to 2.2 points, of which two and a half.
    assert np.mean(path) == pytest.approx(12 / 13, abs=0.055)
    assert np.mean(point) > 0.9 - 0.055


def test_fewer_than_nine_records_have_no_bound_and_nine_have_the_largest_error() -> None:
    errors = drawn(9, np.random.default_rng(1))
    rows = rows_of(np.resize(MOTION, errors.shape), records=9)
    found = calibrated_bounds(rows, errors)
    assert found["path"]["pitch"]["half_width"] == pytest.approx(np.degrees(np.abs(errors).max()), rel=1e-12)
    assert found["pointwise"]["pitch"]["half_width"] <= found["path"]["pitch"]["half_width"]
    assert found["path"]["pitch"]["coverage_pct"] is None  # without one of nine there are eight
    few = calibrated_bounds(rows_of(rows.measured[:400], records=8), errors[:400])
    assert few["reason"] == "bounds at 90 % need 9 separate recordings; 8 were given"
    assert "path" not in few
    assert LEAST_RECORDS == 9
    # Errors as large as the motion bound nothing.
    wide = calibrated_bounds(rows, 40.0 * errors)
    assert wide["path"] == {}
    assert "no useful path bound in pitch" in wide["reason"]


def test_beyond_the_set_points_of_the_records_there_is_no_bound() -> None:
    """One of ten records moves farther, and is far more wrong there: that is no miss of a bound that was not given."""
    errors = drawn(10, np.random.default_rng(2))
    rows = rows_of(np.resize(MOTION, errors.shape), records=10)
    rows.set_points[:450] = np.resize(np.linspace(-1.0, 1.0, 50)[:, None], (450, 3))
    rows.set_points[450:475] = 3.0
    errors[450:475] *= 5.0
    found = calibrated_bounds(rows, errors)
    assert found["domain"] == {"min": [-1.0] * 3, "max": [3.0] * 3}
    assert found["pointwise"]["pitch"]["outside_pct"] == pytest.approx(5.0)  # 25 of 500
    near = calibrated_bounds(replace(rows, set_points=np.zeros((500, 3))), errors)
    assert near["pointwise"]["pitch"]["outside_pct"] == 0.0
    assert near["pointwise"]["pitch"]["half_width"] == found["pointwise"]["pitch"]["half_width"]


def test_bounds_wider_than_the_data_are_never_shown() -> None:
    rows = rows_of(MOTION)  # 2 rad of range
    half = np.column_stack([np.full(1000, 0.2), np.full(1000, 1.5)])
    width = {"pitch": float(np.degrees(0.4)), "roll": float(np.degrees(3.0))}
    shown, said = judged_bounds(rows, {"pitch": 100.0, "roll": 100.0}, width, promised=True)
    assert shown == {"pitch": width["pitch"], "roll": None}
    assert said == ["no useful bound in roll: it would be wider than all that was measured (115 deg)"]
    lower, upper = useful_parts(rows, MOTION - half, MOTION + half)
    assert np.isfinite(lower[:, 0]).all()
    assert np.isnan(upper[:, 1]).all()
    _, said = judged_bounds(rows, {"pitch": 35.0, "roll": 100.0}, {"pitch": 70.0, "roll": 1.0}, promised=True)
    assert "no useful bound in pitch: 70 deg wide in the mean, more than half" in said[0]
    assert "the bounds of pitch promise all samples and held 35 %" in said[1]
    assert judged_bounds(rows, {"pitch": 35.0, "roll": 35.0}, {"pitch": 1.0, "roll": 1.0}, promised=False)[1] == []


@pytest.mark.parametrize("kind", ["rls", "oe", "play", "nn", "residual"])
def test_every_kind_says_how_much_lies_outside_what_it_has_seen(models: dict[str, Model], kind: str) -> None:
    seen = short_neck().set_points
    recording = neck_recording(300, seed=18, noise=1e-3)
    wild = recording.with_channels(**{name: 3.0 * recording.channels[name] for name in SET_POINTS})
    outside = validate(models[kind], wild).outside_pct
    assert outside is not None
    if kind != "residual":
        beyond = ((wild.set_points < seen.min(axis=0)) | (wild.set_points > seen.max(axis=0))).any(axis=1)
        assert outside["pitch"] == pytest.approx(100.0 * beyond[WARM_UP:].mean(), abs=1e-9)
    assert outside["pitch"] > 50.0
    inside = validate(models[kind], short_neck(), include_training=True).outside_pct
    assert inside is not None
    assert inside["pitch"] < 10.0


@pytest.mark.slow
def test_several_payloads_widen_epsilon_instead_of_refusing() -> None:
    """The same set-points with another payload: equal regressors, unequal outputs, in a form without feedback."""
    bare = neck_recording(260)
    # From the same first row: the base, which starts there, then simulates the same.
    heavy = bare.with_channels(pitch=np.append(bare.outputs[0, 0], 1.1 * bare.outputs[1:, 0] + 0.05))
    both = concatenate([bare, heavy])
    model = SetMembership(form="residual", base="rls", output_weight=5.0).fit(both)
    assert "equal regressors have unequal outputs" in model.findings["widened"]
    # Where both stand still their outputs part by 0.05 rad: half of it to either side is the least epsilon.
    assert model.findings["epsilon_deg"][0] >= np.degrees(0.05) / 2.0
    free = model.simulate(both)
    inside = (free[:, 5] <= both.outputs[:, 0]) & (both.outputs[:, 0] <= free[:, 6])
    assert inside[100:260].mean() > 0.95
    assert "widened" not in SetMembership(form="residual", base="rls", output_weight=5.0).fit(bare).findings
