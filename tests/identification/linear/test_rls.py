"""Recursive least squares: equal to ordinary least squares, and to the system behind the data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import Rls
from softneck.identification.models._linear_systems import continuous_parameters
from softneck.runtime import load_functions
from softneck.signals import concatenate, redefine, signal

from ...data import TRUTH, TS, Truth, neck_recording, recording_from


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_standard_form_ends_where_least_squares_does(n: int) -> None:
    rng = np.random.default_rng(n)
    Phi, y = rng.standard_normal((400, n)), rng.standard_normal(400)
    theta, F = np.zeros(n), 1e8 * np.eye(n)
    load_functions("tests.oracles.recursion_runtime").rls_recursion(Phi, y, theta, F, 1.0)
    # The start theta = 0 weighs 1e-8 against 400 rows of unit size; the first rows bring F from 1e8 to order one,
    # which leaves eps * 1e8 = 2.2e-8 of rounding in it, and that much again for every parameter.
    np.testing.assert_allclose(theta, np.linalg.lstsq(Phi, y)[0], rtol=0, atol=1e-8 + 2.2e-8 * n)
    np.testing.assert_allclose(F, np.linalg.inv(Phi.T @ Phi), rtol=0, atol=1e-8)


@pytest.mark.parametrize("structure", ["siso", "miso", "mimo"])
def test_a_fit_is_least_squares_over_its_regressors(structure: str) -> None:
    """Each structure's regressors are written out here, and solved by numpy."""
    r = neck_recording(700)
    model = Rls(structure=structure, delay=0.06).fit(r)
    y, P, d = r.outputs, r.set_points, 3
    U = redefine(P)
    start = d + 1
    for axis in range(2):
        own, other = -y[start - 1 : -1, axis], -y[start - 1 : -1, 1 - axis]
        motors = [P[: len(P) - start, j] for j in range(3)]
        columns = {
            "siso": [own, U[: len(U) - start, axis]], "miso": [own, *motors], "mimo": [own, other, *motors],
        }[structure]  # fmt: skip
        theta = np.linalg.lstsq(np.column_stack(columns), y[start:, axis])[0]
        predicted = np.column_stack(columns) @ theta
        # What issue 6 asks of a batch: equal to lstsq to 1e-8; predictions are of the order of one.
        np.testing.assert_allclose(model.predict(r)[start:, axis], predicted, rtol=0, atol=1e-8)
        if structure == "siso":
            np.testing.assert_allclose([model.arrays["a"][axis, 0], model.arrays["b"][axis, 0]], theta, atol=1e-8)


@pytest.mark.parametrize("structure", ["miso", "mimo"])
def test_over_the_motors_the_same_neck_is_found(structure: str) -> None:
    model = Rls(structure=structure, na=1, nb=2).fit(neck_recording(2400, noise=1e-4))
    siso = Rls().fit(neck_recording(2400, noise=1e-4))
    for name in ("pitch", "roll"):
        # 1e-4 rad of noise over 2,400 samples of a motion of 0.1 rad leave parts of a percent.
        assert model.tf(name).dcgain() == pytest.approx(siso.tf(name).dcgain(), rel=0.02)
        assert abs(model.tf(name, input="delta_i").dcgain()) < 0.05 * abs(model.tf(name).dcgain())
    S = model.ss()
    assert (S.input_labels, S.output_labels) == ([f"motor_setpoint_{j}" for j in (1, 2, 3)], ["pitch", "roll"])
    assert S.dt == TS
    P = signal("aprbs", duration=6.0, seed=8).set_points.copy()
    P[:12] = 0.0
    free = model.simulate(recording_from(P), warm_up=0)
    t, inputs = np.arange(len(P)) * TS, cast(Any, P)
    # State-space and recursion of one system: rounding.
    np.testing.assert_allclose(control.forced_response(S, t, inputs.T).outputs, free[:, :2].T, atol=1e-9)
    separate = [
        control.forced_response(model.tf("roll", input=f"motor_setpoint_{j + 1}"), t, inputs[:, j]) for j in range(3)
    ]
    np.testing.assert_allclose(sum(np.asarray(part.outputs) for part in separate), free[:, 1], atol=1e-9)


