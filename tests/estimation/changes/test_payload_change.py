"""A change detector over a model of several payloads, on necks that are that model: what it tells, and from what."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError, load, read_archive, write_archive
from softneck.estimation.changes._change import ChangeDetector
from softneck.estimation.changes._settings import ChangeSettings
from softneck.identification import GreyBox, Model
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal
from softneck.signals.detection._cusum import shift_score

MOTIONS = ("steps", "sine", "rotation")
TS, NOISE = 0.02, np.radians(0.3)


@pytest.fixture(scope="module")
def model() -> Model:
    """Two coarse steps of the search: what it is like does not matter where the neck is the model."""
    logs = []
    for payload in (0.0, 1.0):
        run = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1, payload=payload).rows(0, 1500)
        logs.append(run.with_channels(payload=np.full(1500, payload)))
    return GreyBox(evaluations=2, sensor_delay=2).fit(logs)


def moved(model: Model, motion: str, payload: np.ndarray | float, seed: int, said: float = 0.0) -> Recording:
    """The model itself as the neck: its free run under a payload, a number or (time,), on a noisy sensor."""
    P, block = signal(motion).set_points, model.block()
    borne, state, angles = (
        np.broadcast_to(payload, len(P)),
        block.initial_state(payload=float(np.ravel(payload)[0])),
        [],
    )
    for k in range(len(P)):
        angles.append(state.outputs[:2].copy())
        inputs = np.full(len(block.inputs), np.nan)
        inputs[:3] = P[k]
        parameters = state.parameters.copy()
        parameters[-1] = borne[k]
        state, _ = block.step(replace(state, parameters=parameters), inputs)
    y = np.array(angles) + NOISE * np.random.default_rng(seed).standard_normal((len(P), 2))
    channels = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)}
    return Recording(
        np.arange(len(P)) * TS, TS, {**channels, "pitch": y[:, 0], "roll": y[:, 1], "payload": np.full(len(P), said)}
    )


@pytest.fixture(scope="module")
def detector(model: Model) -> ChangeDetector:
    return ChangeSettings().design(model, [moved(model, name, kg, 2, kg) for kg in (0.0, 1.0) for name in MOTIONS])


@pytest.mark.parametrize(("before", "after"), [(0.0, 0.5), (0.0, 1.0), (1.0, 0.0)])
def test_a_payload_put_on_or_taken_off_is_told(
    model: Model, detector: ChangeDetector, before: float, after: float
) -> None:
    borne = np.where(np.arange(1500) * TS < 12.0, before, after)
    told = detector.watch(moved(model, "rotation", borne, 7), payload_start=before)
    assert (told[:600, 3] == before).all()
    # The memory of half a second holds some of the old payload for a while: after five of it less than a hundredth. A
    # copy stands every 0.25 kg.
    np.testing.assert_allclose(told[850:, 3], after, atol=0.125)
    assert not told[:, 0].any()


@pytest.mark.parametrize("payload", [0.0, 0.3, 1.0])
def test_a_payload_known_at_the_start_stays(model: Model, detector: ChangeDetector, payload: float) -> None:
    told = detector.watch(moved(model, "sine", payload, 9), payload_start=payload)
    np.testing.assert_array_equal(told[:, 3], payload)


def test_a_bias_of_the_sensor_is_no_payload(model: Model, detector: ChangeDetector) -> None:
    run = moved(model, "rotation", 0.0, 11)
    pitch = run.channels["pitch"].copy()
    pitch[600:] += np.radians(2.0)
    told = detector.watch(run.with_channels(pitch=pitch))
    # An offset is taken away before payloads are weighed; while it comes up in their memory it is not yet one.
    assert told[-1, 3] < 0.125


def test_its_sums_are_those_of_likelihood_ratios(model: Model, detector: ChangeDetector) -> None:
    """Independent method: averages of each period anew, scored by `shift_score` and summed."""
    borne = np.where(np.arange(1500) * TS < 12.0, 0.0, 0.5)
    run = moved(model, "rotation", borne, 7)
    quiet = replace(detector, arrays={**detector.arrays, "telling": np.full(5, 1e9)})
    states, spread, chart = quiet.states(run), detector.arrays["spread"], detector.arrays["chart"]
    y = states["angles"]
    size = np.sqrt(spread[:, 0] + spread[:, 1] * states["fastest"] ** 2 + spread[:, 2] * y**2)
    e, f = (run.outputs - y) / size, (states["told"].reshape(len(y), 5, 2) - y[:, None]) / size[:, None]
    sums, period = np.zeros(5), int(chart[0])
    for last in range(period - 1, len(run), period):
        rows = slice(last + 1 - period, last + 1)
        if last >= chart[2] and (states["fastest"][rows] > chart[6]).any():
            score = shift_score(
                e[rows].mean(axis=0), f[rows].mean(axis=0), np.ones(2), sight=ChangeSettings().payload_sight
            )
            sums = np.maximum(0.0, sums + score)
        # The same sums in another order: rounding.
        np.testing.assert_allclose(states["shifts"][last], sums, rtol=1e-9, atol=1e-9)
    assert (sums[1:] > detector.arrays["telling"][1:]).any()


def test_what_undisturbed_motion_looks_like_is_not_told(model: Model) -> None:
    """Recordings that say 0 kg and bear half a kilogram: the model misses what a payload would be."""
    runs = [moved(model, name, 0.5, 2, 0.0) for name in MOTIONS]
    found = ChangeSettings().design(model, runs)
    # Nearer to the copies of 0.25, 0.5 and 0.75 kg than to the one of 0 kg; that of 1 kg is as far.
    assert set(found.findings["alike_kg"]) >= {0.25, 0.5, 0.75}
    assert "looks like 0.25, 0.5, 0.75" in found.summary()
    told = found.watch(moved(model, "rotation", 0.5, 5))
    assert (told[:, 3] == 0.0).all()


def test_missing_samples_tell_nothing(model: Model, detector: ChangeDetector) -> None:
    run = moved(model, "rotation", np.where(np.arange(1500) * TS < 12.0, 0.0, 1.0), 7)
    pitch = run.channels["pitch"].copy()
    pitch[590:1000] = np.nan
    told = detector.watch(run.with_channels(pitch=pitch))
    assert (told[:1000, 3] == 0.0).all()
    np.testing.assert_allclose(told[-1, 3], 1.0, atol=0.125)


def test_a_file_keeps_it_and_one_from_before_is_refused(model: Model, detector: ChangeDetector, tmp_path: Path) -> None:
    detector.save(tmp_path / "change.npz")
    again, run = load(tmp_path / "change.npz", role="observer"), moved(model, "rotation", 0.5, 7)
    np.testing.assert_array_equal(again.watch(run), detector.watch(run))
    header, arrays = read_archive(tmp_path / "change.npz")
    write_archive(tmp_path / "old.npz", header, {name: a for name, a in arrays.items() if name != "telling"})
    with pytest.raises(FileFormatError, match="design it again"):
        load(tmp_path / "old.npz")


@pytest.mark.parametrize("wrong", [{"payload_memory": 0.0}, {"payload_sight": float("nan")}])
def test_bad_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        ChangeSettings(**wrong)
