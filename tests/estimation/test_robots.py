"""Observers of other robots: filterpy for one, two and three outputs, and what their files say of their sensors."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import load
from softneck.core import DataError, SettingsError
from softneck.cosim import simulate
from softneck.design import design_controller
from softneck.estimation import KalmanObserver, KalmanSettings, consistency, fit_noise
from softneck.identification import Model
from softneck.robot import Robot
from softneck.signals import Recording
from tests.design.test_robots import BELLOWS, TS, plant

from .by_filterpy import by_filterpy
from .necks import with_levels

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

# 5 mm of 20 mm of noise would drown it; 0.1 mm is what a string potentiometer has.
SENSED = Robot.from_dict({**BELLOWS.as_dict(), "sensor": {"noise_std": 0.1, "delay_s": 0.05, "rate_hz": 50.0}})
ROBOTS = {1: Robot.preset("antagonist"), 2: Robot.preset("trunk4"), 3: SENSED}
GAINS = {1: 0.08, 2: 0.08, 3: 1e-7}


def model_of(outputs: int) -> Model:
    return plant(ROBOTS[outputs], gain=GAINS[outputs], rest=0.0 if outputs < 3 else 0.05)


def recording(model: Model, *, rows: int = 400, noise: float = 1.0, seed: int = 1) -> Recording:
    """Levels at random through the model, with `noise` times the sensor's noise on what is measured."""
    robot, rng = model.robot, np.random.default_rng(seed)
    n, m = len(robot.motors.names), len(robot.outputs.names)
    low, high = (0.0, 3e5) if robot is SENSED else (-2.0, 2.0)
    u = np.repeat(rng.uniform(low, high, (rows // 40, n)), 40, axis=0)
    block = model.block()
    given = np.full((rows, 2 * n + m), np.nan)
    given[:, :n] = u
    # A plant's rows are those of the next instant.
    y = np.vstack([block.initial_state().outputs[:m], block.run(block.initial_state(), given)[1][:-1, :m]])
    std = (robot.noise_std or 0.0) * (1e-3 if robot is SENSED else 1.0)
    channels: dict[str, Any] = {f"motor_setpoint_{j + 1}": u[:, j] for j in range(n)}
    for i, name in enumerate(robot.outputs.names):
        channels[name] = y[:, i]
        channels[f"{name}_measured"] = y[:, i] + noise * std * rng.standard_normal(rows)
        channels[f"{name}_rate"] = np.gradient(y[:, i], TS)
    return Recording(np.arange(rows) * TS, TS, channels, robot=robot)


def run_block(observer: KalmanObserver, record: Recording, *, compiled: bool) -> np.ndarray:
    from softneck.runtime import load_runtime

    names = record.robot.outputs.names
    z = np.column_stack([record.channels[f"{name}_measured"] for name in names])
    P = record.set_points[np.maximum(np.arange(len(record)) - 1, 0)]
    U: Any = np.column_stack([P, z, np.isfinite(z).all(axis=1)])
    if observer.form == "gyro":
        U = np.column_stack([U, *(record.channels[f"{name}_rate"] for name in names)])
    block = observer.block()
    assert len(block.inputs) == U.shape[1]
    if compiled:
        return block.run(block.initial_state(), U)[1]
    state, Y = block.initial_state(), np.zeros((len(U), len(block.outputs)))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    return Y


# The three outputs are lengths, which have no gyro.
@pytest.mark.parametrize(("outputs", "form"), [(1, "model"), (2, "model"), (3, "model"), (1, "gyro"), (2, "gyro")])
def test_the_runtime_equals_filterpy(outputs: int, form: str) -> None:
    record = recording(model_of(outputs))
    name = record.robot.outputs.names[-1]
    y = record.channels[f"{name}_measured"].copy()
    span = float(np.ptp(y))
    y[[90, 91, 300]] += 3.0 * span
    y[200:230] = math.nan
    record = record.with_channels(**{f"{name}_measured": y})
    sensor = "mpu9250" if form == "gyro" else "paper"
    observer = KalmanSettings(form=form, sensor=sensor, sensor_delay=0.03).design(model_of(outputs))
    theirs, ours = by_filterpy(observer, record), run_block(observer, record, compiled=False)
    m = outputs
    # Same equations; 400 updates add some 1e-14 of the outputs' span. Rates divide by 0.02, S is inverted.
    np.testing.assert_allclose(ours[:, :m], theirs.outputs, rtol=0, atol=1e-11 * span)
    np.testing.assert_allclose(ours[:, m : 2 * m], theirs.rates, rtol=0, atol=1e-11 * span / TS)
    np.testing.assert_allclose(ours[:, 2 * m], theirs.innovation, rtol=1e-7, atol=1e-8)
    np.testing.assert_array_equal(ours[:, 2 * m + 1] > 0.5, theirs.healthy)
    if form == "model":
        assert not theirs.accepted[[90, 300]].any()


@pytest.mark.slow
def test_compiled_it_is_the_same_filter() -> None:
    record = recording(model_of(3), rows=1200)
    full = KalmanSettings().design(model_of(3))
    a, b = run_block(full, record, compiled=True), run_block(full, record, compiled=False)
    span = float(np.ptp(record.outputs))
    np.testing.assert_allclose(a[:, :3], b[:, :3], rtol=0, atol=1e-11 * span)


def test_it_filters_noise_and_its_innovations_are_as_large_as_it_says() -> None:
    """Delay, noise and rate are those of the robot's file: nothing is told twice."""
    model = model_of(3)
    quiet = KalmanSettings(sensor_delay=0.0, disturbance_noise_std=1e-3)
    observer = with_levels(quiet.design(model), model_noise_std=1e-6)
    record = recording(model, rows=1520)
    error = observer.estimate(record).outputs - record.outputs
    assert error[200:].std() < 0.35 * 1e-4
    found = consistency(observer, record)
    low, high = found.mean_band
    assert low < found.mean < high
    assert math.isclose(0.5 * (low + high), 3.0, rel_tol=0.01)
    assert "measurement 0.1 mm" in observer.summary()


@pytest.mark.slow
def test_noise_levels_are_found_again() -> None:
    record = recording(model_of(1), rows=2000, noise=4.0)
    # The recording is of the model itself: what it misses is nothing.
    settings = KalmanSettings(sensor_delay=0.0, disturbance_noise_std=1e-5)
    fit = fit_noise(settings.design(model_of(1)), record, fixed=("disturbance_noise_std",))
    # 2000 measurements tell a standard deviation within 1/sqrt(4000) = 1.6 %; three of these.
    assert math.isclose(fit.noise[0], 4.0 * (ROBOTS[1].noise_std or 0.0), rel_tol=0.05)


@pytest.mark.slow
def test_a_loop_with_an_observer_closes_over_dropouts(tmp_path: Path) -> None:
    model = model_of(2)
    KalmanSettings().design(model).save(tmp_path / "observer.npz")
    observer = load(tmp_path / "observer.npz")
    assert observer.robot.hash == model.robot.hash
    result: Any = simulate({
        "duration_s": 4.0, "plant": model, "observer": observer, "controller": design_controller("pi", model),
        "reference": {"kind": "step", "roll_deg": 8.0, "at_s": 0.5},
        "fault": [{"kind": "sensor_dropout", "start_s": 2.0, "duration_s": 0.08}],
    })  # fmt: skip
    assert result.metrics["roll"]["overshoot_pct"] < 5.0
    assert abs(result["roll"][-1] - math.radians(8.0)) < math.radians(0.05)


def test_levels_are_given_in_the_unit_of_the_outputs() -> None:
    observer = KalmanSettings(measurement_noise_std=0.2).design(model_of(3))
    assert observer.noise[0] == pytest.approx(2e-4)
    # The other levels go with the range of the outputs, and with that of the motors where the file gives none.
    wide = replace(SENSED, outputs=replace(SENSED.outputs, min=(10.0,) * 3, max=(90.0,) * 3))
    few, many = (KalmanSettings().design(plant(robot, gain=1e-7)).noise for robot in (SENSED, wide))
    assert many[1] == pytest.approx(4.0 * few[1])
    open_ended = replace(SENSED, outputs=replace(SENSED.outputs, min=None, max=None))
    few, many = (KalmanSettings().design(plant(open_ended, gain=gain)).noise for gain in (1e-8, 1e-7))
    assert many[1] == pytest.approx(10.0 * few[1])


def silent_on(key: str) -> Robot:
    sensor = {name: value for name, value in SENSED.as_dict()["sensor"].items() if name != key}
    return Robot.from_dict({**SENSED.as_dict(), "sensor": sensor})


def test_a_sensor_whose_rate_nobody_gives_measures_in_each_sample() -> None:
    given, silent = (KalmanSettings().design(plant(robot, gain=1e-7)) for robot in (SENSED, silent_on("rate_hz")))
    np.testing.assert_array_equal(given.constants, silent.constants)


@pytest.mark.parametrize(("key", "form"), [("noise_std", "model"), ("delay_s", "nonlinear")])
def test_what_the_robot_does_not_say_of_its_sensor_is_asked_for(key: str, form: str) -> None:
    silent = silent_on(key)
    line = rf"robot `bellows` \(\w{{8}}\) gives no `sensor.{key}`, which an observer needs; add it"
    with pytest.raises(SettingsError, match=line):
        KalmanSettings(form=form).design(plant(silent, gain=1e-7))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"form": "gyro"}, "a gyro measures angles, robot `bellows`"),
        ({"sensor": "mpu9250"}, "`sensor` mpu9250 measures angles, robot `bellows`"),
    ],
)
def test_what_does_not_fit_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        KalmanSettings(**settings).design(model_of(3))


def test_a_recording_of_another_robot_is_refused() -> None:
    for form in ("model", "nonlinear"):
        observer = KalmanSettings(form=form).design(model_of(1))
        with pytest.raises(DataError, match="the recording and the observer of two robots cannot be used together"):
            observer.estimate(recording(model_of(2), rows=80))
