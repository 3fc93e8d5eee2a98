"""A fault that is planted in a channel is found where it was planted, and only there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.signals import Recording, assess_quality
from softneck.signals.quality._channel_faults import ChannelQuality, Segment
from softneck.signals.recording._channels import OUTPUTS

from ..data import neck_recording

CLEAN = neck_recording(2400, seed=5, noise=1e-3)
FAULTS = ("missed", "frozen", "clipped", "outliers")


def channel(recording: Recording, name: str) -> ChannelQuality:
    return assess_quality(recording).channels[name]


def rows(stretches: tuple[Segment, ...]) -> set[int]:
    return {row for stretch in stretches for row in range(stretch.start, stretch.stop)}


def planted(name: str, change: Callable[[np.ndarray], None]) -> Recording:
    values = CLEAN.channels[name].copy()
    change(values)
    return CLEAN.with_channels(**{name: values})


def others_are_clean(found: ChannelQuality, fault: str) -> bool:
    return not any(getattr(found, other) for other in FAULTS if other != fault)


def test_a_clean_recording_has_no_fault() -> None:
    for found in assess_quality(CLEAN).channels.values():
        assert others_are_clean(found, "none"), found.name


@pytest.mark.slow
@given(axis=st.sampled_from(OUTPUTS), start=st.integers(0, 2390), length=st.integers(1, 10))
def test_missed_samples_are_found_where_they_are(axis: str, start: int, length: int) -> None:
    def drop(y: np.ndarray) -> None:
        y[start : start + length] = np.nan

    found = channel(planted(axis, drop), axis)
    assert [(s.start, s.stop) for s in found.missed] == [(start, start + length)]
    assert found.missed_rows == length
    assert found.missed[0].time == CLEAN.time[start]
    assert others_are_clean(found, "missed")


@pytest.mark.slow
@given(axis=st.sampled_from(OUTPUTS), start=st.integers(5, 2200), length=st.integers(20, 150))
def test_a_frozen_inclinometer_is_found_where_it_is(axis: str, start: int, length: int) -> None:
    def freeze(y: np.ndarray) -> None:
        y[start : start + length] = y[start]

    found = channel(planted(axis, freeze), axis)
    # Frozen at its very extreme it is a flat top as well, and counts as one of the two.
    assert rows(found.frozen + found.clipped) == set(range(start, start + length))
    assert not found.outliers


def test_nineteen_equal_samples_are_not_frozen() -> None:
    def freeze(y: np.ndarray) -> None:
        y[700:719] = y[700]

    assert channel(planted("pitch", freeze), "pitch").frozen == ()


@pytest.mark.parametrize("motor", [1, 2, 3])
def test_an_encoder_frozen_while_its_set_point_moves_is_found(motor: int) -> None:
    name = f"motor_position_{motor}"
    moves = np.flatnonzero(np.abs(np.diff(CLEAN.set_points[:, motor - 1])) > 2.0)
    start = int(moves[moves > 500][0]) - 20

    def freeze(y: np.ndarray) -> None:
        y[start : start + 60] = y[start]

    found = channel(planted(name, freeze), name)
    assert set(range(start, start + 60)) <= rows(found.frozen)


def test_a_drive_at_rest_while_its_set_point_rests_is_not_frozen() -> None:
    """The set-points of the tests' neck rest for the first 10 rows, and each level is held for up to 120."""
    for j in (1, 2, 3):
        held = CLEAN.channels[f"motor_setpoint_{j}"]
        found = channel(CLEAN.with_channels(**{f"motor_position_{j}": held}), f"motor_position_{j}")
        assert found.frozen == ()


@pytest.mark.slow
@given(axis=st.sampled_from(OUTPUTS), part=st.floats(0.4, 0.85), sign=st.sampled_from([1.0, -1.0]))
def test_flat_tops_are_found_where_they_are(axis: str, part: float, sign: float) -> None:
    y = sign * CLEAN.channels[axis]
    level = part * y.max()
    clipped = CLEAN.with_channels(**{axis: sign * np.minimum(y, level)})
    found = channel(clipped, axis)
    flat = y >= level
    # A top of one or two samples is no more than a peak.
    inside = np.convolve(flat, np.ones(3), mode="same") == 3
    assert set(np.flatnonzero(inside)) <= rows(found.clipped) <= set(np.flatnonzero(flat))
    assert not found.outliers


