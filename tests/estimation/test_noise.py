"""Noise levels from data, and whether NIS and NEES keep their bounds when the model is right."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.estimation import KalmanObserver, _noise, consistency, fit_noise
from softneck.estimation._noise import cost_of, find_outliers, look_ahead_error
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
        consistency(observer_of(), record.rows(0, 50))
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
    found = consistency(filtered, record)
    # 150 rows but for ten without a measurement, three of ten of them refused; a refused one has no part in the mean.
    assert (found.rejected, found.taken, found.mean, found.inside) == (42, 98, 2.0, 1.0)


@pytest.mark.parametrize("fixed", [(), ("measurement_noise_std",)])
def test_levels_that_are_found_have_the_likelihood_that_is_told(
    fixed: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search is replaced by a step of a tenth of a decade; what was left out is counted and has no part."""
    record = changed(drawn(rows=300), [100, 150], 1.0, "pitch_measured")
    start = observer_of()

    def step(cost: Any, begin: np.ndarray, free: np.ndarray) -> Any:
        found = begin + 0.1 * free
        return found, cost.of(found), np.array([False, True, False])

    monkeypatch.setattr(_noise, "_maximise_likelihood", step)
    found = fit_noise(start, record, fixed=fixed)
    factors = [1.0 if name in fixed else 10.0**0.1 for name in start.noise_names]
    np.testing.assert_allclose(found.noise, np.array(TRUE) * factors, rtol=1e-12)
    assert found.observer.noise == found.noise
    assert (found.start, found.names, found.at_bound) == (TRUE, start.noise_names, (start.noise_names[1],))
    cost = cost_of(start, [record])
    assert found.log_likelihood == (-0.5 * cost.of(np.log10(TRUE)), -0.5 * cost.of(np.log10(found.noise)))
    spoilt = find_outliers(measured_angles(record))
    assert (found.outliers, found.rows) == (int(spoilt.sum()), 300 - _noise.SETTLE - int(spoilt[_noise.SETTLE :].sum()))
    twice = fit_noise(start, [record, record], fixed=fixed)
    assert (twice.outliers, twice.rows) == (2 * found.outliers, 2 * found.rows)
    assert twice.log_likelihood == pytest.approx(found.log_likelihood, rel=1e-12)  # per measurement
    # Two hundred measurements are enough.
    assert fit_noise(start, drawn(rows=250), fixed=fixed).rows == 200
    with pytest.raises(DataError, match="got 199"):
        fit_noise(start, drawn(rows=249), fixed=fixed)


@pytest.mark.parametrize("free", [[True, True, True], [True, False, True], [False, True, False]])
def test_levels_of_least_cost_are_found_within_two_decades_and_an_end_is_told(free: list[bool]) -> None:
    start, best = np.array([-3.0, -2.0, -1.0]), np.array([-2.4, -5.0, -0.1])
    cost: Any = SimpleNamespace(of=lambda levels: float(((levels - best) ** 2).sum()))
    found, least, at_bound = _noise._maximise_likelihood(cost, start, np.array(free))
    expected = np.where(free, np.clip(best, start - 2.0, start + 2.0), start)
    np.testing.assert_allclose(found, expected, atol=2e-3)  # a thousandth of a decade ends the search
    assert least == pytest.approx(cost.of(found))
    assert at_bound.tolist() == [False, free[1], False]


def test_an_outlier_is_six_deviations_from_its_neighbours_and_three_rows_are_the_least() -> None:
    y = np.array([0.0, 1.0] * 20)[:, None]  # the median change is 1
    for far, spoilt in ((9.8, False), (10.0, True), (-7.8, False), (-8.0, True)):
        z = y.copy()
        z[20] = far
        # Both neighbours are at 1, and 6 times 1.4826 is 8.9.
        assert find_outliers(z)[20] == spoilt
    assert not find_outliers(np.array([[0.0], [1e9]])).any()
    still = np.zeros((9, 2))
    still[4, 1] = 1e-3
    assert np.flatnonzero(find_outliers(still)).tolist() == [4]
    still[2] = np.nan  # what did not come is no neighbour
    assert np.flatnonzero(find_outliers(still)).tolist() == [4]


@pytest.mark.parametrize("late", [0.0, 1.0, 1.5])
def test_the_error_ahead_is_that_of_estimates_to_what_was_measured_later(late: float) -> None:
    """A filter that tells the row's number, of an output that is it: it is `late` samples behind, in all or in gaps."""
    rows, seen = 200, []
    record = recording(rows=rows)
    ramp = 1e-3 * np.arange(rows)
    record = record.with_channels(pitch_measured=ramp, roll_measured=2.0 * ramp)

    def estimate(run: Recording) -> Any:
        seen.append(np.isnan(run.channels["pitch_measured"]))
        told = np.column_stack([ramp, 2.0 * ramp])
        told[77, 0] += 0.5  # in a gap
        told[60, 0] += 0.7  # in none
        return SimpleNamespace(outputs=told)

    observer: Any = SimpleNamespace(estimate=estimate, lead=0.02 * late, sample_time=0.02)
    found = look_ahead_error(observer, record)
    assert found == look_ahead_error(observer, record, 0.02 * late)
    row = np.arange(rows)
    gaps = (row >= 50) & (row % 25 >= 20)
    np.testing.assert_array_equal(seen[0], gaps)
    counted = np.flatnonzero(gaps if late < 1.0 else row >= 50)
    counted = counted[counted + math.ceil(late) < rows]
    errors = np.outer(np.full(counted.size, -1e-3 * late), [1.0, 2.0])
    errors[np.flatnonzero(counted == 77)[:, None], 0] += 0.5
    errors[np.flatnonzero(counted == 60)[:, None], 0] += 0.7
    assert found == pytest.approx(math.sqrt((errors**2).mean()), rel=1e-9)
