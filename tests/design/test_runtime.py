"""The controller's runtime: linear where nothing limits, fair where something does, without bumps."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.design import LinearController, PiSettings
from softneck.estimation import LinearNeck
from softneck.runtime import load_runtime
from softneck.signals import redefine

TS = 0.02
POLE = math.exp(-5.293 * TS)


def neck() -> LinearNeck:
    """The paper's pitch (Eq. 31: exp(-0.08 s) 27.69/(s + 5.293) deg/rad), and a slower roll."""
    b = math.radians(27.69) / 5.293 * (1.0 - POLE)
    slow = math.exp(-3.0 * TS)
    return LinearNeck(
        pitch=control.TransferFunction([b], [1.0, -POLE, 0.0, 0.0, 0.0, 0.0], TS),
        roll=control.TransferFunction([0.8 * b], [1.0, -slow, 0.0, 0.0, 0.0], TS),
    )


# Motors are told not to lag here, but for the tests of that limit.
CONTROLLER: LinearController = PiSettings(lead_limit=12.0).design(neck())
ANGLES = st.floats(-0.6, 0.6)
MOTORS = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def inputs(
    reference: tuple[float, float, float] = (0.0, 0.0, 0.0),
    angles: tuple[float, float] = (0.0, 0.0),
    motors: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    healthy: float = 1.0,
    enabled: float = 1.0,
) -> np.ndarray:
    return np.array([*reference, *angles, *motors, healthy, enabled])


def test_within_its_limits_it_is_the_linear_system_it_hands_out() -> None:
    rng = np.random.default_rng(3)
    U = np.zeros((200, 10))
    U[:, 8:] = 1.0
    # Small enough for all limits, and from rest, where alignment changes nothing.
    U[1:, [0, 1, 3, 4]] = 1e-3 * rng.standard_normal((199, 4))
    block = CONTROLLER.block()
    P = block.run(block.initial_state(slew_limit=1000.0), U)[1]
    v = np.asarray(control.forced_response(CONTROLLER.ss(), np.arange(200) * TS, U[:, [0, 1, 3, 4]].T).outputs)  # pyright: ignore
    # 200 samples of rounding of values below 0.1 rad.
    np.testing.assert_allclose(redefine(P)[:, :2], v.T, atol=1e-13)
    np.testing.assert_allclose(redefine(P)[:, 2], 0.0, atol=1e-15)


def test_compiled_and_plain_agree() -> None:
    block = CONTROLLER.block()
    rng = np.random.default_rng(4)
    U = np.column_stack([0.5 * rng.standard_normal((300, 8)), rng.random((300, 2)) > 0.1]).astype(float)
    compiled = block.run(block.initial_state(), U)[1]
    state, Y = block.initial_state(), np.zeros((300, 3))
    load_runtime(block.runtime, compiled=False).run_steps(block.arrays, state.parameters, state.values.copy(), U, Y)
    # Products of small matrices may be summed in another order.
    np.testing.assert_allclose(Y, compiled, atol=1e-12)


@given(motors=MOTORS, pitch=ANGLES, roll=ANGLES)
def test_it_starts_from_where_motors_and_neck_are(
    motors: tuple[float, float, float], pitch: float, roll: float
) -> None:
    held = float(np.mean(motors))
    block = CONTROLLER.block()
    state = block.initial_state()
    u = inputs((pitch, roll, held), (pitch, roll), motors)
    for _ in range(5):
        state, P = block.step(state, u)
        # The state solves a well-scaled 4 x 4 system: 1e-9 is far above its rounding.
        np.testing.assert_allclose(P, motors, atol=1e-9)


@given(motors=MOTORS, pitch=ANGLES, roll=ANGLES, healthy=st.booleans())
def test_while_stopped_it_holds_and_goes_on_without_a_bump(
    motors: tuple[float, float, float], pitch: float, roll: float, healthy: bool
) -> None:
    block = CONTROLLER.block()
    state = block.initial_state()
    state, before = block.step(state, inputs((0.1, -0.1, 0.0), (0.0, 0.0), motors))
    flags = {"healthy": 1.0, "enabled": 0.0} if healthy else {"healthy": 0.0, "enabled": 1.0}
    for k in range(20):
        state, P = block.step(state, inputs((0.3, 0.2, 1.0), (pitch + 0.01 * k, roll), (9.0, 9.0, 9.0)[:3], **flags))
        np.testing.assert_array_equal(P, before)
    mean = float(np.mean(before))
    state, P = block.step(state, inputs((pitch + 0.19, roll, mean), (pitch + 0.19, roll), motors))
    # The reference is where the neck is, unless beyond what references may be; nothing moves.
    if abs(pitch + 0.19) <= 0.8:
        np.testing.assert_allclose(P, before, atol=1e-9)


