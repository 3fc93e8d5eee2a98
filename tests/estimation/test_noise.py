"""Noise levels from data, and whether NIS and NEES keep their bounds when the model is right."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.estimation import KalmanObserver, consistency, fit_noise
from softneck.estimation._noise import find_outliers, look_ahead_error
from softneck.estimation._offline import measured_angles
from softneck.signals import Recording

from .necks import IN_TIME, changed, neck, recording

TRUE = (math.radians(0.1), math.radians(0.05), math.radians(0.02))


def observer_of(noise: tuple[float, float, float] = TRUE) -> KalmanObserver:
    return IN_TIME.design(neck()).with_noise(noise)


def drawn(rows: int = 4000, *, seed: int = 3, noise: tuple[float, float, float] = TRUE) -> Recording:
    """A recording drawn from the filter's own model: process noise in the states, white noise on the angles."""
    observer = observer_of(noise)
    F, B, H, QM, QW, _, T, = (observer.arrays[i] for i in (0, 1, 2, 3, 4, 5, 7))  # fmt: skip
    record = recording(rows=rows)
    rng = np.random.default_rng(seed)
    u = record.set_points @ T.T
    spread = noise[1] * np.sqrt(np.diag(QM)) + noise[2] * np.sqrt(np.diag(QW))
    x, truth = np.zeros(len(F)), np.zeros((rows, 2))
    for k in range(rows):
        acting = np.array([u[max(k - 1 - d, 0), i] for i, d in enumerate(observer.delays)])
        x = F @ x + B @ acting + spread * rng.standard_normal(len(F))
        truth[k] = H @ x
    measured = truth + noise[0] * rng.standard_normal((rows, 2))
    return record.with_channels(
        pitch=truth[:, 0], roll=truth[:, 1], pitch_measured=measured[:, 0], roll_measured=measured[:, 1]
    )


