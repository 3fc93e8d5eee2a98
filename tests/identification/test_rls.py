"""Recursive least squares: equal to ordinary least squares, and to the system behind the data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load_functions
from softneck.identification import Rls, continuous_parameters
from softneck.signals import concatenate, redefine, signal

from ..data import TRUTH, TS, neck_recording, recording_from


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_recursion_ends_where_least_squares_does(n: int) -> None:
    rng = np.random.default_rng(n)
    Phi, y = rng.standard_normal((400, n)), rng.standard_normal(400)
    theta, F = np.zeros(n), 1e8 * np.eye(n)
    load_functions("softneck.identification._recursion_runtime").rls_recursion(Phi, y, theta, F, 1.0)
    # The start theta = 0 weighs 1e-8 against 400 rows of unit size; the first rows bring F from 1e8 to order one,
    # which leaves eps * 1e8 = 2.2e-8 of rounding in it, and that much again for every parameter.
    np.testing.assert_allclose(theta, np.linalg.lstsq(Phi, y)[0], rtol=0, atol=1e-8 + 2.2e-8 * n)
    np.testing.assert_allclose(F, np.linalg.inv(Phi.T @ Phi), rtol=0, atol=1e-8)


def test_forgetting_weighs_old_rows_less() -> None:
    rng = np.random.default_rng(4)
    Phi, y = rng.standard_normal((300, 2)), rng.standard_normal(300)
    theta, F = np.zeros(2), 1e8 * np.eye(2)
    load_functions("softneck.identification._recursion_runtime").rls_recursion(Phi, y, theta, F, 0.97)
    w = np.sqrt(0.97 ** np.arange(299, -1, -1))
    np.testing.assert_allclose(theta, np.linalg.lstsq(Phi * w[:, None], y * w)[0], rtol=0, atol=1e-8)


def test_the_system_behind_a_clean_record_is_found() -> None:
    model = Rls().fit(recording_from(signal("aprbs", duration=30.0, seed=2).set_points))
    assert model.arrays["delay"].tolist() == list(TRUTH.delay)
    # Only the start covariance's pull is left: 1e-8 over the regressors' information.
    np.testing.assert_allclose(model.arrays["a"].ravel(), -np.array(TRUTH.pole), rtol=0, atol=1e-7)
    np.testing.assert_allclose(model.arrays["b"].ravel(), TRUTH.gain, rtol=0, atol=1e-7)


@pytest.mark.parametrize("criterion", ["free_run", "one_step"])
def test_the_delay_is_the_least_of_its_curve(criterion: str) -> None:
    model = Rls(delay_by=criterion, max_delay=0.2).fit(neck_recording(1200))
    for axis, name in enumerate(("pitch", "roll")):
        curve = np.array(model.findings["delay_curve"][name])
        np.testing.assert_allclose(curve[:, 0], np.arange(11) * TS, atol=1e-12)
        best = curve[:, 1].argmax() if criterion == "free_run" else curve[:, 2].argmin()
        assert best == model.arrays["delay"][axis] == TRUTH.delay[axis]


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
    with pytest.raises(DataError, match="every run is shorter than the 102 samples"):
        Rls(delay=2.0).fit([neck_recording(80), neck_recording(80)])
    r = neck_recording(200)
    with pytest.raises(DataError, match="`pitch` has only 50 samples that were not missed"):
        Rls().fit(r.with_channels(pitch=np.where(np.arange(200) < 50, r.channels["pitch"], np.nan)))
