"""Limits hold for every signal and seed; what obeys is left alone, and preparing twice changes nothing more."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import SettingsError
from softneck.signals import Excitation, SetPointLimits, prepare, signal, signal_names

TS = 0.02
# Rounding of sums of steps up to 6 rad: 1e-12 is 1,000 ulp.
ROUNDING = 1e-12

names = st.sampled_from(signal_names())
seeds = st.integers(0, 5)
limits = st.builds(
    SetPointLimits,
    position=st.floats(0.5, 6.0),
    speed=st.one_of(st.just(math.inf), st.floats(0.2, 30.0)),
    slack=st.one_of(st.just(math.inf), st.floats(0.0, 6.0)),
)
ramps = st.sampled_from([0.0, 0.02, 0.5, 1.23, 3.0])


@cache
def played(name: str, seed: int) -> Excitation:
    return signal(name, duration=8.0, seed=seed)


@given(name=names, seed=seeds, limit=limits, ramp=ramps)
def test_limits_hold_for_every_signal_and_seed(name: str, seed: int, limit: SetPointLimits, ramp: float) -> None:
    P = prepare(played(name, seed), limit, ramp_s=ramp)[0].set_points
    assert P.max() <= limit.position
    assert P.min() >= -min(limit.position, limit.slack)
    assert np.abs(np.diff(P, axis=0)).max() <= limit.speed * TS + ROUNDING
    if ramp > 0:
        assert not P[[0, -1]].any()


@given(name=names, seed=seeds, limit=limits, ramp=ramps)
def test_preparing_twice_is_preparing_once(name: str, seed: int, limit: SetPointLimits, ramp: float) -> None:
    once = prepare(played(name, seed), limit, ramp_s=ramp)[0]
    twice, changes = prepare(once, limit, ramp_s=ramp)
    assert twice.set_points.tobytes() == once.set_points.tobytes()
    assert str(changes) == "unchanged"


@given(name=names, seed=seeds)
def test_without_limits_and_ramp_nothing_changes(name: str, seed: int) -> None:
    before = played(name, seed)
    for limit in (None, SetPointLimits()):
        after, changes = prepare(before, limit)
        assert after.set_points.tobytes() == before.set_points.tobytes()
        assert (after.name, after.sample_time, after.time is before.time) == (before.name, TS, True)
        assert str(changes) == "unchanged"


@given(name=names, seed=seeds, ramp=st.sampled_from([0.5, 1.0, 2.0]))
def test_after_the_ramp_a_signal_that_obeys_is_untouched_bit_for_bit(name: str, seed: int, ramp: float) -> None:
    before = played(name, seed).set_points
    after = prepare(played(name, seed), SetPointLimits(), ramp_s=ramp)[0].set_points
    rows = round(ramp / TS)
    assert after[rows:-rows].tobytes() == before[rows:-rows].tobytes()
    # A signal that starts at rest has no ramp to wait for.
    if not before[0].any():
        assert after[:-rows].tobytes() == before[:-rows].tobytes()


def test_the_ramp_is_a_raised_cosine() -> None:
    before, after = played("eq22", 0).set_points, prepare(played("eq22", 0), ramp_s=2.0)[0].set_points
    t = np.arange(400) * TS
    window = np.where(t < 2.0, (1 - np.cos(np.pi * t / 2.0)) / 2, 1.0) * np.where(
        t > 5.99, (1 - np.cos(np.pi * (7.98 - t) / 2.0)) / 2, 1.0
    )
    np.testing.assert_allclose(after, window[:, None] * before, rtol=0, atol=1e-14)


def test_a_step_becomes_a_ramp_of_the_speed_and_arrives() -> None:
    excitation, changes = prepare(signal("steps"), SetPointLimits(speed=5.0))
    P = excitation.set_points[:, 0]
    # 3 rad at 5 rad/s: 0.6 s, 30 samples of 0.1 rad from t = 1 s on.
    np.testing.assert_allclose(P[49:80], np.arange(31) * 0.1, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(P[80:450], 3.0)
    # Three motors up and down, 29 samples of each flank are late; 3,900 set-points in all.
    assert changes.speed == pytest.approx(6 * 29 / 3900)
    assert (changes.position, changes.slack, changes.ramp) == (0.0, 0.0, 0.0)


def test_each_change_is_counted_by_its_rule() -> None:
    P = np.array([[0.0, 0.0, 0.0], [4.0, -4.0, 0.0], [4.0, -2.0, 1.0], [0.0, 0.0, 0.0]])
    excitation = Excitation("own", np.arange(4) * TS, P)
    after, changes = prepare(excitation, SetPointLimits(position=3.0, slack=1.0))
    np.testing.assert_array_equal(after.set_points, np.clip(P, -1.0, 3.0))
    assert (changes.position, changes.slack) == (2 / 12, 2 / 12)
    assert str(changes) == "17 % clipped in position, 17 % clipped in slack"
    assert changes.as_dict()["rate_limited_pct"] == 0.0


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"position": 0.0}, r"`position` must be positive \[rad\]; got 0"),
        ({"speed": -1.0}, r"`speed` must be positive \[rad/s\]; got -1"),
        ({"slack": -0.1}, r"`slack` must be 0 or positive \[rad\]; got -0.1"),
        ({"position": math.nan}, r"`position` must be positive \[rad\]; got nan"),
    ],
)
def test_a_wrong_limit_is_refused(bad: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SetPointLimits(**bad)


@pytest.mark.parametrize("ramp", [-1.0, math.nan, math.inf])
def test_a_wrong_ramp_is_refused(ramp: float) -> None:
    with pytest.raises(SettingsError, match=r"`ramp_s` must be 0 or positive \[s\]"):
        prepare(played("eq22", 0), ramp_s=ramp)


def test_a_ramp_longer_than_the_signal_is_refused() -> None:
    with pytest.raises(SettingsError, match="a ramp of 5 s in and out needs a signal of 10 s; this one has 8 s"):
        prepare(played("eq22", 0), ramp_s=5.0)
