"""The paper's signals as the public face pins them, and hashes that freeze every one."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.signals import signal, signal_names

# SHA-256 of the signal rounded to 1e-6 rad, as 32-bit integers. Rounding and integers make it the same on every
# machine: libm's sin differs by an ulp, 1e-16, and a value that close to a rounding border has odds of 1e-10 each.
FROZEN = {
    "eq22": "2dad0fb91c468159",
    "steps": "35cf876511e482a9",
    "sine": "b124aa3f6c619582",
    "rotation": "f264122c617a2bde",
    "aprbs": "07115011ae096dd8",
    "multisine": "7a26a77ace35ff34",
    "mixed": "a6ebaafd126b4b6a",
}
T30 = np.arange(1500) * 0.02


def digest(set_points: np.ndarray) -> str:
    return hashlib.sha256(np.round(set_points * 1e6).astype("<i4").tobytes()).hexdigest()[:16]


@pytest.mark.slow
def test_every_signal_is_frozen() -> None:
    assert {name: digest(signal(name).set_points) for name in signal_names()} == FROZEN


@pytest.mark.parametrize(("name", "rows"), [("eq22", 10_000), ("steps", 1300), ("sine", 1500), ("rotation", 1500)])
def test_lengths_and_times(name: str, rows: int) -> None:
    excitation = signal(name)
    assert excitation.set_points.shape == (rows, 3)
    np.testing.assert_allclose(excitation.time, np.arange(rows) / 50, rtol=0, atol=1e-11)


def test_eq22_starts_where_the_public_face_says() -> None:
    # "about 1.7, 1.9, -1.3"; three digits by hand from Eq. 22 and Table 2.
    np.testing.assert_allclose(signal("eq22").set_points[0], [1.716, 1.929, -1.270], atol=5e-4)


def test_eq22_is_the_paper_written_out_motor_by_motor() -> None:
    t = np.arange(10_000) * 0.02
    sin, cos = np.sin, np.cos
    for motor, (p1, p2, p4) in enumerate([(0, 0, 0.095), (2.09, 2.09, 0.095), (4.18, 4.18, 0.95)]):
        bracket = 3 + sin(0.25 * t) + sin(1.5 * t + 0.32) + sin(1.0 * t - p4) + sin(2.56 * t) + sin(1.75 * t + 0.09)
        bracket += sin(1.66 * t + 0.29) * sin(4.0 * t + 0.67) / 2
        expected = 0.6 * sin(2 * sin(1.0 * t + p1) + cos(1.0 * t + p2)) * abs(bracket)
        # Two orders of summation of eight terms below 10: a few ulp.
        np.testing.assert_allclose(signal("eq22").set_points[:, motor], expected, rtol=0, atol=1e-13)


def test_steps_hold_each_motor_for_400_samples() -> None:
    P = signal("steps").set_points
    for j in range(3):
        on = np.zeros(1300)
        on[50 + 400 * j : 450 + 400 * j] = 3.0
        np.testing.assert_array_equal(P[:, j], on)


def test_the_sine_moves_one_axis_after_the_other() -> None:
    P = signal("sine").set_points
    # f rises linearly from 0.05 to 0.6 Hz: its integral is a trapezium's area.
    s = 2.6 * np.sin(2 * np.pi * (0.05 + (0.05 + 0.55 * T30 / 30)) / 2 * T30)
    np.testing.assert_allclose(P[:750], np.column_stack([s, -s / 2, -s / 2])[:750], rtol=0, atol=1e-12)
    np.testing.assert_allclose(P[750:], np.column_stack([0 * s, s, -s])[750:], rtol=0, atol=1e-12)


def test_the_rotation_turns_at_constant_size_after_three_seconds() -> None:
    P = signal("rotation").set_points
    for j in (1, 2, 3):
        expected = 2.8 * np.minimum(1, T30 / 3) * np.cos(1.2 * T30 - 2 * np.pi * (j - 1) / 3)
        np.testing.assert_allclose(P[:, j - 1], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(P.sum(axis=1), 0, atol=1e-14)


@pytest.mark.parametrize("name", ["aprbs", "multisine", "mixed", "eq22"])
@pytest.mark.parametrize("duration", [0.02, 1.0, 33.34])
def test_excitations_have_any_length_and_stay_in_range(name: str, duration: float) -> None:
    P = signal(name, duration=duration, seed=3).set_points
    assert P.shape == (round(duration / 0.02), 3)
    assert np.abs(P).max() <= 6.0


@pytest.mark.parametrize("name", ["aprbs", "multisine", "mixed"])
def test_a_seed_decides_a_random_signal(name: str) -> None:
    first, again, other = (signal(name, duration=10.0, seed=s).set_points for s in (1, 1, 2))
    assert first.tobytes() == again.tobytes()
    assert np.abs(first - other).max() > 0.1


@pytest.mark.slow
def test_the_multisine_has_no_power_beyond_4_rad_per_s_and_a_low_crest_factor() -> None:
    P = signal("multisine").set_points
    power = np.abs(np.fft.rfft(P, axis=0)) ** 2
    omega = 2 * np.pi * np.fft.rfftfreq(len(P), 0.02)
    # Whole periods fit the record: nothing leaks; 1e-20 is rounding.
    assert power[omega > 4.001].sum() < 1e-20 * power.sum()
    assert (np.abs(P).max(axis=0) / P.std(axis=0)).max() < 3.0  # 32 tones in phase would reach 8


@pytest.mark.slow
def test_the_multisine_excites_all_of_the_band_alike() -> None:
    P = signal("multisine").set_points
    power = np.abs(np.fft.rfft(P, axis=0)) ** 2
    omega = 2 * np.pi * np.fft.rfftfreq(len(P), 0.02)
    for j in range(3):
        lines = power[:, j] > 1e-6 * power[:, j].max()
        # Whole periods: 32 lines of one height each, rounding apart, and no hole wider than two and a half spacings.
        assert np.count_nonzero(lines) == 32
        np.testing.assert_allclose(power[lines, j], power[lines, j].mean(), rtol=1e-9)
        assert np.diff(omega[lines], prepend=0.0, append=4.0).max() < 2.5 * 4.0 / 32


def test_mixed_has_its_five_parts() -> None:
    P = signal("mixed", seed=4).set_points
    edges = np.round(np.array([0.34, 0.66, 0.88, 0.95, 1.0]) * 7000).astype(int)
    eq22, aprbs, multisine, single, together = np.split(P, edges[:-1])
    np.testing.assert_array_equal(eq22, signal("eq22").set_points[: len(eq22)])
    assert np.mean(np.diff(aprbs, axis=0) == 0) > 0.9  # levels that are held
    assert np.mean(np.diff(multisine, axis=0) == 0) < 0.01
    assert (np.count_nonzero(single, axis=1) <= 1).all()  # one tendon alone
    assert all(np.ptp(single[:, j]) > 1.0 for j in range(3))
    np.testing.assert_array_equal(together, together[:, [0]] * np.ones(3))  # all three alike
    assert np.ptp(together[:, 0]) > 0.5


def test_a_fixed_test_may_be_cut_but_not_made_longer() -> None:
    assert len(signal("steps", duration=2.0).time) == 100
    with pytest.raises(SettingsError, match="26 s long by definition; got a duration of 99 s"):
        signal("steps", duration=99.0)


@pytest.mark.parametrize("duration", [0.0, -1.0, 0.009, 1e9, np.nan, np.inf])
def test_a_wrong_duration_is_refused(duration: float) -> None:
    with pytest.raises(SettingsError, match=r"`duration` must be (between 0\.02 and 86400|a finite number) \[s\]"):
        signal("eq22", duration=duration)


def test_an_unknown_signal_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"`signal` must be one of eq22, steps, .*; got 'prbs'"):
        signal("prbs")