@given(pitch=ANGLES, roll=ANGLES, common=st.floats(-6.0, 6.0), limit=st.floats(0.5, 6.0))
def test_positions_stay_within_the_limit_and_tilt_keeps_its_direction(
    pitch: float, roll: float, common: float, limit: float
) -> None:
    block = CONTROLLER.block()
    state = block.initial_state(position_limit=limit, slew_limit=1000.0)
    linear = CONTROLLER.ss()
    state, P = block.step(state, inputs((pitch, roll, common)))
    assert np.abs(P).max() <= limit * (1 + 1e-12)
    wanted = np.asarray(linear.D)[:, :2] @ np.array([pitch, roll])
    got = redefine(P[None])[0, :2]
    # Parallel and not reversed; 1e-12 of values up to 6.
    assert abs(wanted[0] * got[1] - wanted[1] * got[0]) < 1e-11
    assert wanted @ got >= -1e-12


@given(references=st.lists(st.tuples(ANGLES, ANGLES, st.floats(-3.0, 3.0)), min_size=3, max_size=12))
def test_no_motor_moves_faster_than_the_slew_limit(references: list[tuple[float, float, float]]) -> None:
    block = CONTROLLER.block()
    state, last = block.initial_state(slew_limit=5.0), np.zeros(3)
    for reference in references:
        state, P = block.step(state, inputs(reference))
        assert np.abs(P - last).max() <= 5.0 * TS * (1 + 1e-12)
        last = P


def test_conditioning_leaves_the_limit_at_once() -> None:
    block = CONTROLLER.block()
    there, back = np.tile(inputs((0.6, 0.0, 0.0)), (500, 1)), np.tile(inputs((-0.6, 0.0, 0.0)), (50, 1))
    state, P = block.run(block.initial_state(position_limit=1.0), there)
    assert np.abs(P[-1]).max() == pytest.approx(1.0)
    # A neck that stood still below the reference for 10 s has wound nothing up: when the reference turns, so do
    # the motors, as soon as the filtered reference does (0.2 s), not after seconds.
    _, Q = block.run(state, back)
    assert np.flatnonzero(Q[:, 0] < P[-1, 0] - 1e-9)[0] <= 10


@given(references=st.lists(st.tuples(ANGLES, ANGLES, st.floats(-3.0, 3.0)), min_size=3, max_size=12), motors=MOTORS)
def test_no_setpoint_runs_away_from_its_motor(
    references: list[tuple[float, float, float]], motors: tuple[float, float, float]
) -> None:
    block = CONTROLLER.block()
    state = block.initial_state(lead_limit=0.3)
    for reference in references:
        state, P = block.step(state, inputs(reference, motors=motors))
        # Motors that stand still, as at their current limit; 1e-12 for values up to 6.
        assert np.abs(P - motors).max() <= 0.3 + 1e-12


def test_a_motor_that_cannot_follow_winds_nothing_up() -> None:
    block = CONTROLLER.block()
    stuck = np.tile(inputs((0.6, 0.0, 0.0)), (500, 1))
    state, P = block.run(block.initial_state(lead_limit=0.3), stuck)
    assert np.abs(P[-1]).max() == pytest.approx(0.3)
    _, Q = block.run(state, np.tile(inputs((-0.6, 0.0, 0.0)), (50, 1)))
    # As soon as the filtered reference turns, see above.
    assert np.flatnonzero(Q[:, 0] < P[-1, 0] - 1e-9)[0] <= 10


def test_pause_and_resume_equals_one_run() -> None:
    block = CONTROLLER.block()
    U = np.column_stack([0.3 * np.random.default_rng(6).standard_normal((60, 8)), np.ones((60, 2))])
    whole = block.run(block.initial_state(), U)[1]
    state, first = block.run(block.initial_state(), U[:25])
    np.testing.assert_array_equal(np.vstack([first, block.run(state, U[25:])[1]]), whole)