def nees_of(observer: KalmanObserver, record: Recording) -> np.ndarray:
    """(x - xhat)' P^-1 (x - xhat) of both angles, of a sensor that is not late."""
    told = observer.estimate(record)
    e = (record.outputs - told.aligned)[50:]
    return np.einsum("ki,ki->k", e, np.linalg.solve(told.covariance[50:], e[:, :, None])[:, :, 0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_nis_and_nees_keep_their_bands_when_the_model_is_right(seed: int) -> None:
    record = drawn(seed=seed)
    found = consistency(observer_of(), record)
    # Issue 10: 93 to 97 %. The share of 3,950 white samples has a standard deviation of 0.35 %.
    assert 0.93 <= found.inside <= 0.97
    assert found.mean_band[0] - 0.05 < found.mean < found.mean_band[1] + 0.05
    # Errors of following samples are alike: some tens of samples count as one.
    assert nees_of(observer_of(), record).mean() == pytest.approx(2.0, abs=0.3)


@pytest.mark.slow
def test_a_filter_too_sure_of_itself_is_told() -> None:
    record, sure = drawn(), observer_of((TRUE[0] / 2, TRUE[1] / 2, TRUE[2] / 2))
    # All levels halved: a quarter of the covariance, four times the squares.
    assert consistency(sure, record).mean > 5.0
    assert nees_of(sure, record).mean() > 5.0


@pytest.mark.slow
def test_the_noise_behind_a_recording_is_found() -> None:
    start = observer_of((TRUE[0] * 4, TRUE[1] / 5, TRUE[2] * 6))
    found = fit_noise(start, [drawn(seed=7), drawn(seed=8)])
    # Four standard deviations: 16,000 innovations know the measurement noise to 1 %; the walk, hidden behind it and
    # beside the model's own noise, to some 8 %.
    assert found.noise[0] == pytest.approx(TRUE[0], rel=0.05)
    assert found.noise[1] == pytest.approx(TRUE[1], rel=0.25)
    assert found.noise[2] == pytest.approx(TRUE[2], rel=0.3)
    assert found.at_bound == ()
    assert found.log_likelihood[1] > found.log_likelihood[0]
    assert (found.observer.noise, found.observer.sensor) == (found.noise, "data")


def test_the_likelihood_is_that_of_filterpy() -> None:
    """filterpy computes it per update; ours differs by the constant log(2 pi) of two angles."""
    from softneck.estimation._noise import SETTLE, Cost

    observer, record = observer_of(), drawn(rows=400)
    kf, expected = observer.filterpy(), 0.0
    estimates = observer.estimate(record)
    u = record.set_points @ observer.arrays[7].T
    length = int(max(observer.delays)) + 1
    for k in range(400):
        acting = np.array([[u[max(k - 1 - d, 0), i]] for i, d in enumerate(observer.delays)])
        kf.predict(acting)
        kf.P = kf.P + (observer.arrays[5] if k < length else 0.0)
        kf.update(np.array([[record.channels[f"{a}_measured"][k]] for a in ("pitch", "roll")]))
        expected += float(kf.log_likelihood) + math.log(2 * math.pi) if k >= SETTLE else 0.0
    assert estimates.accepted.all()
    ours = -0.5 * Cost(observer, [record]).of(np.log10(TRUE))
    # Sums of 350 terms of about 10.
    assert ours == pytest.approx(expected / (400 - SETTLE), rel=1e-9)


@pytest.mark.slow
def test_a_level_that_is_known_stays() -> None:
    start = observer_of((TRUE[0], TRUE[1] / 5, TRUE[2] * 6))
    found = fit_noise(start, drawn(seed=7), fixed=["measurement_noise_std"])
    assert found.noise[0] == TRUE[0]
    assert found.noise[1] == pytest.approx(TRUE[1], rel=0.3)
    with pytest.raises(SettingsError, match="`bias_noise_std` is not a noise level"):
        fit_noise(start, drawn(rows=300), fixed=["bias_noise_std"])
    with pytest.raises(SettingsError, match="no noise level is left"):
        fit_noise(start, drawn(rows=300), fixed=start.noise_names)


@pytest.mark.slow
def test_outliers_do_not_move_the_noise() -> None:
    record = drawn(rows=2500)
    clean = fit_noise(observer_of(), record)
    rows = list(range(60, 2500, 50))
    dirty = fit_noise(observer_of(), changed(record, rows, 1.0, "pitch_measured"))
    assert dirty.outliers >= len(rows)
    # A fiftieth of the samples is gone; some good ones went with them.
    np.testing.assert_allclose(dirty.noise, clean.noise, rtol=0.15)


def test_too_little_data_is_refused() -> None:
    with pytest.raises(DataError, match="at least 200 measurements"):
        fit_noise(observer_of(), drawn(rows=100))
    record = drawn(rows=100)
    with pytest.raises(DataError, match="no measurements are left"):
        consistency(observer_of(), record, settle=200)
    with pytest.raises(DataError, match="`level` must be between"):
        consistency(observer_of(), record, level=1.0)
    with pytest.raises(DataError, match="sample time"):
        fit_noise(observer_of(), replace(record, time=record.time / 2, sample_time=0.01))


def test_an_outlier_of_any_output_is_one_and_what_moves_on_is_none() -> None:
    y = 1e-3 * np.random.default_rng(0).standard_normal((200, 2))
    assert not find_outliers(y).any()
    for axis in (0, 1):
        z = y.copy()
        z[50, axis] += 1.0
        assert np.flatnonzero(find_outliers(z)).tolist() == [50]
        z[50:, axis] += 1.0
        assert np.flatnonzero(find_outliers(z)).tolist() in ([50], [])
        # Beside a sample that is missing its neighbours are those that came.
        z = y.copy()
        z[50, axis], z[51] = 1.0, np.nan
        assert np.flatnonzero(find_outliers(z)).tolist() == [50]


@pytest.mark.parametrize("lost", [math.nan, math.inf])
def test_one_estimate_that_is_no_number_is_an_infinite_error(lost: float) -> None:
    record = recording(rows=200)
    finite: Any = SimpleNamespace(lead=0.0, sample_time=0.02, estimate=lambda _: SimpleNamespace(outputs=truth.copy()))
    truth = measured_angles(record) + 0.01
    assert look_ahead_error(finite, record) == pytest.approx(0.01)
    # Rows 20 to 24 of each 25 are withheld and compared.
    truth[199 - 3, 0] = lost
    assert look_ahead_error(finite, record) == math.inf


def test_consistency_counts_what_the_gate_refused() -> None:
    record = recording(rows=200)
    judged, accepted = np.ones(200, dtype=bool), np.arange(200) % 10 > 2
    judged[100:110] = False
    estimates = SimpleNamespace(judged=judged, accepted=accepted & judged, innovation=np.where(accepted, 2.0, 50.0))
    filtered: Any = SimpleNamespace(estimate=lambda _: estimates)
    found = consistency(filtered, record, settle=50)
    # 150 rows but for ten without a measurement, three of ten of them refused; a refused one has no part in the mean.
    assert (found.rejected, found.taken, found.mean, found.inside) == (42, 98, 2.0, 1.0)
