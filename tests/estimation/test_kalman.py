"""The Kalman observer: its runtime against filterpy, its promises on bad measurements, its file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError, load, read_archive, write_archive
from softneck.estimation import KalmanSettings, LinearNeck, _kalman_runtime, axis_plant
from softneck.estimation import _kalman_parts_runtime as _parts
from softneck.estimation._settings import SENSORS
from softneck.signals import Recording

from .by_filterpy import by_filterpy
from .necks import IN_TIME, TS, neck, recording, run_block, with_levels


def with_gaps(record: Recording, rows: slice) -> Recording:
    pitch = record.channels["pitch_measured"].copy()
    pitch[rows] = math.nan
    return record.with_channels(pitch_measured=pitch)


@pytest.mark.parametrize("compiled", [True, False], ids=["compiled", "plain"])
def test_the_runtime_equals_filterpy(compiled: bool) -> None:
    record = with_gaps(recording(rows=600), slice(200, 230))
    outliers = record.channels["roll_measured"].copy()
    outliers[[50, 51, 300]] += math.radians(30.0)
    record = record.with_channels(roll_measured=outliers)
    observer = KalmanSettings().design(neck())
    theirs = by_filterpy(observer, record)
    ours = run_block(observer, record, compiled=compiled)
    expected = np.column_stack([theirs.pitch, theirs.roll, theirs.pitch_rate, theirs.roll_rate])
    # Same equations in the same order; 600 updates add some 1e-14 of an angle below 1 rad. Rates divide by 0.02.
    np.testing.assert_allclose(ours[:, :2], expected[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours[:, 2:4], expected[:, 2:], rtol=0, atol=1e-12 / TS)
    np.testing.assert_allclose(ours[:, 4], theirs.innovation, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(ours[:, 5] > 0.5, theirs.healthy)
    assert not theirs.accepted[[50, 51, 300]].any()


def test_without_noise_and_model_error_the_estimate_is_the_angle_itself() -> None:
    record = recording(noise_deg=0.0)
    observer = replace(IN_TIME, measurement_noise_std=math.radians(0.05)).design(neck())
    estimates = observer.estimate(record)
    # What was unknown at the start has died out with the model's pole, exp(-5.3 x 8) < 1e-18, and the estimate
    # is the delay-aligned model itself; a delay off by one sample shows 1e-3 rad and more.
    np.testing.assert_allclose(estimates.pitch[400:], record.channels["pitch"][400:], atol=1e-9)
    np.testing.assert_allclose(estimates.roll[400:], record.channels["roll"][400:], atol=1e-9)


def test_a_right_model_filters_noise() -> None:
    record = recording(noise_deg=0.3)
    observer = IN_TIME.design(neck()).with_noise(np.radians([0.3, 0.005, 0.005]).tolist())
    error = observer.estimate(record).pitch - record.channels["pitch"]
    raw = record.channels["pitch_measured"] - record.channels["pitch"]
    assert np.std(error[100:]) < 0.3 * np.std(raw[100:])


@pytest.mark.slow
def test_the_innovation_is_chi_square_when_the_model_is_right() -> None:
    rng = np.random.default_rng(5)
    record = recording(noise_deg=0.1, rows=3000)
    walk = np.cumsum(math.radians(0.02) * rng.standard_normal((2, 3000)), axis=1)
    record = record.with_channels(
        pitch_measured=record.channels["pitch_measured"] + walk[0],
        roll_measured=record.channels["roll_measured"] + walk[1],
    )
    right = replace(IN_TIME, measurement_noise_std=math.radians(0.1)).design(neck())
    observer = with_levels(right, model_noise_std=1e-6)
    nis = observer.estimate(record).innovation[100:]
    # Mean 2 and 95 % below 5.99 for two degrees of freedom; over 2,900 samples the mean's std is 0.037 and
    # that of the share 0.4 %: four of them.
    assert np.mean(nis) == pytest.approx(2.0, abs=0.15)
    assert np.mean(nis < 5.991) == pytest.approx(0.95, abs=0.016)


def test_a_blackout_is_bridged_and_announced_after_100_ms() -> None:
    record = with_gaps(recording(rows=600), slice(300, 340))
    observer = IN_TIME.design(neck())
    y = run_block(observer, record)
    assert np.isfinite(y).all()
    healthy = y[:, 5] > 0.5
    assert healthy[:304].all()
    assert not healthy[304:340].any()
    assert healthy[340:].all()
    # The model is right, so only the noise of the last estimate is carried through 0.8 s.
    assert np.abs(y[300:340, 0] - record.channels["pitch"][300:340]).max() < math.radians(0.3)


def test_a_rejected_measurement_leaves_no_trace() -> None:
    record = recording(rows=400)
    spoiled = record.channels["pitch_measured"].copy()
    spoiled[200] = 1.5
    observer = KalmanSettings().design(neck())
    with_outlier = run_block(observer, record.with_channels(pitch_measured=spoiled))
    without = run_block(observer, with_gaps(record, slice(200, 201)))
    np.testing.assert_array_equal(with_outlier[:, :4], without[:, :4])
    assert with_outlier[200, 4] > observer.arrays[8][2]


def test_a_lasting_change_is_accepted_by_force_after_ten_rejections() -> None:
    record = recording(rows=600)
    shifted = record.channels["pitch_measured"].copy()
    shifted[300:] += math.radians(25.0)
    estimates = IN_TIME.design(neck()).estimate(record.with_channels(pitch_measured=shifted))
    assert not estimates.accepted[300:310].any()
    assert estimates.accepted[310]
    assert np.abs(estimates.pitch[400:] - shifted[400:]).max() < math.radians(0.5)


def test_invalid_measurements_are_ignored_whatever_they_say() -> None:
    block = KalmanSettings().design(neck()).block()
    state = block.initial_state()
    state, _ = block.step(state, [0.0, 0.0, 0.0, 0.1, 0.0, 1.0])
    ignored, _ = block.step(state, [0.0, 0.0, 0.0, 0.7, 0.7, 0.0])
    missing, _ = block.step(state, [0.0, 0.0, 0.0, math.nan, math.nan, 1.0])
    np.testing.assert_array_equal(ignored.values, missing.values)
    assert np.isfinite(missing.values).all()


@pytest.mark.parametrize("form", ["model", "gyro"])
def test_a_validity_of_a_half_is_none_for_angles_and_for_rates_that_are_held(form: Any) -> None:
    block = KalmanSettings(form=form).design(neck()).block()
    rates = [0.02, -0.01] * (form == "gyro")
    state, _ = block.step(block.initial_state(), [0.0, 0.0, 0.0, 0.1, 0.0, 1.0, *rates])
    none, half = (block.step(state, [0.0, 0.0, 0.0, 0.7, 0.7, valid, *rates])[0].values for valid in (0.0, 0.5))
    np.testing.assert_array_equal(half, none)


def test_pause_and_resume_equals_one_run() -> None:
    block = KalmanSettings().design(neck()).block()
    U = np.random.default_rng(2).standard_normal((50, 6)) * 0.1 + np.array([0, 0, 0, 0, 0, 1.0])
    whole = block.run(block.initial_state(), U)[1]
    state, first = block.run(block.initial_state(), U[:20])
    np.testing.assert_array_equal(np.vstack([first, block.run(state, U[20:])[1]]), whole)


def test_it_starts_with_the_first_measurement_and_the_setpoints_as_they_stand() -> None:
    observer = IN_TIME.design(neck())
    block = observer.block()
    assert block.initial_state().outputs[5] == 0.0
    _, y = block.step(block.initial_state(), [2.0, 2.0, 2.0, 0.3, -0.2, 1.0])
    # The 40 deg of doubt against 0.05 deg of noise leave 1e-6 of the angle.
    assert y[0] == pytest.approx(0.3, rel=1e-4)
    assert y[1] == pytest.approx(-0.2, rel=1e-4)
    assert y[5] == 1.0


def test_steady_gain_equals_that_of_python_control() -> None:
    observer = KalmanSettings(sensor="mpu9250").design(neck())
    kf = observer.filterpy()
    for _ in range(3000):
        kf.predict(np.zeros((2, 1)))
        kf.update(np.zeros((2, 1)))
    # The predictor's gain is F times the filter's.
    gain = np.asarray(control.dlqe(kf.F, np.eye(4), kf.H, kf.Q, kf.R)[0])
    np.testing.assert_allclose(kf.F @ kf.K, gain, atol=1e-9)


def test_jacobi_order_uses_setpoints_one_sample_younger() -> None:
    sequential, jacobi = (KalmanSettings(order=order).design(neck()) for order in ("sequential", "jacobi"))
    assert sequential.delays == (4, 2)
    assert jacobi.delays == (5, 3)
    record = recording(rows=300)
    # Offline there is one truth, but for the sample more in which the start is in doubt: gone within a second.
    np.testing.assert_allclose(jacobi.estimate(record).pitch[50:], sequential.estimate(record).pitch[50:], atol=1e-6)


def test_a_saved_observer_is_the_same(tmp_path: Path) -> None:
    observer = KalmanSettings(sensor="mpu9250", order="jacobi").design(neck())
    observer.save(tmp_path / "o.npz")
    again = load(tmp_path / "o.npz", role="observer")
    assert (again.noise, again.sensor, again.order) == (observer.noise, "mpu9250", "jacobi")
    record = recording(rows=50)
    np.testing.assert_array_equal(run_block(again, record), run_block(observer, record))
    assert again.summary() == observer.summary()


def test_a_damaged_observer_file_is_refused(tmp_path: Path) -> None:
    KalmanSettings().design(neck()).save(tmp_path / "o.npz")
    header, arrays = read_archive(tmp_path / "o.npz")
    header = {key: value for key, value in header.items() if not key.startswith("format")}
    write_archive(tmp_path / "bad.npz", header, {**arrays, "H": arrays["H"].T})
    with pytest.raises(FileFormatError, match=r"its array `H` has shape \(4, 2\); \(2, 4\) is needed"):
        load(tmp_path / "bad.npz")


def test_delays_and_higher_orders_are_split_off() -> None:
    system = control.TransferFunction([0.1, 0.05], [1.0, -1.2, 0.4, 0.0, 0.0, 0.0], TS)
    plant = axis_plant(LinearNeck(pitch=system, roll=system), "pitch")
    assert (plant.order, plant.delay) == (2, 3)
    A, B, C = plant.observable_form()
    w = np.array([0.5, 5.0, 50.0])
    z = np.exp(1j * w * TS)
    ours = np.array([C @ np.linalg.solve(v * np.eye(2) - A, B) for v in z]) * z**-3
    np.testing.assert_allclose(ours, np.asarray(system(z)), rtol=1e-12)
    np.testing.assert_allclose(plant.response(w, extra_delay=1) * z, np.asarray(system(z)), rtol=1e-12)


@pytest.mark.parametrize(
    ("pitch", "error", "message"),
    [
        (control.TransferFunction([1.0], [1.0, 5.0]), SettingsError, "must be discrete"),
        (control.TransferFunction([1.0], [1.0, -1.0], TS), SettingsError, "not stable"),
        (control.TransferFunction([1.0, 0.0], [1.0, -0.5], TS), DataError, "strictly proper"),
        (control.TransferFunction([1.0], [1.0, -0.5], 0.01), SettingsError, "different sample times"),
    ],
    ids=["continuous", "integrator", "direct", "sample_time"],
)
def test_wrong_models_are_refused(pitch: control.TransferFunction, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        KalmanSettings().design(LinearNeck(pitch=pitch, roll=neck().roll))


def test_a_model_without_transfer_functions_is_refused() -> None:
    with pytest.raises(SettingsError, match="a linear model is needed"):
        KalmanSettings().design(object())  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sensor": "imu"}, "unknown sensor `imu`"),
        ({"measurement_noise_std": 0.0}, "`measurement_noise_std` must be positive"),
        ({"measurement_noise_std": 5.0}, "got 5: degrees"),
        ({"disturbance_noise_std": math.nan}, "`disturbance_noise_std` must be a finite"),
        ({"order": "random"}, "`order` must be one of"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        KalmanSettings(**settings).design(neck())  # pyright: ignore[reportArgumentType]


def test_a_recording_of_another_sample_time_is_refused() -> None:
    record = recording(rows=100)
    other = Recording(record.time / 2, TS / 2, record.channels)
    with pytest.raises(DataError, match=r"sample time 0\.01 s, the observer 0\.02 s"):
        KalmanSettings().design(neck()).estimate(other)


def test_a_noise_parameter_out_of_range_is_refused() -> None:
    with pytest.raises(SettingsError, match="`measurement_noise_std` must be between"):
        KalmanSettings().design(neck()).initial_state(measurement_noise_std=0.0)


def test_sensors_are_named_as_they_are_listed() -> None:
    assert all(name == sensor.name and sensor.noise_std > 0 for name, sensor in SENSORS.items())


def test_inputs_are_kept_for_the_longest_lag_of_any_output() -> None:
    constants = np.ones(_parts.KALMAN_MORE_LAGS + 2)
    places = (_parts.KALMAN_LAG, _parts.KALMAN_LAG + 1, _parts.KALMAN_MORE_LAGS, _parts.KALMAN_MORE_LAGS + 1)
    for axis, place in enumerate(places):
        for lag, rows in ((4.0, 5), (4.25, 6)):
            later = constants.copy()
            later[place] = lag
            assert _parts.kalman_line_length(later) == rows
            assert _parts.kalman_lag(later, axis) == lag


@pytest.mark.parametrize("outputs", [2, 3])
def test_an_innovation_that_is_no_number_passes_no_gate(outputs: int) -> None:
    n = outputs
    constants = np.full(12, 9.0)
    p: Any = SimpleNamespace(H=np.eye(n), constants=constants, outputs=outputs, n=n)
    for spoilt, accepted in ((1.0, True), (math.nan, False), (math.inf, False)):
        x: Any = SimpleNamespace(x=np.zeros(n), log_det=0.0)
        P = np.eye(n)
        measured = np.full(n, 0.1)
        measured[-1] *= spoilt
        with np.errstate(all="ignore"):
            found = _kalman_runtime.kalman_correct(p, 0.1, x, P, measured, False)
        assert found[1] is accepted
        # What is refused leaves no trace.
        assert (x.x.any(), (np.eye(n) == P).all()) == (accepted, not accepted)


@pytest.mark.parametrize("outputs", [1, 2])
def test_the_scatter_of_a_sensor_is_the_mean_square_of_its_changes_and_a_quiet_one_is_not_frozen(outputs: int) -> None:
    rng, c = np.random.default_rng(0), np.zeros(40)
    c[_parts.KALMAN_DIVIDER], c[_parts.KALMAN_FROZEN] = 1.0, 5.0
    x: Any = SimpleNamespace(age=0.0, repeats=-1.0, scatter=0.0, measured=np.zeros(outputs))
    last: Any = None
    scatter, noise = 0.0, 0.01
    for y in np.cumsum(1e-3 * noise * rng.standard_normal((200, outputs)), axis=0):
        assert _parts.kalman_usable(c, x, y, 1.0, noise)
        change = 0.0 if last is None else float(np.mean((y - last) ** 2))
        scatter = scatter if last is None else _parts.KALMAN_KEEP * scatter + (1.0 - _parts.KALMAN_KEEP) * change
        last = y
        assert x.scatter == pytest.approx(scatter, rel=1e-12)
    # One as quiet as no sensor of this noise repeats its values without being broken; one that was noisy does not.
    assert all(_parts.kalman_usable(c, x, last, 1.0, noise) for _ in range(20))
    x.scatter, x.repeats = noise**2, 0.0
    assert [_parts.kalman_usable(c, x, last, 1.0, noise) for _ in range(6)] == [True] * 3 + [False] * 3
