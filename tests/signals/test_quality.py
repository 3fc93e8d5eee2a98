"""What the report says of inputs: equal to other ways of computing it, and right on the neck and on real logs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal as dsp

from softneck.core import SettingsError
from softneck.identification.models._directions import bandwidth_of
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import (
    SET_POINTS,
    Recording,
    assess_quality,
    concatenate,
    import_log,
    motors_from,
    read_layout,
    redefine,
    signal,
)

from ..data import LAYOUTS, neck_recording, recording_from

TS = 0.02


def from_inputs(inputs: np.ndarray) -> Recording:
    """The tests' neck under theta_i, phi_i, delta_i (time, 3)."""
    return recording_from(motors_from(inputs), noise=1e-3)


def topics(recording: Recording, severity: str) -> set[str]:
    return {finding.topic for finding in assess_quality(recording).findings if finding.severity == severity}


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "lab"])
@pytest.mark.parametrize("name", ["eq22", "mixed", "aprbs", "multisine"])
def test_a_clean_recording_of_the_virtual_neck_gives_no_warning(preset: str, name: str) -> None:
    neck = VirtualNeck(NeckParameters.preset(preset))
    assert topics(record(signal(name, duration=60.0, seed=2), neck, seed=3), "warning") == set()


@pytest.mark.parametrize("name", ["steps", "sine", "rotation"])
@pytest.mark.parametrize("noise", [True, False], ids=["noise", "no noise"])
def test_the_papers_tests_have_no_faulty_channels(name: str, noise: bool) -> None:
    recording = record(signal(name), VirtualNeck(NeckParameters.preset("paper")), noise=noise)
    faults = {"dropouts", "frozen", "clipping", "outliers", "quantisation"}
    assert not faults & (topics(recording, "warning") | topics(recording, "note"))


def test_parseval_the_density_integrates_to_the_variance() -> None:
    recording = recording_from(signal("multisine", duration=200.0).set_points)
    found = assess_quality(recording).spectrum
    variance = redefine(recording.set_points).var(axis=0)
    # Welch's windows weigh the samples of one record unevenly: 10 % at 9 segments.
    np.testing.assert_allclose(found.density.sum(axis=0) * found.omega[1], variance, rtol=0.1)


@pytest.mark.slow
@given(omega=st.floats(0.6, 60.0))
def test_a_sine_has_its_power_where_it_is(omega: float) -> None:
    t = np.arange(3000) * TS
    found = assess_quality(from_inputs(2.0 * np.sin(omega * t)[:, None] * [1.0, 0.5, 0.1])).spectrum
    line = found.omega[1]
    # Hann's main lobe is two lines to either side; 1 % of the mean up to 4 rad/s lies within it and one side lobe.
    if omega < 4.0 - 3 * line:
        np.testing.assert_allclose(found.highest, omega, atol=4 * line)
        assert found.below_bandwidth.min() > 0.999
    elif omega > 4.0 + 3 * line:
        assert found.below_bandwidth.max() < 0.001
    # sqrt(2) for whole periods; a record that ends within one is off by a part of 1 / periods.
    np.testing.assert_allclose(found.crest, np.sqrt(2), rtol=0.2)


def test_slow_excitation_is_a_warning_and_its_frequency_is_named() -> None:
    t = np.arange(6000) * TS
    slow = np.column_stack([3 * np.sin(0.5 * t), 3 * np.sin(0.37 * t), np.sin(0.3 * t)])
    said = [f for f in assess_quality(from_inputs(slow)).findings if f.topic == "excitation"]
    assert [(f.severity, f.channel) for f in said] == [("warning", "theta_i"), ("warning", "phi_i")]
    assert "real power up to 0." in said[0].message


def test_motors_with_one_sum_move_along_two_directions() -> None:
    t = np.arange(3000) * TS
    inputs = np.column_stack([3 * np.sin(1.3 * t) + np.sin(3.7 * t), 3 * np.cos(1.9 * t) + np.sin(4.3 * t), 0 * t])
    recording = from_inputs(inputs)
    assert assess_quality(recording).directions == 2
    assert {"directions", "co-contraction"} <= topics(recording, "note")
    inputs[:, 2] = np.sin(0.7 * t)
    assert assess_quality(from_inputs(inputs)).directions == 3
    assert "directions" not in topics(from_inputs(inputs), "note")


def test_a_motor_that_never_moves_is_named() -> None:
    P = signal("multisine", duration=40.0).set_points.copy()
    P[:, 2] = 0.5
    found = assess_quality(recording_from(P, noise=1e-3))
    assert found.directions == 2
    assert np.isnan(found.correlation[2]).all()
    said = [f for f in found.findings if f.channel == SET_POINTS[2]]
    assert [f.message for f in said if f.severity == "warning"] == ["never leaves 0.5 rad."]


def test_the_correlation_is_numpys_and_two_motors_as_one_are_a_warning() -> None:
    P = signal("aprbs", duration=60.0).set_points.copy()
    np.testing.assert_allclose(assess_quality(recording_from(P)).correlation, np.corrcoef(P.T), atol=1e-12)
    P[:, 1] = -P[:, 0]
    found = assess_quality(recording_from(P))
    assert found.correlation[0, 1] == pytest.approx(-1.0, abs=1e-12)
    assert "correlation" in topics(recording_from(P), "warning")