def test_forgetting_follows_a_neck_that_changes() -> None:
    slow, fast = neck_recording(1500, noise=1e-4), neck_recording(1500, noise=1e-4, truth=Truth(pole=(0.8, 0.8)))
    poles = [Rls(delay=0.06, forgetting=f).fit([slow, fast]).arrays["a"][0, 0] for f in (1.0, 0.99)]
    # 1,500 rows of the second neck leave 0.99^1500 = 3e-7 of the first; all rows alike lie between the two.
    assert poles[1] == pytest.approx(-0.8, abs=0.01)
    assert poles[0] < -0.82


def test_too_little_excitation_is_refused_with_its_condition_number() -> None:
    P = np.zeros((600, 3))
    P[:, 0] = signal("aprbs", duration=12.0, seed=1).set_points[:, 0]  # one motor alone: phi_i never moves
    with pytest.raises(DataError, match=r"roll: the data does not determine the 2 parameters \(condition number inf"):
        Rls(delay=0.06).fit(recording_from(P, noise=1e-4))
    P = redefined_only(signal("aprbs", duration=12.0, seed=1).set_points)  # P1 + P2 + P3 = 0: three inputs of rank two
    with pytest.raises(DataError, match=r"condition number .*repeats another.*lower the orders"):
        Rls(structure="miso", delay=0.06).fit(recording_from(P, noise=1e-4))


def test_a_neck_that_runs_away_is_no_stable_model() -> None:
    r = neck_recording(600, noise=0.0)
    pitch = np.zeros(600)
    for k in range(599):  # 1.004^600 = 11: still within half a turn
        pitch[k + 1] = 1.004 * pitch[k] + 1e-3 * redefine(r.set_points)[k, 0]
    growing = r.with_channels(pitch=0.3 * pitch / np.abs(pitch).max())
    with pytest.raises(DataError, match="no dead time gives a stable one-step model of pitch; record with more"):
        Rls(delay=0.0).fit(growing)


def redefined_only(P: np.ndarray) -> np.ndarray:
    return P - P.mean(axis=1, keepdims=True)


def test_forgetting_is_a_part() -> None:
    for value in (0.0, 1.5):
        with pytest.raises(SettingsError, match="`forgetting` must be"):
            Rls(forgetting=value)


def test_the_system_behind_a_clean_record_is_found() -> None:
    model = Rls().fit(recording_from(signal("aprbs", duration=30.0, seed=2).set_points))
    assert model.arrays["delay"].tolist() == list(TRUTH.delay)
    # Only the start covariance's pull is left: 1e-8 over the regressors' information.
    np.testing.assert_allclose(model.arrays["a"].ravel(), -np.array(TRUTH.pole), rtol=0, atol=1e-7)
    np.testing.assert_allclose(model.arrays["b"].ravel(), TRUTH.gain, rtol=0, atol=1e-7)


def test_the_delay_is_the_best_of_its_curve() -> None:
    model = Rls(max_delay=0.2).fit(neck_recording(1200))
    for axis, name in enumerate(("pitch", "roll")):
        curve = np.array(model.findings["delay_curve"][name])
        np.testing.assert_allclose(curve[:, 0], np.arange(11) * TS, atol=1e-12)
        assert curve[:, 1].argmax() == model.arrays["delay"][axis] == TRUTH.delay[axis]


def test_a_given_delay_and_order_are_kept() -> None:
    model = Rls(na=2, nb=3, delay=0.04).fit(neck_recording(600))
    assert model.arrays["a"].shape == (2, 2)
    assert model.arrays["b"].shape == (2, 3)
    assert model.arrays["delay"].tolist() == [2, 2]
    assert len(model.findings["delay_curve"]["pitch"]) == 1


