"""Model following: feedforward to the motors, and feedback of what the output differs from a plant's response."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from softneck.core import SettingsError, to_si
from softneck.design import HinfSettings, LqgSettings, PidSettings, PiSettings
from softneck.design.linear import _feedforward
from softneck.design.linear._axis_loop import axis_margins, make_sweep
from softneck.design.linear._controller import AxisController, ReferenceFilter
from softneck.design.linear._feedforward import follow_large_moves, follow_model
from softneck.design.linear._ports import motor_ranges
from softneck.design.plants._uncertain import StepAndLoad, uncertain_plant
from softneck.estimation import AxisPlant
from softneck.robot import Robot

from ..verification.necks import TS, linear_neck, small_draws
from .test_robots import plant as plant_of

KINDS = {"pi": PiSettings, "pid": PidSettings, "hinf": HinfSettings, "lqg": LqgSettings}
# A lag of 0.2 s with four samples of dead time, and one of two poles and a zero, both with the neck's gain.
PLANTS = (
    AxisPlant(np.array([0.009]), np.array([1.0, -0.9]), 4, TS),
    AxisPlant(np.array([0.005, -0.0023]), np.array([1.0, -1.6, 0.63]), 2, TS),
)


def axis_of(kind: str) -> AxisController:
    """Return the controller of one axis, as a design makes it."""
    uncertain = uncertain_plant(linear_neck())
    settings = KINDS[kind]()
    axis = settings._prepare_axis(uncertain.axis("pitch"))
    axis = replace(axis, test=StepAndLoad(sample_time=TS))
    return settings._synthesise(axis, "pitch").controller


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("extra", [0, 2])
def test_the_followed_plant_answers_as_if_there_were_no_feedback(kind: str, plant: AxisPlant, extra: int) -> None:
    """Until the slew ends, and after: what the limits leave of the feedforward goes to the model as well."""
    led = follow_model(axis_of(kind), plant, extra, 1.0)
    for slew in (1e9, 0.3):
        test = StepAndLoad(
            sample_time=TS, reference=0.2, load=0.0, position_limit=1e9, slew_limit=slew, load_at=2.9, duration=3.0
        )
        y = make_sweep([plant], extra_delay=extra, test=test).run(led, 0.1, led.conditioning()).angles[0]
        # The reference filter of 0.1 s, then the motors as fast as they may.
        wanted = 0.2 / plant.static_gain * (1.0 - math.exp(-TS / 0.1) ** np.arange(1, test.rows + 1))
        u = np.zeros(test.rows)
        for k in range(test.rows):
            u[k] = (last := u[k - 1] if k else 0.0) + np.clip(wanted[k] - last, -slew, slew)
        delay = np.zeros(1 + plant.delay + extra)
        expected = lfilter(np.append(delay, plant.numerator), plant.denominator, u)[: test.rows]
        # Rounding over 150 samples.
        np.testing.assert_allclose(y, expected, atol=1e-9)


@given(share=st.floats(0.3, 2.0), gain=st.floats(0.7, 1.4))
def test_the_margins_are_those_without_feedforward_and_the_end_is_the_reference(share: float, gain: float) -> None:
    plant, alone = PLANTS[0], axis_of("pi")
    led, true = follow_model(alone, plant, 0, share), replace(plant, numerator=gain * plant.numerator)
    mine, its = (axis_margins(item, [true], 0).of(0) for item in (led, alone))
    # The states of the model are added to the loop's matrices: rounding of its poles and of a bisection.
    assert (mine.gain, mine.sensitivity) == pytest.approx((its.gain, its.sensitivity), rel=1e-6)
    test = StepAndLoad(
        sample_time=TS, reference=0.2, load=0.0, position_limit=1e9, slew_limit=1e9, load_at=19.9, duration=20.0
    )
    y = make_sweep([true], test=test).run(led, ReferenceFilter(0.1, 0.05), led.conditioning()).angles[0]
    # After 20 s nothing is left of a loop of 4 rad/s.
    assert y[-1] == pytest.approx(0.2, rel=1e-6)


def test_large_moves_of_the_draws_tell_what_is_followed() -> None:
    draws = small_draws()
    uncertain = replace(uncertain_plant(linear_neck()), draws=draws)
    limits = PiSettings(reference_time=[0.1, 1.0, 1.0]).of_robot(uncertain).limits(uncertain.robot)
    assert follow_large_moves(replace(uncertain, draws=None), limits).axes["pitch"].followed is None
    found = follow_large_moves(uncertain, limits)
    for k, name in enumerate(found.names):
        plant = found.axes[name].followed
        assert plant is not None
        # The draws' model is linear: any step tells its gain.
        u, y = _feedforward._steps(uncertain, draws, limits, k, 1.0)
        assert plant.static_gain == pytest.approx(y[0, -1] / u[0, -1], rel=0.02)  # 2 s are ten of its time constants
        response = lfilter(np.append(np.zeros(1 + plant.delay), plant.numerator), plant.denominator, u, axis=1)
        assert np.abs(response - y).max() < 0.05 * np.abs(y).max()  # one pole for five


def test_a_lag_with_dead_time_is_found_exactly() -> None:
    plant = PLANTS[0]
    u = np.stack([np.minimum(0.25 * np.arange(101), 2.0), -np.minimum(0.1 * np.arange(101), 1.0)])
    y = np.asarray(lfilter(np.append(np.zeros(1 + plant.delay), plant.numerator), plant.denominator, u, axis=1))
    found = _feedforward._fit_plant(u, y, replace(plant, numerator=0.5 * plant.numerator, delay=0))
    assert found.delay == plant.delay
    # The search over the lag ends at a relative 1e-5 of its logarithm.
    assert (found.static_gain, found.time_constant) == pytest.approx((0.09, plant.time_constant), rel=1e-4)
    with pytest.raises(SettingsError, match="leave the feedforward of `reference_time` out"):
        _feedforward._fit_plant(u, -y, plant)
    with pytest.raises(SettingsError, match="leave the feedforward of `reference_time` out"):
        _feedforward._fit_plant(u, 0.0 * y, plant)


@pytest.mark.parametrize("given", [[0.1], [0.1, 1.0, 1.0, 1.0], [0.1, 1.0, -0.1], [0.1, 1.0, 11.0], [0.0, 0.0, 1.0]])
def test_other_feedforward_is_refused(given: Any) -> None:
    with pytest.raises(SettingsError, match="reference_time"):
        PiSettings(reference_time=given)


def test_feedforward_is_told_and_leaves_the_margins() -> None:
    plain, led = (PiSettings(reference_time=given).design(linear_neck()) for given in ([0.1, 0.0], [0.1, 0.0, 1.0]))
    assert "feedforward 1" in led.summary()
    assert "feedforward" not in plain.summary()
    for name, value in plain.design["pitch"]["margins"].items():
        # Its poles are of larger matrices: rounding.
        assert led.design["pitch"]["margins"][name] == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("name", ["neck", "antagonist", "finger"])
def test_steps_go_up_and_down_from_the_recorded_posture_within_the_motors_limits(name: str, large: bool) -> None:
    robot = Robot.preset(name)
    model, told = plant_of(robot), []
    low, high = motor_ranges(robot, None) or (np.zeros(1), np.ones(1))
    common = float((0.3 * low + 0.7 * high).mean())
    uncertain = uncertain_plant(model)
    T, inverse = uncertain.redefinition

    def simulate(steps: Any) -> np.ndarray:
        told.append(steps)
        return steps.set_points @ T[:-1].T + 5.0

    conditions = {"motion": [1.0], "cocontraction": [common - 0.1, common + 0.1]}
    draws: Any = SimpleNamespace(conditions=conditions, model=SimpleNamespace(simulate=simulate))
    limits = PiSettings().of_robot(uncertain).limits(robot)
    size = (4.0 if large else 0.2) * float((high - low).max())
    k = len(uncertain.names) - 1
    u, y = _feedforward._steps(uncertain, draws, limits, k, size)
    # A plant that is its input: nothing but the posture is taken away.
    np.testing.assert_allclose(u, y, atol=1e-9 * np.abs(u).max())
    [steps] = told
    up, down = (steps.set_points[steps.run == number] for number in (1, 2))
    # Two seconds of a neck before and after, for others as much longer as they are slower.
    assert len(up) == len(down) == 2 * round(2.0 * uncertain.axes[uncertain.names[k]].nominal.second / TS)
    rest = (
        0.5 * (low + high) if robot.motors.rest is None else to_si(robot.motors.unit)[0] * np.array(robot.motors.rest)
    )
    if inverse[:, -1].any():  # its motors pull together as they did in the recording
        assert up[0].mean() == pytest.approx(common, rel=1e-9)
        rest = rest + inverse[:, -1] * (common - rest.mean())
    np.testing.assert_allclose(up[0], np.clip(rest, low, high), rtol=1e-9)
    np.testing.assert_array_equal(up[: len(up) // 2], np.repeat(up[:1], len(up) // 2, axis=0))
    assert ((steps.set_points >= low) & (steps.set_points <= high)).all()
    moved = np.abs(np.diff(up, axis=0)).max()
    if not large:
        np.testing.assert_allclose(u[1], -u[0], atol=1e-9 * np.abs(u).max())
        assert u[0, -1] == pytest.approx(size, rel=1e-9)
        np.testing.assert_allclose(up + down, 2.0 * up[0] + 0.0 * up, rtol=1e-9)
    assert moved <= limits.slew_limit * uncertain.sample_time * (1.0 + 1e-9)
