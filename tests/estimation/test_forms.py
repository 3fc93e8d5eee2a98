"""The three forms: runtime against filterpy to 1e-12, late and slow sensors, what the gyro is worth."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.estimation import KalmanSettings, LinearNeck, _kalman_runtime, axis_plant
from softneck.estimation._kalman_parts_runtime import KALMAN_FROZEN, KALMAN_GATE
from softneck.signals import Recording

from ..data import slow_but
from .by_filterpy import by_filterpy
from .necks import (
    IN_TIME,
    TS,
    changed,
    neck,
    recording,
    rows_of,
    run_block,
    run_plain,
    smooth_motion,
    with_levels,
    without,
)

FAST = 0.01
LATE = KalmanSettings(sample_time=FAST, sensor_delay=0.025)


def spoilt(record: Recording) -> Recording:
    """Gaps, a blackout, outliers, a lasting jump, a frozen stretch, a gap of the gyro, each second sample held."""
    for name in ("pitch_measured", "roll_measured"):
        held = record.channels[name].copy()
        held[1::2] = held[:-1:2]
        record = record.with_channels(**{name: held})
    both = ("pitch_measured", "roll_measured")
    record = changed(record, slice(100, 160), math.nan, *both)
    record = changed(record, [60, 61, 300], 0.9, "roll_measured")
    record = changed(record, slice(330, 390), 0.05, *both)
    record = changed(record, slice(420, 470), -0.6, "pitch_measured")
    return changed(record, slice(500, 510), math.nan, "pitch_rate", "roll_rate")


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "plain"])
@pytest.mark.parametrize(
    "settings",
    [
        LATE,
        replace(LATE, form="gyro", gyro_delay=0.01),
        replace(LATE, form="gyro", sensor_delay=0.0),
    ],
    ids=["model", "gyro", "gyro in time"],
)
def test_the_runtime_of_every_form_equals_filterpy(settings: KalmanSettings, compiled: bool) -> None:
    record = spoilt(smooth_motion(rows=600))
    observer = settings.design(neck())
    theirs = by_filterpy(observer, record)
    ours = run_block(observer, record, compiled=compiled)
    # Same equations in another order of sums; angles below 1 rad. Rates divide by 0.01.
    np.testing.assert_allclose(ours[:, :2], np.column_stack([theirs.pitch, theirs.roll]), rtol=0, atol=1e-12)
    rates = np.column_stack([theirs.pitch_rate, theirs.roll_rate])
    np.testing.assert_allclose(ours[:, 2:4], rates, rtol=0, atol=1e-12 / FAST)
    np.testing.assert_allclose(ours[:, 4], theirs.innovation, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours[:, 5] > 0.5, theirs.healthy)
    # The recording holds what it should: samples judged, refused, and a stretch without health.
    assert theirs.judged.any()
    assert (theirs.judged & ~theirs.accepted).any()
    assert not theirs.healthy[375]


def test_the_gyro_form_finds_the_bias_and_the_angle() -> None:
    record = smooth_motion(bias_deg=0.5)
    observer = replace(IN_TIME, form="gyro", measurement_noise_std=math.radians(0.02)).design(neck(sample_time=FAST))
    estimates = observer.estimate(record)
    late = slice(800, None)
    true_rate = 0.3 * 3.0 * np.cos(3.0 * record.time)
    # 0.02 deg of noise, some 10 samples averaged; the bias of 0.5 deg/s would show in the rate.
    assert np.std(estimates.pitch[late] - record.channels["pitch"][late]) < math.radians(0.015)
    assert abs(np.mean(estimates.pitch_rate[late] - true_rate[late])) < math.radians(0.05)


def test_the_gyro_carries_the_angle_through_a_second_of_darkness() -> None:
    record = changed(smooth_motion(), slice(1000, 1100), math.nan, "pitch_measured", "roll_measured")
    observer = replace(IN_TIME, form="gyro", measurement_noise_std=math.radians(0.02)).design(neck(sample_time=FAST))
    error = observer.estimate(record).pitch[1000:1100] - record.channels["pitch"][1000:1100]
    # 0.05 deg/s of rate noise makes 0.005 deg in 1 s; a bias known to 0.05 deg/s makes 0.05.
    assert np.abs(error).max() < math.radians(0.1)


@pytest.mark.parametrize("delay", slow_but([0.0, 0.01, 0.025, 0.05], [0.0, 0.025]))
def test_a_late_sensor_of_known_delay_costs_no_lag(delay: float) -> None:
    record = smooth_motion(noise_deg=0.001, bias_deg=0.0)
    late = {
        f"{axis}_measured": size * np.sin(w * (record.time - delay))
        for axis, size, w in (("pitch", 0.3, 3.0), ("roll", 0.2, 5.0))
    }
    settings = KalmanSettings(form="gyro", sensor_delay=delay, measurement_noise_std=math.radians(0.01))
    estimates = settings.design(neck(sample_time=FAST)).estimate(record.with_channels(**late))
    error = (estimates.pitch - record.channels["pitch"])[300:]
    # Unaligned the error is 0.9 rad/s times the delay: up to 2.6 deg. The gyro knows the way from the measurement to
    # now but for half a sample.
    assert np.degrees(np.abs(error)).max() < 0.1


def test_the_delay_of_a_late_sensor_is_taken_off_the_models_dead_time() -> None:
    """Dead time of the model is mostly the sensor's: what is told of now is the angle two samples ahead."""
    record = recording(noise_deg=0.0)
    observer = KalmanSettings(sensor_delay=2 * TS).design(neck())
    estimates = observer.estimate(record)
    # Two samples ahead of the measured angle, by set-points that are known: exact but for how the doubt of the start
    # was shared out between model and disturbance, which fades within seconds. One sample off shows 1e-3 rad.
    np.testing.assert_allclose(estimates.pitch[400:-2], record.channels["pitch"][402:], rtol=0, atol=1e-7)


