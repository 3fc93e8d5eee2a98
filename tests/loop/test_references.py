"""References at chosen times, in file keys, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.loop import RecordingReference
from softneck.loop._references import make_reference

from ..references import RampReference, RotationReference, SineReference, StepReference


def test_a_step_is_on_at_the_sample_it_names() -> None:
    step = StepReference(pitch=0.2, roll=-0.1, cocontraction=0.5, at=0.3)
    assert step(14 * 0.02) == (0.0, 0.0, 0.0)
    # 15 * 0.02 is 0.3 but for the last bit: it counts.
    assert step(15 * 0.02) == (0.2, -0.1, 0.5)


def test_a_ramp_is_linear_between_its_ends() -> None:
    ramp = RampReference(pitch=0.4, at=1.0, rise=2.0)
    assert [ramp(t)[0] for t in (0.0, 1.0, 2.0, 3.0, 9.0)] == pytest.approx([0.0, 0.0, 0.2, 0.4, 0.4])


def test_a_sine_starts_at_zero_and_has_its_period() -> None:
    sine = SineReference(pitch=0.3, frequency=0.5, at=1.0)
    assert sine(0.5)[0] == 0.0
    assert sine(1.5)[0] == pytest.approx(0.3)
    assert sine(3.0)[0] == pytest.approx(0.0, abs=1e-15)


def test_a_rotation_keeps_its_inclination_once_risen() -> None:
    rotation = RotationReference(inclination=0.25, frequency=0.2, rise=2.0)
    tilts = [math.hypot(*rotation(t)[:2]) for t in np.linspace(2.0, 12.0, 50)]
    assert tilts == pytest.approx([0.25] * 50)


def test_a_recorded_reference_holds_each_sample() -> None:
    time = np.arange(5) * 0.02
    recorded = RecordingReference(np.column_stack([time, np.arange(5.0), -np.arange(5.0), np.zeros(5)]))
    for k in range(5):
        assert recorded(k * 0.02) == (k, -k, 0.0)
    assert recorded(0.03)[0] == 1.0
    assert recorded(99.0)[0] == 4.0
    assert recorded(-1.0)[0] == 0.0


def test_file_keys_carry_their_unit() -> None:
    made = make_reference("step", {"pitch_deg": 15.0, "at_s": 1.0})
    assert made == StepReference(pitch=math.radians(15.0), at=1.0)
    assert make_reference("sine", {"roll_rad": 0.1, "frequency_hz": 0.4}) == SineReference(roll=0.1, frequency=0.4)
    assert make_reference("rotation", {"inclination_deg": 10}) == RotationReference(inclination=math.radians(10))


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("jump", {}, "`kind` must be one of step"),
        ("step", {"yaw_deg": 1.0}, "unknown key `yaw_deg` of a step reference"),
        ("step", {"pitch": 0.2}, "`pitch` may be in rad or deg; write `pitch_rad`"),
        ("step", {"pitch_deg": "15"}, "`pitch_deg` must be a number"),
        ("step", {"pitch_rad": 15.0}, r"within -0\.8 to 0\.8 rad, .*; got 15: degrees\?"),
        ("sine", {"frequency_hz": -1.0}, "`frequency` must be positive"),
        ("ramp", {"rise_s": 0.0}, "`rise` must be positive"),
    ],
    ids=["kind", "key", "bare", "text", "degrees", "frequency", "rise"],
)
def test_wrong_references_are_refused(kind: str, values: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        make_reference(kind, values)


@pytest.mark.parametrize(
    ("time", "pitch", "message"),
    [
        ([], [], "must be finite with rising time"),
        ([0.1, 0.0], [0.0, 0.0], "rising time"),
        ([0.0, 0.1], [0.0, math.nan], "must be finite"),
    ],
    ids=["empty", "backwards", "nan"],
)
def test_wrong_recorded_references_are_refused(time: list[float], pitch: list[float], message: str) -> None:
    with pytest.raises(DataError, match=message):
        RecordingReference(np.column_stack([time, pitch, np.zeros((len(time), 2))]))
    with pytest.raises(DataError, match="is a table"):
        RecordingReference(np.array(time))
