"""The change detector: no alarm on the neck it knows, an alarm on another; runtime, sums and file agree to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, SettingsError, load
from softneck.estimation.changes._change import ChangeDetector
from softneck.estimation.changes._settings import ChangeSettings
from softneck.identification import Model, OutputError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, concatenate, signal
from softneck.signals.detection._charts_runtime import chart_spread

NECK = VirtualNeck(NeckParameters.paper())
SET_POINTS = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3")


def moved(motion: str, payload: float, seed: int, seconds: float = 26.0) -> Recording:
    made = record(signal(motion), NECK, seed=seed, payload=payload)
    return made.rows(0, round(seconds / made.sample_time))


@pytest.fixture(scope="module")
def model() -> Model:
    return OutputError().fit(moved("eq22", 0.0, 1, 60.0))


@pytest.fixture(scope="module")
def quiet() -> Recording:
    return concatenate([moved(name, 0.0, 2) for name in ("steps", "sine", "rotation")])


@pytest.fixture(scope="module")
def detector(model: Model, quiet: Recording) -> ChangeDetector:
    return ChangeSettings().design(model, quiet)


def biased(run: Recording, row: int, degrees: float) -> Recording:
    """The sensor reads otherwise from a row on: a change of a known size at a known time."""
    pitch = run.channels["pitch"].copy()
    pitch[row:] += np.radians(degrees)
    return run.with_channels(pitch=pitch)


def test_the_neck_it_knows_raises_no_alarm_and_another_does(detector: ChangeDetector) -> None:
    run = moved("rotation", 0.0, 7)
    assert not detector.watch(run)[:, 0].any()
    told = detector.watch(biased(run, 600, 15.0))
    first = int(np.argmax(told[:, 0] > 0.5))
    # 15 deg are five times what this line misses: each period counts as much as the clip allows, and the two largest
    # thresholds are a few such periods of 0.5 s.
    assert 600 < first < 600 + 400
    np.testing.assert_allclose(told[first:, 1], 0.02 * (1 + np.arange(len(run) - first)), atol=1e-9)


def test_its_sums_are_those_of_the_charts(detector: ChangeDetector) -> None:
    """Independent method: the averages anew from free run and measurement, scored by `chart_spread` and summed."""
    run = biased(moved("sine", 0.0, 8), 500, 6.0)
    states, chart = detector.states(run), detector.arrays["chart"]
    period, settings = int(chart[0]), ChangeSettings()
    error = (run.outputs - states["angles"]) / np.sqrt(
        detector.arrays["spread"][:, 0]
        + detector.arrays["spread"][:, 1] * states["fastest"] ** 2
        + detector.arrays["spread"][:, 2] * states["angles"] ** 2
    )
    sums = np.zeros(3)
    limit = settings.clip * np.sqrt(settings.ratio)
    for last in range(period - 1, len(run), period):
        rows = slice(last + 1 - period, last + 1)
        if last < chart[2] or not (states["fastest"][rows] > chart[6]).any() or states["changed"][rows].any():
            continue
        average = np.clip(error[rows].mean(axis=0), -limit, limit)
        each = [chart_spread(float(value), 1.0, settings.ratio) for value in average]
        sums = np.maximum(0.0, sums + np.array([*each, sum(each)]))
        # The same sums in another order: rounding.
        np.testing.assert_allclose(states["sums"][last], sums, rtol=1e-9, atol=1e-9)


def test_a_neck_that_stands_still_is_not_judged(detector: ChangeDetector) -> None:
    run = moved("rotation", 0.0, 7)
    U = np.full(len(run), 1.2)
    still = run.with_channels(
        **{"motor_setpoint_1": U, "motor_setpoint_2": -U / 2, "motor_setpoint_3": -U / 2},
        pitch=np.full(len(run), 0.7), roll=np.full(len(run), -0.7),
    )  # fmt: skip
    assert not detector.watch(still)[:, 0].any()


def test_it_says_when_the_known_neck_is_back(detector: ChangeDetector) -> None:
    run = concatenate([moved("rotation", 0.0, 7)])
    pitch = run.channels["pitch"].copy()
    pitch[300:700] += np.radians(15.0)
    told = detector.watch(run.with_channels(pitch=pitch))
    assert told[690, 0] > 0.5
    # Each period of the known neck takes at most ln(ratio) from the sum of both outputs: some 20 s here.
    back = np.flatnonzero(told[700:, 0] < 0.5)
    assert back.size == 0 or told[700 + back[0], 1] == 0.0


def test_missing_samples_are_not_scored(detector: ChangeDetector) -> None:
    run = moved("rotation", 0.0, 7)
    pitch = run.channels["pitch"].copy()
    pitch[200:500] = np.nan
    holes = run.with_channels(pitch=pitch)
    # Whatever stood in the holes: the free run goes on, so that sums after them are those without the periods in them.
    states, whole = detector.states(holes), detector.states(run)
    np.testing.assert_array_equal(states["angles"], whole["angles"])
    assert np.isfinite(states["sums"]).all()
    np.testing.assert_array_equal(states["sums"][499], states["sums"][199])


def test_fit_is_that_of_the_free_run_of_late(detector: ChangeDetector) -> None:
    run = moved("rotation", 0.0, 7, 30.0)
    states, told = detector.states(run), detector.watch(run)
    # By definition, with the weights of a memory of 10 s.
    weights = np.exp(-0.02 / 10.0) ** np.arange(len(run))[::-1]
    y, e = run.outputs, run.outputs - states["angles"]
    mean = weights @ y / weights.sum()
    fit = 100.0 * (1.0 - np.sqrt(np.sum(weights @ e**2) / np.sum(weights @ (y - mean) ** 2)))
    np.testing.assert_allclose(told[-1, 2], fit, rtol=1e-9)


def test_pause_and_resume_is_one_run(detector: ChangeDetector) -> None:
    run = biased(moved("sine", 0.0, 8), 500, 15.0)
    block, rows = detector.block(), detector.rows(run)
    state, first = block.run(detector.initial_state(), rows[:700])
    _, second = block.run(state, rows[700:])
    np.testing.assert_array_equal(np.vstack([first, second]), detector.watch(run))


def test_a_file_keeps_every_bit(detector: ChangeDetector, tmp_path: Path) -> None:
    detector.save(tmp_path / "change.npz")
    again = load(tmp_path / "change.npz", role="observer")
    run = biased(moved("sine", 0.0, 8), 500, 15.0)
    np.testing.assert_array_equal(again.watch(run), detector.watch(run))
    assert again.summary() == detector.summary()


def test_fewer_false_alarms_ask_for_higher_thresholds(model: Model, quiet: Recording) -> None:
    often, seldom = (ChangeSettings(hours=hours).design(model, quiet).arrays["thresholds"] for hours in (1.0, 3000.0))
    assert (often <= seldom).all()
    assert (often < seldom).any()


def test_motion_that_the_model_knows_is_refused(model: Model) -> None:
    with pytest.raises(DataError, match="trained on this motion"):
        ChangeSettings().design(model, moved("eq22", 0.0, 1, 60.0))
    with pytest.raises(DataError, match="thresholds need"):
        ChangeSettings().design(model, moved("rotation", 0.0, 3, 10.0))


def test_a_hold_is_no_motion(model: Model) -> None:
    run = moved("rotation", 0.0, 3)
    with pytest.raises(DataError, match="stands still throughout"):
        ChangeSettings().design(model, run.with_channels(**{name: np.full(len(run), 0.5) for name in SET_POINTS}))


@pytest.mark.parametrize("wrong", [{"ratio": 1.0}, {"period": 0.0}, {"hours": -1.0}, {"order": "other"}, {"seed": "x"}])
def test_bad_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        ChangeSettings(**wrong)
