"""Subspace identification: the system behind a record, as python-control sees it, over runs that are never joined."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import control
import numpy as np
import pytest

from softneck.core import DataError, Matrix, SettingsError
from softneck.identification import Subspace, load_model
from softneck.identification.linear._subspace import fit_subspace
from softneck.signals import SET_POINTS, Recording, signal

from ...data import TS, neck_recording, recording_from

A = np.array([[0.9, 0.1, 0.0, 0.0], [-0.1, 0.9, 0.0, 0.0], [0.0, 0.0, 0.8, 0.05], [0.0, 0.0, 0.0, 0.7]])
B = np.array([[0.1, 0.0, 0.05], [0.0, 0.2, 0.0], [0.1, -0.1, 0.0], [0.0, 0.1, 0.3]])
C = np.array([[1.0, 0.0, 0.5, 0.0], [0.0, 1.0, 0.0, 1.0]])


def motion(rows: int, seed: int, *, noise: float = 0.0, start: float = 0.0) -> tuple[Matrix, Matrix]:
    rng = np.random.default_rng(seed)
    U = np.repeat(rng.uniform(-1, 1, (rows // 4 + 1, 3)), 4, axis=0)[:rows]
    x, Y = start * np.ones(4), np.zeros((rows, 2))
    for k in range(rows):
        Y[k] = C @ x
        x = A @ x + B @ U[k]
    return U, Y + noise * rng.standard_normal(Y.shape)


def markov(a: Matrix, b: Matrix, c: Matrix, count: int) -> Matrix:
    return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(count)])


def test_clean_runs_give_the_system_behind_them() -> None:
    runs = [motion(400, 0), motion(300, 1, start=0.5)]
    runs[1][1][100:103] = np.nan
    fit = fit_subspace(runs, 4, 8)
    # The coordinates are free; poles and Markov parameters are not. Projections of clean data leave 1e-9.
    wanted = np.sort_complex(np.linalg.eigvals(A))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(fit.A)), wanted, atol=1e-7)
    np.testing.assert_allclose(markov(fit.A, fit.B, fit.C, 20), markov(A, B, C, 20), atol=1e-7)
    assert fit.singular_values[4] < 1e-9 * fit.singular_values[3]
    assert fit.cost.max() < 1e-12


def test_it_agrees_with_controls_realisation_and_markov_parameters() -> None:
    """`control.era` from the impulse responses, and `control.markov` from the record of one output."""
    U, Y = motion(3000, 2)
    fit = fit_subspace([(U, Y)], 4, 8)
    impulse = np.concatenate([np.zeros((1, 2, 3)), markov(fit.A, fit.B, fit.C, 40)])
    realised: Any = cast(Any, control.eigensys_realization(impulse.transpose(1, 2, 0), r=4))[0]
    poles = np.sort_complex(np.linalg.eigvals(fit.A))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(realised.A)), poles, atol=1e-6)
    estimated = np.asarray(control.markov(cast(Any, Y.T), cast(Any, U.T), 60, dt=True))
    # 60 Markov parameters leave 0.9^60 = 2e-3 of the response to older inputs out.
    np.testing.assert_allclose(estimated[:, :, 1:20].transpose(2, 0, 1), impulse[1:20], atol=5e-3)


def test_under_noise_the_gain_predicts_better_than_the_free_run() -> None:
    """Noise that goes through the state: an observer sees it, a free run does not."""
    rng = np.random.default_rng(3)
    U = np.repeat(rng.uniform(-1, 1, (1000, 3)), 4, axis=0)
    x, Y = np.zeros(4), np.zeros((4000, 2))
    for k in range(4000):
        Y[k] = C @ x + 0.01 * rng.standard_normal(2)
        x = A @ x + B @ U[k] + 0.05 * rng.standard_normal(4)
    r = Recording(
        np.arange(4000) * TS,
        TS,
        dict(zip(SET_POINTS, U.T, strict=True)) | {"pitch": 0.3 * Y[:, 0], "roll": 0.3 * Y[:, 1]},
    )
    model = Subspace(order=4, horizon=8, delay=0.0).fit(r)
    error = [np.std((r.outputs - y[:, :2])[50:], axis=0) for y in (model.predict(r), model.simulate(r))]
    assert (error[0] < 0.7 * error[1]).all()
    # The best one-step predictor: the innovation of the true system.
    S: Any = control.ss(A, B, C, 0, TS)
    _, P, _ = control.dlqe(S.A, np.eye(4), S.C, 0.05**2 * np.eye(4), 0.01**2 * np.eye(2))
    # Before the measurement of that instant; 4,000 samples tell a standard deviation to 1.1 %, four of those.
    ahead = A @ (P - P @ C.T @ np.linalg.inv(C @ P @ C.T + 1e-4 * np.eye(2)) @ C @ P) @ A.T + 0.05**2 * np.eye(4)
    best = 0.3 * np.sqrt(np.diag(C @ ahead @ C.T) + 1e-4)
    np.testing.assert_allclose(error[0], best, rtol=0.06)


def test_tf_ss_free_run_and_file_are_one_system(tmp_path: Path) -> None:
    model = Subspace(order=4, delay=0.06).fit(neck_recording(1500, noise=1e-3))
    model.save(tmp_path / "m.npz")
    model = load_model(tmp_path / "m.npz")
    P = signal("aprbs", duration=6.0, seed=8).set_points.copy()
    P[:12] = 0.0  # from rest: control's systems start there
    free = model.simulate(recording_from(P), warm_up=0)
    t, inputs = np.arange(len(P)) * TS, cast(Any, P)
    joint = control.forced_response(model.ss(), t, inputs.T).outputs
    np.testing.assert_allclose(joint, free[:, :2].T, atol=1e-9)  # one system: rounding
    for axis, name in enumerate(("pitch", "roll")):
        parts = [
            control.forced_response(model.tf(name, input=m), t, inputs[:, j])
            for j, m in enumerate(model.ss().input_labels)
        ]
        # Polynomials of degree 4 with poles at 0.9 lose some digits.
        np.testing.assert_allclose(sum(np.asarray(p.outputs) for p in parts), free[:, axis], atol=1e-7)
    assert "4 states" in model.summary()


@pytest.mark.slow
def test_the_dead_time_of_a_clean_neck_is_found() -> None:
    model = Subspace(order=2, max_delay=0.12).fit(neck_recording(1200, noise=1e-4))
    curve = np.array(model.findings["delay_curve"]["pitch"])
    np.testing.assert_allclose(curve[:, 0], np.arange(7) * TS, atol=1e-12)
    # Pitch has 3 samples and roll 4; one pole each leaves no room for the difference.
    assert model.arrays["delay"][0] in (3.0, 4.0)


def test_what_cannot_be_fitted_is_named() -> None:
    P = signal("aprbs", duration=12.0, seed=1).set_points
    with pytest.raises(DataError, match=r"the 3 motors repeat each other .*identify `oe` or `srivc`"):
        Subspace().fit(recording_from(P - P.mean(axis=1, keepdims=True), noise=1e-4))
    with pytest.raises(DataError, match=r"windows of 30 samples without a missed one are too few"):
        Subspace(delay=0.0).fit(neck_recording(150))
    with pytest.raises(SettingsError, match="`order / horizon` must be between 0 and 1"):
        Subspace(order=20, horizon=10)
    with pytest.raises(DataError, match="no motor positions were logged"):
        Subspace(source="positions").fit(neck_recording(300, positions=False))
