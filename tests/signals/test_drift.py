"""A drift is told from what motors cause, in any unit, at any speed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import Matrix, Vector
from softneck.robot import Robot
from softneck.signals import Recording, assess_quality
from softneck.signals.quality._drift import find_drifts

WINCH = Robot.from_dict({
    "name": "winch", "motors": {"names": ["rope"], "unit": "mm"}, "outputs": {"names": ["load"], "unit": "N"},
    "directions": {"kind": "identified"},
})  # fmt: skip
ROWS = 4000


def levels(seed: int) -> Vector:
    return np.repeat(np.random.default_rng(seed).uniform(0.0, 3.0, ROWS // 50), 50)


def plant(u: Vector, rows: float, power: float) -> Vector:
    """Return a lag over a bent characteristic, which starts at rest far from where it works."""
    y = np.zeros_like(u)
    for k in range(1, u.size):
        y[k] = y[k - 1] + (u[k - 1] ** power - y[k - 1]) / rows
    return y


def recorded(u: Vector | Matrix, y: Vector, sample_time: float = 0.02) -> Recording:
    return Recording.from_arrays(u.reshape(len(y), -1), y[:, None], sample_time=sample_time, robot=WINCH)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("rows", "power"), [(3.0, 1.0), (30.0, 2.0), (150.0, 0.5)], ids=["fast", "bent", "slow"])
def test_a_robot_without_a_drift_has_none_and_an_added_one_is_found(seed: int, rows: float, power: float) -> None:
    u = levels(seed)
    y = plant(u, rows, power)
    noise = 0.02 * y.std() * np.random.default_rng(seed + 100).standard_normal(ROWS)
    assert find_drifts(recorded(u, y + noise)) == {}
    change = 1.5 * float(y.std())
    found = find_drifts(recorded(u, y + noise + np.linspace(0.0, change, ROWS)))
    # Two fifths: by then the square alone bends the slow and the bent one, whose own trend by chance is a fifth.
    assert found["load"].change == pytest.approx(change, rel=0.4)


@given(unit=st.floats(1e-6, 1e6), second=st.floats(1e-3, 1e3), sign=st.sampled_from([-1.0, 1.0]))
def test_units_and_speed_do_not_matter(unit: float, second: float, sign: float) -> None:
    u = levels(1)
    y = plant(u, 20.0, 1.0) + np.linspace(0.0, 2.0, ROWS)
    one = find_drifts(recorded(u, y))["load"]
    other = find_drifts(recorded(unit * u, sign * unit * y, 0.02 * second))["load"]
    # Least squares over scaled columns: rounding times their condition number, below 1e6.
    assert other.share == pytest.approx(one.share, rel=1e-8)
    assert other.change == pytest.approx(sign * unit * one.change, rel=1e-8)


def test_what_motors_cause_slowly_is_no_drift() -> None:
    rng = np.random.default_rng(3)
    u = levels(3)
    noise = 0.01 * rng.standard_normal(ROWS)
    # A pump fills a tank without an outlet; a ramp of the motor; a load that never moves.
    ramp = np.linspace(0.0, 3.0, ROWS)
    filled = np.cumsum(u) / 100.0
    for moved, y in ((u, filled), (ramp, 2.0 * ramp), (u, np.zeros(ROWS))):
        assert find_drifts(recorded(moved, y + noise)) == {}


def test_few_or_missing_rows_are_no_drift_and_no_error() -> None:
    u = levels(4)
    y = plant(u, 10.0, 1.0) + np.linspace(0.0, 3.0, ROWS)
    gaps = y.copy()
    gaps[::3] = np.nan
    assert find_drifts(recorded(u, gaps))["load"].change == pytest.approx(3.0, rel=0.1)
    for rows in (2, 10, 30):
        assert find_drifts(recorded(u[:rows], y[:rows])) == {}


def test_the_report_warns_of_it() -> None:
    u = levels(5)
    y = plant(u, 10.0, 1.0)
    clean, drifting = (assess_quality(recorded(u, z), bandwidth=5.0) for z in (y, y + np.linspace(0.0, 3.0, ROWS)))
    assert "ok: no output drifts on its own." in clean.text()
    (finding,) = [one for one in drifting.findings if one.topic == "drift"]
    assert (finding.severity, finding.channel) == ("warning", "load")
    assert "drifts by" in finding.message
    assert "N in its longest run" in finding.message
    assert drifting.as_dict()["drifts"]["load"]["share"] > 0.2
