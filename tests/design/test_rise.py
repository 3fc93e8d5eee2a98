"""`rise_s` means the same for every kind: how long a step on the nominal plant takes from 10 to 90 %."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import KINDS, SettingsError, Vector, resolve
from softneck.design.linear._axis_loop import LAG, check_rise, error_feedback, filter_for, filter_for_lag, least_rise
from softneck.design.plants._uncertain import StepAndLoad, uncertain_plant
from softneck.estimation import LinearNeck, axis_plant
from softneck.robot import Robot

from ..oracles.bake_off import exact, neck_within
from .test_robots import plant as lag

TS = 0.02
# The kinds whose controller has a linear form.
LINEAR = ("pi", "pid", "fopi", "hinf", "lqg")
# Static gain [deg/rad], pole [1/s], dead time [samples]: the paper's, and what foreign necks are like.
PLANTS = {"paper": (5.23, 5.293, 4), "slow": (4.0, 3.3, 5), "late": (5.0, 7.0, 7)}


def neck(gain_deg: float, pole: float, delay: int) -> LinearNeck:
    a = math.exp(-pole * TS)
    tf = control.TransferFunction([math.radians(gain_deg) * (1 - a)], [1.0, -a, *[0.0] * delay], TS)
    return LinearNeck(pitch=tf, roll=tf)


def simulated(plant: LinearNeck, controller: Any) -> Vector:
    """Return a step of pitch (rows,): the controller's linear form, then the plant's difference equation."""
    K: Any = controller.ss()
    A, B, C, D = (np.asarray(part) for part in (K.A, K.B, K.C, K.D))
    tf: Any = plant.tf("pitch")
    b, a = float(tf.num[0][0][-1]), -float(tf.den[0][0][1])
    delay = tf.den[0][0].size - 2
    x, y, line, rows = np.zeros(len(A)), 0.0, [0.0] * delay, []
    for _ in range(300):
        rows.append(y)
        inputs = np.array([1.0, 0.0, y, 0.0])
        line.append(float((C @ x + D @ inputs)[0]))
        x = A @ x + B @ inputs
        y = a * y + b * line.pop(0)
    return np.array(rows)


def rise(y: Vector) -> float:
    """Return the time from 10 to 90 %, between samples."""
    return float(np.interp(0.9, y[: y.argmax() + 1], np.arange(y.argmax() + 1) * TS)) - float(
        np.interp(0.1, y[: y.argmax() + 1], np.arange(y.argmax() + 1) * TS)
    )


# The filter itself is tried on loops of any kind in test_bounds.
@pytest.mark.parametrize("plant", ["paper", pytest.param("late", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", LINEAR)
def test_every_linear_kind_rises_on_the_nominal_plant_in_what_was_asked(kind: str, plant: str) -> None:
    model = neck(*PLANTS[plant])
    for asked in (0.35, 0.6):
        controller = resolve(KINDS[kind].settings)(rise_s=asked).design(exact(model))
        # The promise is 10 %; the filter is solved for on this very loop, so that hardly rounding is left.
        assert rise(simulated(model, controller)) == pytest.approx(asked, rel=0.02)


def test_a_faster_loop_than_asked_is_lagged_and_a_slower_one_is_led() -> None:
    model = neck(*PLANTS["paper"])
    slow, fast = (
        resolve(KINDS["hinf"].settings)(rise_s=asked, max_sensitivity=1.4).design(model) for asked in (1.2, 0.25)
    )
    assert "reference_lead_s" not in slow.design["pitch"]["gains"]
    assert fast.design["pitch"]["gains"]["reference_lead_s"] > fast.design["pitch"]["gains"]["reference_time_s"]
    # The controller itself does it, and not the search for its filter alone; within rounding, as above.
    assert rise(simulated(model, fast)) == pytest.approx(0.25, rel=0.02)


@pytest.mark.parametrize("kind", LINEAR)
def test_margins_do_not_change_with_the_rise(kind: str) -> None:
    model = neck(*PLANTS["paper"])
    # 0.35 and 0.6 s are other filters before the same feedback.
    one, other = (resolve(KINDS[kind].settings)(rise_s=asked).design(model) for asked in (0.35, 0.6))
    assert one.design["pitch"]["margins"] == other.design["pitch"]["margins"]


@pytest.mark.parametrize("ratio", [0.5, 0.9, 1.0, 1.1, 2.0, 5.0])
def test_the_formula_for_a_lag_is_right_to_nine_percent(ratio: float) -> None:
    lag = 0.2
    led = filter_for_lag(ratio * LAG * lag, lag)
    t = np.arange(0.0, 6.0, 1e-3)
    system = control.TransferFunction([led.lead, 1.0], [led.time, 1.0]) * control.TransferFunction([1.0], [lag, 1.0])
    y = np.asarray(control.step_response(control.minreal(system, verbose=False), t).outputs)
    found = float(np.interp(0.9, y, t) - np.interp(0.1, y, t))
    # Two equal lags rise in 3.36 times one, the formula says sqrt(2) ln 9 = 3.11.
    assert found == pytest.approx(ratio * LAG * lag, rel=0.09)


@pytest.mark.parametrize("kind", ["pi", "hinf"])
def test_what_the_motors_cannot_give_is_refused_in_a_line(kind: str) -> None:
    settings = resolve(KINDS[kind].settings)
    with pytest.raises(
        SettingsError, match=r"`rise_s` = 0\.02: within the motors' slew and range no step of two ninths"
    ):
        settings(rise_s=0.02).design(neck(*PLANTS["paper"]))
    with pytest.raises(SettingsError, match="rises in less than"):
        settings(rise_s=0.35).design(neck(*PLANTS["paper"]), robot=neck_within(slew=1.0))


def test_the_least_rise_is_where_it_is_refused() -> None:
    plant, test = axis_plant(neck(*PLANTS["paper"]), "pitch"), StepAndLoad()
    least = least_rise(plant, test)
    # Twice the slew, twice the range and half the step are never slower.
    assert least_rise(plant, StepAndLoad(slew_limit=0.5)) < least
    assert least_rise(plant, test, 0.5 * test.reference) < least
    check_rise(1.01 * least, plant, test)
    with pytest.raises(SettingsError, match="rises in less than"):
        check_rise(0.99 * least, plant, test)


def test_what_the_loop_cannot_give_is_refused_in_a_line() -> None:
    with pytest.raises(SettingsError, match="no reference filter leads it so far"):
        resolve(KINDS["hinf"].settings)(rise_s=0.15, max_sensitivity=1.15).design(neck(*PLANTS["late"]))


def test_a_lead_of_six_times_the_lag_is_the_most_and_refused_beyond() -> None:
    plant = axis_plant(neck(*PLANTS["paper"]), "pitch")
    # A PI that is slow enough to be led, its loop free of overshoot.
    controller = error_feedback(control.ss(control.TransferFunction([3.0, -2.9], [1.0, -1.0], TS)))
    low, high = 0.02, 30.0
    assert filter_for(high, controller, plant, 0).lead == 0.0
    for _ in range(14):
        middle = math.sqrt(low * high)
        with suppress(SettingsError):
            found = filter_for(middle, controller, plant, 0)
            assert found.lead <= 6.0 * found.time
            high = middle
            continue
        low = middle
    # Fourteen halves of a range of 1500 leave the border within 0.05 %.
    found = filter_for(high, controller, plant, 0)
    assert found.lead / found.time == pytest.approx(6.0, rel=0.02)
    with pytest.raises(SettingsError, match=r"rises in .* by itself, and no reference filter leads it so far"):
        filter_for(low, controller, plant, 0)


@pytest.mark.parametrize("kind", [*LINEAR, "adaptive"])
def test_two_settings_for_one_filter_are_refused(kind: str) -> None:
    with pytest.raises(SettingsError, match="not both"):
        resolve(KINDS[kind].settings)(rise_s=0.35, reference_time=0.1)


@pytest.mark.parametrize("kind", ["pi", "adaptive"])
def test_the_rise_of_another_robot_needs_no_filter_of_its_own(kind: str) -> None:
    robot = Robot.preset("antagonist")
    asked = resolve(KINDS[kind].settings)(rise_s=0.6).of_robot(uncertain_plant(lag(robot)))
    assert asked.rise_s == 0.6


def test_what_is_taken_from_the_papers_neck_is_said() -> None:
    settings = resolve(KINDS["pi"].settings)
    late_and_fast, quick = (settings().design(neck(*PLANTS[name])) for name in ("late", "slow"))
    assert "of the paper's neck" not in late_and_fast.summary()
    assert "of the paper's neck, not of this plant: small moves as fast as 5.293 1/s" in quick.summary()


def test_a_plant_as_it_is_has_nothing_assumed() -> None:
    settings = resolve(KINDS["pi"].settings)()
    both = settings.design(neck(4.0, 3.3, 2)).summary()
    assert "a dead time of at least 0.08 s and small moves" in both
    assert "of the paper's neck" not in settings.design(exact(neck(4.0, 3.3, 2))).summary()


@pytest.mark.parametrize("kind", ["pi", "lqg"])
def test_what_leads_the_reference_is_taken_off_the_lag_at_which_it_is_followed(kind: str) -> None:
    """The area between a step and its response is the lag of what moves slowly (Franklin et al. 2015, sec. 4.2)."""
    plant, made, T2 = neck(*PLANTS["paper"]), resolve(KINDS[kind].settings), 0.2
    plain, led = (made(reference_time=[T2, part]).design(plant) for part in (0.0, 0.8))
    gains = led.design["pitch"]["gains"]
    lags = [TS * float(np.sum(1.0 - simulated(plant, item))) for item in (plain, led)]
    # The sampled lag of T2 is late by Ts a/(1 - a), of which T1/T2 passes at once; after 6 s nothing is left of a step.
    a = math.exp(-TS / T2)
    assert lags[0] - lags[1] == pytest.approx(gains["reference_lead_s"] / T2 * TS * a / (1.0 - a), rel=1e-3)


@pytest.mark.parametrize("kind", LINEAR)
def test_a_lead_is_of_a_filter_that_is_given(kind: str) -> None:
    for given in ([0.0, 1.0], [None, 1.0]):
        with pytest.raises(SettingsError, match="needs a T2 above 0"):
            resolve(KINDS[kind].settings)(reference_time=given)
    with pytest.raises(SettingsError, match=r"T2 \[s\], \[T2, lead\] or"):
        resolve(KINDS[kind].settings)(reference_time=[0.1])