@pytest.mark.slow
def test_nothing_reaches_across_runs() -> None:
    """Runs in another order have the same spectrum and correlation."""
    parts = [recording_from(signal("multisine", duration=30.0, seed=s).set_points, noise=1e-3) for s in (1, 2, 3)]
    one, other = assess_quality(concatenate(parts)), assess_quality(concatenate(parts[::-1]))
    # Sums in another order: rounding.
    np.testing.assert_allclose(one.spectrum.density, other.spectrum.density, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(one.correlation, other.correlation, atol=1e-12)


@pytest.mark.slow
@given(
    rows=st.integers(1, 40), runs=st.integers(1, 4),
    scale=st.sampled_from([0.0, 1e-12, 1.0]), missing=st.floats(0.0, 1.0),
)  # fmt: skip
def test_any_recording_has_a_report(rows: int, runs: int, scale: float, missing: float) -> None:
    rng = np.random.default_rng(rows)
    y = scale * rng.uniform(-1, 1, (2, rows))
    y[rng.uniform(size=y.shape) < missing] = np.nan
    channels = dict(zip(SET_POINTS, scale * rng.standard_normal((3, rows)), strict=True))
    recording = Recording(np.arange(rows) * TS, TS, {**channels, "pitch": y[0], "roll": y[1]},
                          np.sort(rng.integers(0, runs, rows)))  # fmt: skip
    found = assess_quality(recording)
    assert found.text()
    assert found.severity in ("note", "warning")
    assert json.dumps(found.as_dict(), default=lambda value: value.tolist())


def test_a_wrong_limit_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"`bandwidth` must be positive \[rad/s\]; got -1"):
        assess_quality(neck_recording(200), bandwidth=-1.0)


def test_what_the_real_recordings_are_told(shared_data: Path) -> None:
    def report(path: str, layout: str) -> set[tuple[str, str]]:
        recording = import_log(shared_data / path, read_layout(LAYOUTS / f"{layout}.toml")).recording
        return {(f.severity, f.topic) for f in assess_quality(recording).findings if f.severity != "ok"}

    # The platform shakes at times, by up to 4 deg at 24.8 s: that is motion, and no sample of it is a spike.
    steps = report("neck_openloop/spring_test_0gr.csv", "neck_openloop")
    assert steps == {("note", "co-contraction")}
    loop = report("neck_closedloop/frontier_test_000gr.csv", "neck_closedloop")
    assert loop == {("note", topic) for topic in ("co-contraction", "directions", "correlation")}
    arm = report("arm_multisine/arm_multisine_400s.csv", "arm_multisine")
    assert {("warning", "excitation"), ("note", "co-contraction")} <= arm


def test_another_robot_is_judged_by_its_channels() -> None:
    """The neck's recording, renamed, in mm and in bar: the same faults in place, directions and correlation."""
    neck = record(signal("multisine", duration=60.0, seed=2), VirtualNeck(NeckParameters.preset("paper")), seed=3)
    pitch = neck.channels["pitch"].copy()
    pitch[100:120] = np.nan
    neck = neck.with_channels(pitch=pitch)
    robot = Robot.from_dict({
        "name": "bellows",
        "motors": {"names": ["a", "b", "c"], "unit": "bar", "setpoint_min": -6e-5, "setpoint_max": 6e-5},
        "outputs": {"names": ["x", "y"], "unit": "m", "display_unit": "mm"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    theirs, mine = ((*r.outputs.names, *r.set_points, *r.motor_positions) for r in (neck.robot, robot))
    names = dict(zip(theirs, mine, strict=True))
    channels = {mine: neck.channels[name] for name, mine in names.items()}
    other = Recording(neck.time, neck.sample_time, channels, robot=robot)
    of_neck, found = assess_quality(neck), assess_quality(other, bandwidth=4.0)
    for name, mine in names.items():
        one, two = of_neck.channels[name], found.channels[mine]
        assert (one.missed, one.frozen, one.clipped, one.outliers) == (
            two.missed,
            two.frozen,
            two.clipped,
            two.outliers,
        )
    assert found.directions == of_neck.directions
    np.testing.assert_array_equal(found.correlation, of_neck.correlation)
    assert found.as_dict()["channels"]["x"]["unit"] == "mm"
    said = found.text()
    assert "x: misses 20 of 3000 samples (0.67 %) in 1 gap(s); the longest is 0.40 s at t = 2.00 s" in said
    assert "beyond 0.1 s a control loop would have stopped" in said
    assert "a_setpoint, b_setpoint, c_setpoint move up to the bandwidth of 4 rad/s." in said
    assert found.spectrum.inputs == robot.set_points
    assert "co-contraction" not in {finding.topic for finding in found.findings}
    unknown = assess_quality(other)
    assert [f.message for f in unknown.findings if f.topic == "excitation"] == [
        "the bandwidth of the outputs is unknown: the spectrum is not judged."
    ]


def test_the_bandwidth_of_a_robot_is_that_of_its_low_pass() -> None:
    """A first-order robot with 0.2 s, the neck's time constant, has the neck's 4 rad/s; ten times slower, a tenth."""
    robot = Robot.from_dict({
        "name": "tank", "motors": {"names": ["pump"], "unit": "V"}, "outputs": {"names": ["level"], "unit": "V"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    u = np.repeat(np.random.default_rng(0).uniform(0.0, 5.0, 40), 50)
    for slower in (1.0, 10.0):
        pole = np.exp(-TS / 0.2)
        level = np.asarray(dsp.lfilter([0.0, 1.0 - pole], [1.0, -pole], u))
        time = slower * TS * np.arange(u.size)
        recording = Recording(time, slower * TS, {"motor_setpoint_1": u, "level": level}, robot=robot)
        # The search over time constants ends within 0.1 % of its logarithm.
        assert bandwidth_of(recording) == pytest.approx(4.0 / slower, rel=1e-2)