def test_held_samples_of_a_slow_sensor_count_once() -> None:
    record = smooth_motion()
    held, gaps = record, record
    for name in ("pitch_measured", "roll_measured"):
        column = record.channels[name].copy()
        column[1::2] = column[:-1:2]
        held = held.with_channels(**{name: column})
        gaps = changed(gaps, slice(1, None, 2), math.nan, name)  # pyright: ignore[reportArgumentType]
    observer = replace(IN_TIME, form="gyro").design(neck(sample_time=FAST))
    np.testing.assert_array_equal(run_block(observer, held)[:, :5], run_block(observer, gaps)[:, :5])


def test_a_gap_of_the_gyro_is_bridged_and_doubted() -> None:
    observer = replace(IN_TIME, form="gyro").design(neck(sample_time=FAST))
    record = changed(smooth_motion(), slice(700, 720), math.nan, "pitch_rate", "roll_rate")
    estimates = observer.estimate(record)
    assert np.isfinite(estimates.pitch).all()
    spread = estimates.covariance[:, 0, 0]
    assert spread[710] > 2.0 * spread[690]
    # While rates are missing the measurements carry the angle: their noise is 0.02 deg, doubted less than the rate.
    assert np.abs(estimates.pitch - record.channels["pitch"])[700:720].max() < math.radians(0.2)


def test_nothing_that_a_sensor_says_leaves_a_nan_in_the_state() -> None:
    rng = np.random.default_rng(4)
    for form in ("model", "gyro"):
        block = replace(LATE, form=form).design(neck()).block()
        U = rng.standard_normal((300, len(block.inputs)))
        U[:, 5] = rng.random(300) > 0.3
        for i, port in enumerate(block.inputs):
            if port.missing:
                U[rng.random(300) > 0.5, i] = math.nan
        state, Y = block.run(block.initial_state(), U)
        assert np.isfinite(Y).all()
        assert np.isfinite(state.values).all()
        np.testing.assert_allclose(run_plain(block, U), Y, rtol=1e-9, atol=1e-12)


def test_a_frozen_sensor_is_told_after_20_identical_samples() -> None:
    record = recording(rows=400)
    frozen = record
    for name in ("pitch_measured", "roll_measured"):
        frozen = changed(frozen, slice(200, 300), float(record.channels[name][199]), name)
    observer = with_levels(without(KalmanSettings().design(neck()), KALMAN_GATE), model_noise_std=math.radians(3.0))
    y, estimates = run_block(observer, frozen), observer.estimate(frozen)
    # Row 199 is the first of the 20.
    assert y[217, 5] == 1.0
    assert (y[218:300, 5] == 0.0).all()
    assert y[301, 5] == 1.0
    assert not estimates.accepted[218:300].any()
    off = without(KalmanSettings().design(neck()), KALMAN_FROZEN)
    np.testing.assert_array_equal(off.estimate(frozen).judged, True)


def test_a_plant_without_noise_may_stand_still() -> None:
    block = KalmanSettings().design(neck()).block()
    U = np.zeros((200, 6))
    U[:, 5] = 1.0
    assert (block.run(block.initial_state(), U)[1][:, 5] == 1.0).all()


def test_a_model_at_20_ms_is_taken_to_10_ms() -> None:
    slow = axis_plant(LinearNeck(pitch=second_order(0.02), roll=second_order(0.02)), "pitch")
    fast = slow.resample(0.01)
    exact = axis_plant(LinearNeck(pitch=second_order(0.01), roll=second_order(0.01)), "pitch")
    assert (fast.delay, fast.sample_time) == (2 * slow.delay, 0.01)
    # Matrix roots of an order-2 system keep some 1e-14.
    np.testing.assert_allclose(fast.denominator, exact.denominator, atol=1e-11)
    np.testing.assert_allclose(fast.numerator, exact.numerator, atol=1e-11)