def test_runs_are_not_joined() -> None:
    """Two runs of one clean system, the second shifted: a row across the border would spoil an exact fit."""
    P = signal("aprbs", duration=12.0, seed=2).set_points
    first, second = recording_from(P), recording_from(4.0 - P)
    both = Rls(delay=0.06).fit([first, second])
    assert both.findings["delay_curve"]["pitch"][0][2] < 1e-9  # one-step rms: rounding
    joined = concatenate([first, second])
    joined = replace(joined, time=np.arange(len(joined)) * TS, run=np.zeros(len(joined), dtype=int))
    assert Rls(delay=0.06).fit(joined).findings["delay_curve"]["pitch"][0][2] > 1e-4


def test_missed_samples_only_cost_their_rows() -> None:
    r = recording_from(signal("aprbs", duration=30.0, seed=2).set_points)
    pitch = r.channels["pitch"].copy()
    pitch[[0, 200, 201, 900]] = np.nan
    model = Rls(delay=0.06).fit(r.with_channels(pitch=pitch))
    assert model.arrays["a"][0, 0] == pytest.approx(-TRUTH.pole[0], abs=1e-7)


@pytest.mark.parametrize("settings", [Rls(max_delay=0.2), Rls(na=2, nb=2, delay=0.06)])
def test_tf_and_ss_simulate_as_the_model_does(settings: Rls) -> None:
    model = settings.fit(neck_recording(800))
    P = signal("aprbs", duration=6.0, seed=8).set_points.copy()
    P[:12] = 0.0  # from rest: control's systems start there
    free = model.simulate(recording_from(P), warm_up=0)
    U: Any = redefine(P)[:, :2]
    t = np.arange(len(P)) * model.sample_time
    joint = control.forced_response(model.ss(), t, U.T).outputs
    for axis, name in enumerate(("pitch", "roll")):
        G = model.tf(name)
        assert G.dt == model.sample_time
        # State-space and difference form of one system: rounding, amplified by the realisation's conditioning.
        np.testing.assert_allclose(control.forced_response(G, t, U[:, axis]).outputs, free[:, axis], atol=1e-9)
        np.testing.assert_allclose(joint[axis], free[:, axis], atol=1e-9)
        in_deg = model.tf(name, angle_unit="deg")
        assert in_deg.dcgain() == pytest.approx(np.degrees(G.dcgain()), rel=1e-12)


def test_the_papers_form_has_the_same_gain_pole_and_delay() -> None:
    model = Rls().fit(recording_from(signal("aprbs", duration=30.0, seed=2).set_points))
    for axis, name in enumerate(("pitch", "roll")):
        K, p, L = continuous_parameters(TS, model.arrays, axis) or (0, 0, 0)
        assert np.exp(-p * TS) == pytest.approx(TRUTH.pole[axis], abs=1e-6)
        assert pytest.approx(TRUTH.delay[axis] * TS) == L
        assert K / p == pytest.approx(model.tf(name).dcgain(), rel=1e-9)
        assert f"{p:.3f}" in model.summary()
    assert continuous_parameters(TS, Rls(na=2).fit(neck_recording(600)).arrays, 0) is None


def test_wrong_names_are_refused(models: dict) -> None:
    with pytest.raises(SettingsError, match="`output` must be one of pitch, roll; got 'yaw'"):
        models["rls"].tf("yaw")
    with pytest.raises(SettingsError, match="a model of kind `nn` is not linear"):
        models["nn"].tf("pitch")
    with pytest.raises(SettingsError, match="`na` must be a whole number"):
        Rls(na=0)


def test_data_that_cannot_be_identified_from_is_refused() -> None:
    with pytest.raises(DataError, match="99 rows are too few to identify from; at least 100"):
        Rls().fit(neck_recording(150).rows(0, 99))
    with pytest.raises(DataError, match=r"a dead time of 2 s is longer than the longest run, 1\.6 s"):
        Rls(delay=2.0).fit([neck_recording(80), neck_recording(80)])
    with pytest.raises(DataError, match="every run is shorter than the 102 samples"):
        Rls(na=100, nb=2, delay=1.98).fit([neck_recording(100), neck_recording(100)])
    r = neck_recording(200)
    with pytest.raises(DataError, match="`pitch` has only 50 samples that were not missed"):
        Rls().fit(r.with_channels(pitch=np.where(np.arange(200) < 50, r.channels["pitch"], np.nan)))
