"""The front door: what it takes, what it refuses, and what comes back as labels, tables and figures."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

import softneck
from softneck import Recording
from softneck.core import DataError, SettingsError, SoftneckError
from softneck.identification import Model
from softneck.robot import Robot
from softneck.verification._requirements import expand_metrics

from .data import neck_recording, short_neck

RECORDING = short_neck()
MODEL = softneck.identify("rls", RECORDING, train=1.0, delay=0.06)
PI = softneck.design_controller("pi", MODEL)
# Every function of the front door, by the argument that people get wrong.
TAKES: dict[str, Callable[[Any], object]] = {
    "load": softneck.load,
    "read_recording": softneck.read_recording,
    "identify kind": lambda x: softneck.identify(x, RECORDING),
    "identify recording": lambda x: softneck.identify("rls", x),
    "identify auto": lambda x: softneck.identify("auto", x),
    "identify robot": lambda x: softneck.identify("rls", RECORDING.set_points, robot=x),
    "identify train": lambda x: softneck.identify("rls", RECORDING, train=x),
    "family": softneck.family,
    "frequency_response": softneck.frequency_response,
    "calibrate": softneck.calibrate,
    "validate model": lambda x: softneck.validate(x, RECORDING),
    "validate recording": lambda x: softneck.validate(MODEL, x),
    "observer": softneck.observer,
    "design_controller kind": lambda x: softneck.design_controller(x, MODEL),
    "design_controller plant": lambda x: softneck.design_controller("pi", x),
    "verify controller": lambda x: softneck.verify(x, MODEL),
    "verify plants": lambda x: softneck.verify(PI, x),
    "tune": softneck.tune,
    "simulate": softneck.simulate,
    "study": softneck.study,
    "linearize": softneck.linearize,
    "build_fmu": lambda x: softneck.build_fmu(x, "Neck.fmu"),
    "build_fmu path": lambda x: softneck.build_fmu(MODEL, x),
    "record": lambda x: softneck.record(x, "paper"),
    "record neck": lambda x: softneck.record("eq22", x),
    "import_log": lambda x: softneck.import_log("log.csv", x),
    "model.simulate": lambda x: MODEL.simulate(x),
    "model.predict": lambda x: MODEL.predict(x),
    "model.score": lambda x: MODEL.score(x),
    "Recording.from_arrays": Recording.from_arrays,
    "Recording.from_pandas": Recording.from_pandas,
}
WRONG = st.sampled_from(
    (None, True, 3, 2.5, b"x", "no such thing", (), [], [3], ["x"], [None], {}, {"a": 3}, {"a": [1.0]}, object(),
     int, np.zeros(3), np.zeros((2, 2)), np.zeros((40, 7)), np.zeros((9, 3), dtype=complex), np.array(["a"]),
     pd.DataFrame({"a": [1.0]}), Path("absent.npz"), Path("absent.csv"))
)  # fmt: skip


@pytest.mark.parametrize("name", TAKES)
@given(thing=WRONG)
def test_a_wrong_type_is_one_of_our_errors(name: str, thing: Any) -> None:
    # `True` names a part to train on, set-points alone are what some take: what is no error is an answer.
    with contextlib.suppress(SoftneckError):
        assert TAKES[name](thing) is not None


def test_a_recording_survives_arrays_tables_and_back(neck: Recording) -> None:
    table = Recording.from_pandas(neck.to_pandas())
    arrays = Recording.from_arrays(
        neck.set_points, neck.outputs, motor_positions=neck.motor_positions, sample_time=neck.sample_time, run=neck.run
    )
    for made in (table, arrays):
        # Degrees and back cost some roundings.
        np.testing.assert_allclose(made.outputs, neck.outputs, rtol=1e-14)
        np.testing.assert_array_equal(made.set_points, neck.set_points)
        np.testing.assert_array_equal(made.motor_positions, neck.motor_positions)
    assert len(Recording.from_pandas(neck.to_pandas().set_index("time [s]"))) == len(neck)


def test_a_table_of_another_robot_says_whose_it_is() -> None:
    made = Recording.from_arrays(np.ones((50, 1)), np.ones((50, 1)), sample_time=0.02, robot="finger")
    assert Recording.from_pandas(made.to_pandas()).robot.hash == Robot.preset("finger").hash
    with pytest.raises(DataError, match=r"`set_points` must have the shape \(time, 3\); got \(50, 1\)"):
        Recording.from_arrays(np.ones((50, 1)))


def test_runs_of_arrays_begin_at_zero() -> None:
    made = Recording.from_arrays(np.zeros((30, 3)), run=np.repeat([4, 7, 9], 10))
    assert [run.time[0] for run in made.runs()] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("form", ["table", "columns", "array", "list"])
def test_all_forms_of_a_recording_make_the_same_model(form: str) -> None:
    forms: dict[str, Any] = {
        "table": RECORDING.to_pandas(),
        "columns": dict(RECORDING.to_pandas().items()),
        "array": np.hstack([RECORDING.set_points, RECORDING.outputs]),
        "list": [RECORDING],
    }
    robot = "neck" if form == "array" else None
    model = softneck.identify("rls", forms[form], robot=robot, train=1.0, delay=0.06)
    # An array has no motor positions.
    bare = Recording.from_arrays(RECORDING.set_points, RECORDING.outputs)
    expected = softneck.identify("rls", bare, train=1.0, delay=0.06) if form == "array" else MODEL
    for name, values in expected.arrays.items():
        # Degrees and back cost some roundings, which the recursion passes on.
        np.testing.assert_allclose(model.arrays[name], values, rtol=1e-9, atol=1e-12)


def test_score_is_r2_of_the_simulation_as_scikit_learn_means_it(models: dict[str, Model]) -> None:
    from sklearn.metrics import r2_score

    recording = neck_recording(600)
    judged = slice(25, None)  # what aligns the run does not count
    free = np.asarray(models["oe"].simulate(recording))[judged, :2]
    expected = r2_score(recording.outputs[judged], free)
    assert models["oe"].score(recording) == pytest.approx(expected, rel=1e-12)


def test_set_points_alone_are_simulated_from_rest() -> None:
    free = MODEL.simulate(RECORDING.set_points)
    silent = Recording.from_arrays(RECORDING.set_points, sample_time=RECORDING.sample_time)
    np.testing.assert_array_equal(free, MODEL.simulate(silent))


def test_recording_model_and_validation_are_drawn() -> None:
    for drawn in (RECORDING.plot(), MODEL.plot(RECORDING), softneck.validate(MODEL, neck_recording(300)).plot()):
        assert isinstance(drawn, Figure)
        assert len(drawn.axes) >= 2


NECK = Robot.preset("neck")


def test_flat_requirements_are_of_the_plants_that_step_or_else_of_the_linear_ones() -> None:
    flat = {"overshoot_pct": 5, "disk_margin": 0.6}
    for stepping, group in ((True, "sim"), (False, "step")):
        asked = expand_metrics(flat, NECK, stepping=stepping)
        assert asked == {"require": {f"{group}.overshoot_pct": {"max": 5}, "axes.disk_margin": {"min": 0.6}}}
    # A whole table and whole names stay what they are.
    table = {"require": {"step.rise_s": {"max": 0.5}}, "sim": {"necks": 0}}
    assert expand_metrics(table, NECK, stepping=False) == table
    assert expand_metrics({"step.rise_s": 0.5}, NECK, stepping=True) == {"require": {"step.rise_s": {"max": 0.5}}}


def test_an_unknown_flat_requirement_names_the_nearest() -> None:
    with pytest.raises(SettingsError, match=r"unknown requirement `overshoot`; did you mean `overshoot_pct`\?"):
        expand_metrics({"overshoot": 5}, NECK, stepping=False)