def test_a_smooth_quantised_peak_is_no_flat_top() -> None:
    t = np.arange(2400) * 0.02
    y = np.round(0.3 * np.sin(0.8 * t) / 1e-3) * 1e-3
    found = channel(CLEAN.with_channels(pitch=y), "pitch")
    assert found.clipped == ()
    assert found.quantum == pytest.approx(1e-3, rel=1e-9)


@pytest.mark.slow
@given(
    axis=st.sampled_from(OUTPUTS), row=st.integers(3, 2395), length=st.integers(1, 2),
    size=st.floats(0.15, 1.0), sign=st.sampled_from([1.0, -1.0]),
)  # fmt: skip
def test_spikes_are_found_where_they_are(axis: str, row: int, length: int, size: float, sign: float) -> None:
    # 0.15 rad is half of the range of this neck, 150 times its noise and 8 times its fastest step.
    def spike(y: np.ndarray) -> None:
        y[row : row + length] += sign * size

    found = channel(planted(axis, spike), axis)
    assert rows(found.outliers) == set(range(row, row + length))
    assert others_are_clean(found, "outliers")


@pytest.mark.slow
@given(row=st.integers(10, 2390), size=st.floats(-0.6, 0.6))
def test_a_real_step_is_no_spike(row: int, size: float) -> None:
    def step(y: np.ndarray) -> None:
        y[row:] += size

    assert channel(planted("pitch", step), "pitch").outliers == ()


@pytest.mark.slow
@given(quantum=st.floats(1e-4, 2e-2), offset=st.floats(-1.0, 1.0))
def test_the_step_between_levels_is_found(quantum: float, offset: float) -> None:
    y = np.round(CLEAN.channels["roll"] / quantum) * quantum + offset * quantum
    found = channel(CLEAN.with_channels(roll=y), "roll")
    assert found.quantum == pytest.approx(quantum, rel=1e-6)
    assert found.levels == pytest.approx((y.max() - y.min()) / quantum, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_channel_without_steps_has_none(seed: int) -> None:
    y = 0.1 * np.random.default_rng(seed).standard_normal(len(CLEAN))
    assert channel(CLEAN.with_channels(pitch=y), "pitch").quantum is None


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_the_noise_is_estimated_through_the_motion(noise: float) -> None:
    # The MAD of 2,396 correlated differences scatters by 4 %; levels that change add a little.
    found = assess_quality(neck_recording(2400, seed=6, noise=noise)).channels
    for axis in OUTPUTS:
        assert found[axis].noise == pytest.approx(noise, rel=0.15)


def test_a_channel_without_samples_says_so() -> None:
    found = assess_quality(CLEAN.with_channels(pitch=np.full(len(CLEAN), np.nan)))
    assert found.channels["pitch"].missed_rows == len(CLEAN)
    said = [finding for finding in found.findings if finding.channel == "pitch"]
    assert [(finding.severity, finding.topic) for finding in said] == [("warning", "dropouts")]
    assert "no sample at all" in said[0].message


def test_faults_never_reach_across_runs() -> None:
    run = np.repeat([0, 1], [1200, 1200])
    frozen, missed = CLEAN.channels["pitch"].copy(), CLEAN.channels["roll"].copy()
    frozen[1189:1208] = frozen[1189]
    missed[1198:1203] = np.nan
    recording = Recording(CLEAN.time, 0.02, {**CLEAN.channels, "pitch": frozen, "roll": missed}, run)
    found = assess_quality(recording).channels
    # 11 and 8 equal samples in two runs are not the 19 of one, and 20 would be frozen.
    frozen[1187:1208] = frozen[1187]
    assert found["pitch"].frozen == ()
    assert [(s.start, s.stop, s.run) for s in found["roll"].missed] == [(1198, 1200, 0), (1200, 1203, 1)]
    longer = Recording(CLEAN.time, 0.02, {**CLEAN.channels, "pitch": frozen}, run)
    assert assess_quality(longer).channels["pitch"].frozen == ()
    assert assess_quality(Recording(CLEAN.time, 0.02, longer.channels)).channels["pitch"].frozen != ()