def second_order(sample_time: float) -> control.TransferFunction:
    """A damped oscillation, held input, dead time of 60 ms."""
    held = control.sample_system(control.TransferFunction([40.0], [1.0, 8.0, 60.0]), sample_time, method="zoh")
    return held * control.TransferFunction([1.0], [1.0, *[0.0] * round(0.06 / sample_time)], sample_time)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"form": "magic"}, "`form` must be one of"),
        ({"sample_time": 0.015}, r"`sample_time` 0\.015 s must divide that of the model, 0\.02 s"),
        ({"sample_time": 0.04}, r"must divide that of the model"),
        ({"sample_time": -0.01}, "`sample_time` must be positive"),
        ({"sensor_delay": -0.01}, "`sensor_delay` must be between"),
        ({"gyro_delay": 0.02, "sensor_delay": 0.0}, "`gyro_delay` 0.02 s must be at most `sensor_delay`"),
    ],
)
def test_wrong_rates_and_forms_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        KalmanSettings(**settings).design(neck())  # pyright: ignore[reportArgumentType]


def test_a_pole_that_no_held_input_makes_cannot_be_resampled() -> None:
    odd = control.TransferFunction([0.1], [1.0, 0.5], TS)
    with pytest.raises(SettingsError, match=r"pole at -0\.5"):
        KalmanSettings(sample_time=0.01).design(LinearNeck(pitch=odd, roll=odd))


def test_a_recording_without_rates_is_refused_by_a_filter_with_gyro() -> None:
    with pytest.raises(DataError, match="no channel `pitch_rate`"):
        KalmanSettings(form="gyro").design(neck()).estimate(recording(rows=50))


def test_time_that_runs_backwards_is_refused() -> None:
    record = recording(rows=50)
    time = record.time.copy()
    time[30:] -= 0.5
    with pytest.raises(DataError, match="time"):
        KalmanSettings().design(neck()).estimate(Recording(time, TS, record.channels))


def test_the_gyros_ports_are_there_with_the_gyro_only() -> None:
    names = [port.name for port in KalmanSettings(form="gyro").design(neck()).block().inputs]
    assert names[-2:] == ["pitch_rate_measured", "roll_rate_measured"]
    record = smooth_motion(rows=5)
    assert rows_of(KalmanSettings(form="gyro").design(neck()), record).shape[1] == len(names)
    assert len(KalmanSettings().design(neck()).block().inputs) == 6


# -- the filter's algebra, in both of its forms ------------------------------------------------------------------------


def positive(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.standard_normal((n, n))
    return A @ A.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("outputs", [1, 2, 3, 5])
def test_the_innovations_covariance_is_inverted_with_its_determinant(outputs: int) -> None:
    rng = np.random.default_rng(outputs)
    S, e, r = positive(rng, outputs), rng.standard_normal(outputs), 0.3
    whole = S + r * np.eye(outputs)
    expected = e @ np.linalg.solve(whole, e), np.linalg.slogdet(whole)[1]
    for invert in (_kalman_runtime.kalman_more, *([_kalman_runtime.kalman_two] if outputs == 2 else [])):
        # What rounding made unsymmetric counts by its symmetric part.
        skew = 1e-3 * np.triu(rng.standard_normal((outputs, outputs)), 1)
        inverse = S + skew - skew.T
        np.testing.assert_allclose(invert(inverse, e, r), expected, rtol=1e-10)
        np.testing.assert_allclose(inverse, np.linalg.inv(whole), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("n", "outputs"), [(2, 1), (4, 2), (6, 3)])
def test_both_forms_of_the_algebra_are_the_textbooks(
    n: int, outputs: int, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """P = F P F' + Q and P = (I - K H) P (I - K H)' + r K K' (Anderson and Moore 1979), by loops and by BLAS."""
    monkeypatch.setattr(_kalman_runtime, "COMPILED", compiled)
    rng = np.random.default_rng(n)
    P, K, H = positive(rng, n), rng.standard_normal((n, outputs)), rng.standard_normal((outputs, n))
    # Half of F is zero, as of axes that are coupled by the gate alone.
    F = rng.standard_normal((n, n)) * (np.arange(n)[:, None] % 2 == np.arange(n) % 2)
    B = rng.standard_normal((n, outputs))
    QM, QW = positive(rng, n), positive(rng, n)
    np.testing.assert_allclose(_kalman_runtime.kalman_columns(F, H), F @ H.T, rtol=1e-12)
    corrected, J = P.copy(), np.eye(n) - K @ H
    _kalman_runtime.kalman_joseph(corrected, K, H, 0.3)
    np.testing.assert_allclose(corrected, J @ P @ J.T + 0.3 * K @ K.T, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(corrected, corrected.T, rtol=1e-12)
    arrays: Any = SimpleNamespace(F=F, B=B, first_noise=QM, second_noise=QW, n=n)
    x, u, ahead = rng.standard_normal(n), rng.standard_normal(outputs), P.copy()
    begin = x.copy()
    _kalman_runtime.kalman_predict(arrays, np.array([9.0, 0.5, 0.2]), x, ahead, u)
    np.testing.assert_allclose(x, F @ begin + B @ u, rtol=1e-12)
    np.testing.assert_allclose(ahead, F @ P @ F.T + 0.25 * QM + 0.04 * QW, rtol=1e-10, atol=1e-12)
