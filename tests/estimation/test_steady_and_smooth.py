"""Constant gains against filterpy and python-control; the smoother against one least-squares problem."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load, read_archive, write_archive
from softneck.estimation import KalmanSettings
from softneck.estimation._forms import STATES, steady_covariance, steady_gains

from .necks import IN_TIME, changed, neck, recording, rows_of, run_block, run_plain, smooth_motion


@pytest.mark.slow
@pytest.mark.parametrize("form", list(STATES))
@pytest.mark.parametrize("divider", [1, 2])
def test_constant_gains_are_those_that_filterpy_converges_to(form: str, divider: int) -> None:
    settings = KalmanSettings(form=form, sensor="mpu9250", sensor_period=0.02 * divider, steady=True)
    observer = settings.design(neck())
    kf = observer.filterpy()
    # The bias converges slowest, in some hundred samples; 6000 divides by both, so the last update was a real one.
    for k in range(6000):
        kf.predict(np.zeros((2, 1)))
        kf.update(np.zeros((2, 1)) if k % divider == divider - 1 else None)
    np.testing.assert_allclose(observer.arrays[9], kf.K, atol=1e-9)


def last_gain(kf) -> np.ndarray:
    """filterpy sets K to zero at `update(None)`; 6000 is even, so the last update was real."""
    return kf.K


@pytest.mark.parametrize("form", list(STATES))
def test_constant_gains_equal_those_of_python_control(form: str) -> None:
    observer = KalmanSettings(form=form, sensor="mpu9250", steady=True).design(neck())
    kf = observer.filterpy()
    # The predictor's gain is F times the filter's.
    predictor, covariance = (np.asarray(item) for item in control.dlqe(kf.F, np.eye(4), kf.H, kf.Q, kf.R)[:2])
    np.testing.assert_allclose(kf.F @ observer.arrays[9], predictor, atol=1e-9)
    # 40 deg squared is the largest number around; the least here are 1e-6.
    np.testing.assert_allclose(steady_covariance(observer.arrays[:9], observer.noise), covariance, atol=1e-9)


def test_constant_gains_end_where_the_full_filter_does() -> None:
    record = recording(rows=1500)
    full = KalmanSettings(sensor="mpu9250").design(neck())
    steady = run_block(full.steady(), record)
    # After a second the covariance has converged to 1e-12 of itself.
    np.testing.assert_allclose(steady[1200:, :4], run_block(full, record)[1200:, :4], atol=1e-6)
    np.testing.assert_allclose(run_plain(full.steady().block(), rows_of(full, record)), steady, rtol=0, atol=1e-12)


def rows(observer, record) -> np.ndarray:
    from .necks import rows_of

    return rows_of(observer, record)


def test_constant_gains_gate_and_bridge_as_well() -> None:
    record = changed(recording(rows=600), [250, 251], 1.2, "pitch_measured")
    record = changed(record, slice(300, 340), math.nan, "pitch_measured")
    y = run_block(replace(IN_TIME, steady=True).design(neck()), record)
    error = np.abs(y[:, 0] - record.channels["pitch"])[100:]
    assert np.degrees(error).max() < 0.5
    assert not (y[305:340, 5] > 0.5).any()
    assert y[341, 5] == 1.0


def test_a_steady_observer_keeps_its_gains_in_its_file(tmp_path: Path) -> None:
    observer = KalmanSettings(form="gyro", steady=True).design(neck())
    observer.save(tmp_path / "o.npz")
    again = load(tmp_path / "o.npz", role="observer")
    assert again.is_steady
    assert again.form == "gyro"
    record = smooth_motion(rows=50)
    np.testing.assert_array_equal(run_block(again, record), run_block(observer, record))
    assert again.summary() == observer.summary()
    assert [port.name for port in again.block().parameters] == ["measurement_noise_std"]


def test_other_noise_makes_other_gains() -> None:
    observer = KalmanSettings(steady=True).design(neck())
    levels = (0.01, 0.002, 0.001)
    changed_gains = observer.with_noise(levels).arrays[9:]
    for ours, theirs in zip(changed_gains, steady_gains(observer.arrays[:9], levels), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(SettingsError, match="`model_noise_std` must be positive"):
        observer.with_noise((0.01, -0.1, 0.001))


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_a_covariance_that_is_none_is_refused(tmp_path: Path, value: float) -> None:
    KalmanSettings().design(neck()).save(tmp_path / "o.npz")
    header, arrays = read_archive(tmp_path / "o.npz")
    header = {key: item for key, item in header.items() if not key.startswith("format")}
    spoilt = {name: array.copy() for name, array in arrays.items()}
    spoilt["P0"][0, 0] = value
    write_archive(tmp_path / "bad.npz", header, spoilt)
    with pytest.raises(FileFormatError, match=r"positive semidefinite|not finite"):
        load(tmp_path / "bad.npz")
    lopsided = {**arrays, "P0": arrays["P0"] + np.triu(np.ones((4, 4)), 1)}
    write_archive(tmp_path / "lopsided.npz", header, lopsided)
    with pytest.raises(FileFormatError, match="must be finite and symmetric"):
        load(tmp_path / "lopsided.npz")


def test_the_smoother_solves_the_whole_least_squares_problem() -> None:
    """RTS equals the maximum a posteriori trajectory: one stacked weighted least-squares problem."""
    record = changed(smooth_motion(rows=40, noise_deg=0.3), slice(15, 22), math.nan, "pitch_measured")
    settings = replace(IN_TIME, form="gyro", measurement_noise_std=math.radians(0.3), gyro_noise_std=0.02)
    observer = settings.design(neck(sample_time=0.01))
    observer = observer.with_noise((math.radians(0.3), 0.02, 0.004))
    smoothed = observer.smooth(record)
    expected = map_trajectory(observer, record)
    # Condition of the stacked problem: 40 deg of start against 0.04 deg of process noise, squared: 1e6 of rounding.
    np.testing.assert_allclose(smoothed.aligned, expected, atol=1e-9)


def map_trajectory(observer, record) -> np.ndarray:
    """Angles (time, 2) by weighted least squares over all states at once; the prior doubt is that of the filter."""
    F, B, H, _, _, P0 = observer.arrays[:6]
    kf = observer.filterpy()
    n, N = F.shape[0], len(record)
    rates = np.column_stack([record.channels["pitch_rate"], record.channels["roll_rate"]])
    z = np.column_stack([record.channels["pitch_measured"], record.channels["roll_measured"]])
    length = math.ceil(observer.arrays[8][0]) + 1
    blocks, right = [], []

    def add(columns: dict[int, np.ndarray], value: np.ndarray, covariance: np.ndarray) -> None:
        W = np.linalg.inv(np.linalg.cholesky(covariance))
        row = np.zeros((len(value), n * N))
        for k, matrix in columns.items():
            row[:, n * k : n * k + n] = W @ matrix
        blocks.append(row)
        right.append(W @ value)

    for k in range(N):
        u = 0.5 * (rates[k] + rates[max(k - 1, 0)])
        if k == 0:
            add({0: np.eye(n)}, B @ u, F @ P0 @ F.T + kf.Q + P0)
        else:
            add({k - 1: -F, k: np.eye(n)}, B @ u, kf.Q + (P0 if k < length else 0.0))
        if np.isfinite(z[k]).all():
            add({k: H}, z[k], kf.R)
    x = np.linalg.lstsq(np.vstack(blocks), np.concatenate(right))[0].reshape(N, n)
    return x @ H.T


def test_the_smoother_is_nearer_the_truth_than_the_filter() -> None:
    record = changed(smooth_motion(), slice(700, 760), math.nan, "pitch_measured", "roll_measured")
    settings = replace(IN_TIME, form="kinematic", measurement_noise_std=math.radians(0.02), acceleration_noise_std=20.0)
    observer = settings.design(neck(sample_time=0.01))
    errors = [
        np.std((estimates.pitch - record.channels["pitch"])[200:-50])
        for estimates in (observer.smooth(record), observer.estimate(record))
    ]
    # Both sides of a gap instead of one: at least half, here about a fifth.
    assert errors[0] < 0.5 * errors[1]


def test_filter_and_smoother_agree_at_the_last_row() -> None:
    record = smooth_motion(rows=200)
    observer = KalmanSettings(form="kinematic", sensor_delay=0.025).design(neck(sample_time=0.01))
    np.testing.assert_array_equal(observer.smooth(record).pitch[-1], observer.estimate(record).pitch[-1])
