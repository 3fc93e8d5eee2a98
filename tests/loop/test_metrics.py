"""Metrics against python-control's own and against arithmetic."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import SettingsError
from softneck.loop import LoopResult, check_limits, metrics

TS = 0.02


def result_of(pitch: np.ndarray, reference: np.ndarray, motor: np.ndarray | None = None) -> LoopResult:
    zero = np.zeros(pitch.size)
    signals = {
        "pitch": pitch,
        "roll": zero,
        "pitch_reference": reference,
        "roll_reference": zero,
        "motor_setpoint_1": zero if motor is None else motor,
        "motor_setpoint_2": zero,
        "motor_setpoint_3": zero,
    }
    return LoopResult(np.arange(pitch.size) * TS, signals, {}, TS)


@pytest.mark.slow
@given(
    damping=st.floats(0.2, 1.5),
    frequency=st.floats(2.0, 12.0),
    size=st.floats(-0.5, 0.5).filter(lambda value: abs(value) > 0.05),
    late=st.integers(1, 60),
)
def test_step_metrics_equal_those_of_python_control(damping: float, frequency: float, size: float, late: int) -> None:
    system = control.tf([frequency**2], [1.0, 2.0 * damping * frequency, frequency**2])
    time = np.arange(600) * TS
    y = size * np.asarray(control.step_response(system, time).outputs)
    theirs: Any = control.step_info(y, time, final_output=size, SettlingTimeThreshold=0.05)
    pitch = np.concatenate([np.zeros(late), y])
    reference = np.concatenate([np.zeros(late), np.full(600, size)])
    ours = metrics(result_of(pitch, reference))["pitch"]
    # The same samples are chosen; only the difference of two time stamps is rounded.
    assert ours["rise_s"] == pytest.approx(theirs["RiseTime"], abs=1e-9)
    assert ours["settling_s"] == pytest.approx(theirs["SettlingTime"], abs=1e-9)
    assert ours["overshoot_pct"] == pytest.approx(max(0.0, theirs["Overshoot"]), abs=1e-9)


def test_an_axis_without_a_step_has_errors_only() -> None:
    pitch = np.full(400, np.radians(0.5))
    table = metrics(result_of(pitch, np.zeros(400)))
    assert table["pitch"]["rise_s"] is None
    assert table["pitch"]["settling_s"] is None
    assert table["pitch"]["overshoot_pct"] is None
    assert table["pitch"]["rms_error_deg"] == pytest.approx(0.5, rel=1e-12)
    assert table["pitch"]["iae"] == pytest.approx(np.radians(0.5) * 400 * TS, rel=1e-12)
    assert table["roll"]["rms_error_deg"] == 0.0


def test_a_moving_reference_is_no_step() -> None:
    wave = np.sin(np.arange(500) * TS)
    assert metrics(result_of(wave, wave))["pitch"]["rise_s"] is None


def test_steady_rms_looks_at_the_last_quarter_only() -> None:
    reference = np.full(400, 0.2)
    pitch = np.concatenate([np.zeros(300), np.full(100, 0.2 + np.radians(0.3))])
    table = metrics(result_of(pitch, reference))
    # The last quarter has one constant error; 1e-9 covers its rounding.
    assert table["pitch"]["steady_rms_deg"] == pytest.approx(0.3, rel=1e-9)


def test_a_response_that_never_arrives_has_no_rise_and_no_settling() -> None:
    table = metrics(result_of(np.full(100, 0.05), np.full(100, 0.2)))
    assert table["pitch"]["rise_s"] is None
    assert table["pitch"]["settling_s"] is None


def test_motor_metrics() -> None:
    motor = np.array([0.0, 0.1, -0.3, -0.3])
    table = metrics(result_of(np.zeros(4), np.zeros(4), motor))
    assert table["motors"]["max_rad"] == 0.3
    assert table["motors"]["max_rate_rad_s"] == pytest.approx(20.0, rel=1e-12)
    assert table["motors"]["effort"] == pytest.approx((0.01 + 0.09 + 0.09) * TS, rel=1e-12)


def test_total_variation_time_beyond_the_limits_and_slack() -> None:
    motor = np.array([0.0, 6.0, 6.5, 6.5, 5.0])
    result = result_of(np.zeros(5), np.zeros(5), motor)
    table = metrics(result)["motors"]
    assert table["total_variation_rad"] == pytest.approx(8.0, rel=1e-12)
    assert table["limit_violation_s"] == pytest.approx(2 * TS, rel=1e-12)
    assert table["slack_s"] is None
    signals = {**result.signals, "tension_1": np.full(5, 3.0), "tension_2": np.array([1.0, 0.0, 0.0, 2.0, 0.0])}
    slack = metrics(LoopResult(result.time, signals, {}, TS))["motors"]["slack_s"]
    assert slack == pytest.approx(3 * TS, rel=1e-12)


def test_ise_and_itae_are_integrals_of_a_known_error() -> None:
    n, late = 4000, 100
    time = np.arange(n) * TS
    reference = np.where(time >= late * TS - 1e-9, 0.2, 0.0)
    pitch = np.where(reference > 0.0, 0.2 * (1.0 - np.exp(-(time - late * TS))), 0.0)
    table = metrics(result_of(pitch, reference))["pitch"]
    # Of 0.2 exp(-t): 0.2, 0.2^2 / 2 and 0.2; sums over samples of 20 ms miss the integrals by 1 % or 2 %.
    assert table["iae"] == pytest.approx(0.2, rel=0.02)
    assert table["ise"] == pytest.approx(0.02, rel=0.03)
    assert table["itae"] == pytest.approx(0.2, rel=0.02)


def test_measured_angles_are_judged_on_request_and_gaps_are_left_out() -> None:
    result = result_of(np.zeros(400), np.zeros(400))
    measured = np.full(400, np.radians(1.0))
    measured[::3] = np.nan
    both = LoopResult(result.time, {**result.signals, "pitch_measured": measured}, {}, TS)
    assert metrics(both)["pitch"]["rms_error_deg"] == 0.0
    assert metrics(both, angle="measured")["pitch"]["rms_error_deg"] == pytest.approx(1.0, rel=1e-12)
    assert metrics(both, angle="measured")["roll"]["rms_error_deg"] == 0.0
    with pytest.raises(SettingsError, match="`angle` must be one of true, measured"):
        metrics(both, angle="felt")


def test_limits_hold_or_not_by_name() -> None:
    values = {"pitch": {"overshoot_pct": 4.0, "settling_s": None}, "motors": {"max_rad": 3.0}}
    rows = check_limits(values, {"pitch.overshoot_pct": 5.0, "pitch.settling_s": 1.0, "motors.max_rad": 2.5})
    assert [row["holds"] for row in rows] == [True, False, False]
    assert rows[0] == {"metric": "pitch.overshoot_pct", "limit": 5.0, "value": 4.0, "holds": True}


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"pitch.overshot": 5.0}, "unknown metric `pitch.overshot`; use one of pitch.overshoot_pct"),
        ({"pitch.overshoot_pct": "5"}, "must be a number; got '5'"),
    ],
    ids=["unknown", "text"],
)
def test_wrong_limits_are_refused(limits: dict[str, float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        check_limits({"pitch": {"overshoot_pct": 4.0}}, limits)
