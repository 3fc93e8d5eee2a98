"""Laws of the allocation: limits are shared, direction stays, tendons stay taut, and nothing more is given away."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.linalg import null_space
from scipy.optimize import linprog

from softneck.core import SettingsError, load, read_archive, write_archive
from softneck.design import ControllerLimits, LinearController, PiSettings
from softneck.robot._robot import redefinition_of
from softneck.runtime import load_functions
from softneck.signals import redefinition_matrix

from ..oracles.bake_off import neck_within
from ..oracles.neck_table import NeckSteps, neck_step
from .test_neck_table import neck

RUNTIME = load_functions("softneck.design.linear._allocation_runtime")
TILT = st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
COMMON = st.floats(-8.0, 8.0)
POSITION = st.floats(0.5, 6.0)
MOTORS = st.tuples(*[st.floats(-6.0, 6.0)] * 3)
# Tendons up to 23 deg beside 0, 120 and 240 deg: they surround the link, which is all that is asked.
ANGLES = st.tuples(*[st.floats(angle - 0.4, angle + 0.4) for angle in (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)])
# Sums of a few numbers up to 10, and quotients by numbers from 0.5 on.
ROUNDING = 1e-12


def tendons(T: np.ndarray, wanted: np.ndarray, position: float, least: float) -> np.ndarray:
    bounds = (np.full(3, -position), np.full(3, position))
    return allocated(np.ascontiguousarray(np.linalg.inv(T)), wanted, bounds, least, taut=least > -position)


def allocated(
    inverse: np.ndarray, wanted: np.ndarray, bounds: tuple[np.ndarray, np.ndarray], least: float, *, taut: bool
) -> np.ndarray:
    target = np.empty(len(inverse))
    limits = np.concatenate([[100.0, 100.0, least], *bounds])
    RUNTIME.allocate_tendons(inverse, wanted, limits, taut, target)
    return target


def shares(T: np.ndarray, wanted: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Return the share of the tilt that is left, and how far the rest points elsewhere [rad]."""
    got = (T @ target)[:2]
    size = float(np.hypot(*wanted[:2]))
    if size < 1e-6:
        return 1.0, float(np.hypot(*(got - wanted[:2])))
    along = float(got @ wanted[:2]) / size
    across = (wanted[0] * got[1] - wanted[1] * got[0]) / size
    return float(along / size), abs(float(across))


@given(tilt=TILT, common=COMMON, angles=ANGLES)
def test_without_limits_it_is_the_inverse_of_eq_9_to_11(
    tilt: tuple[float, float], common: float, angles: tuple[float, float, float]
) -> None:
    T = redefinition_matrix(np.array(angles))
    wanted = np.array([*tilt, common])
    np.testing.assert_allclose(T @ tendons(T, wanted, 100.0, -100.0), wanted, atol=1e-11)


@given(tilt=TILT, common=COMMON, angles=ANGLES, position=POSITION, part=st.floats(-1.0, 0.9))
@example(tilt=(0.0, 0.0), common=0.0, angles=(0.0, 1.6953125, 4.0), position=1.0, part=0.75)
def test_within_the_limits_tilt_keeps_its_direction(
    tilt: tuple[float, float], common: float, angles: tuple[float, float, float], position: float, part: float
) -> None:
    T = redefinition_matrix(np.array(angles))
    wanted = np.array([*tilt, common])
    least = part * position
    target = tendons(T, wanted, position, least)
    assert target.max() <= position + ROUNDING
    assert target.min() >= -position - ROUNDING
    # A least position that unequal tendons cannot all keep at rest is kept as far as the limit lets it.
    C = np.linalg.inv(T)[:, 2]
    if part > -1.0 and least * (C.max() / C.min() if least > 0.0 else 1.0) <= position:
        assert target.min() >= least - ROUNDING
    share, elsewhere = shares(T, wanted, target)
    assert elsewhere < 1e-11
    assert -1e-9 <= share <= 1.0 + 1e-9


@given(tilt=TILT, common=st.floats(-2.0, 2.0), position=st.floats(3.0, 6.0), least=st.floats(-2.5, 1.0))
def test_no_more_tilt_is_given_away_than_the_limits_ask_and_no_more_pull_is_added(
    tilt: tuple[float, float], common: float, position: float, least: float
) -> None:
    """A linear program finds the largest share, and then the least co-contraction that allows it."""
    T = redefinition_matrix(np.array([0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0]))
    wanted = np.array([*tilt, common])
    target = tendons(T, wanted, position, least)
    inverse = np.linalg.inv(T)
    p, c = inverse[:, :2] @ np.array(tilt), inverse[:, 2]
    # Unknowns: share, co-contraction; p share + c common within least and position.
    rows, bounds = np.block([[p[:, None], c[:, None]], [-p[:, None], -c[:, None]]]), np.array([position, -least])
    limits = np.repeat(bounds, 3)
    low = max(common, least)
    most = linprog([-1.0, 0.0], A_ub=rows, b_ub=limits, bounds=[(0.0, 1.0), (low, None)]).x[0]
    leanest = linprog([0.0, 1.0], A_ub=rows, b_ub=limits, bounds=[(most - 1e-9, most + 1e-9), (low, None)]).x[1]
    if math.hypot(*tilt) > 1e-3:
        # The program is solved to 1e-9.
        assert shares(T, wanted, target)[0] == pytest.approx(most, abs=1e-6)
    assert (T @ target)[2] == pytest.approx(leanest, abs=1e-6)


@given(target=MOTORS, motors=MOTORS, lead=st.floats(0.01, 12.0))
def test_the_lead_is_shared(
    target: tuple[float, float, float], motors: tuple[float, float, float], lead: float
) -> None:
    asked, here = np.array(target), np.array(motors)
    got = asked.copy()
    RUNTIME.allocate_lead(got, here, lead)
    assert np.abs(got - here).max() <= lead * (1.0 + ROUNDING)
    # On the straight line, and all the way where nothing limits.
    np.testing.assert_allclose(np.cross(got - here, asked - here), 0.0, atol=1e-10)
    if np.abs(asked - here).max() <= lead:
        np.testing.assert_array_equal(got, asked)


@given(target=MOTORS, held=MOTORS, move=st.floats(0.01, 12.0))
def test_the_slew_is_shared(target: tuple[float, float, float], held: tuple[float, float, float], move: float) -> None:
    asked, before = np.array(target), np.array(held)
    got = before.copy()
    RUNTIME.allocate_move(asked, move, got)
    assert np.abs(got - before).max() <= move * (1.0 + ROUNDING)
    np.testing.assert_allclose(np.cross(got - before, asked - before), 0.0, atol=1e-10)
    assert (got - before) @ (asked - before) >= 0.0


@given(tilt=TILT, common=COMMON, position=POSITION, part=st.floats(-1.0, 0.9))
def test_tendons_have_no_number(tilt: tuple[float, float], common: float, position: float, part: float) -> None:
    """Turned by a third, the same is asked of the next motor."""
    third = 2.0 * math.pi / 3.0
    T = redefinition_matrix(np.array([0.0, third, 2.0 * third]))
    turn = np.array([[math.cos(third), -math.sin(third)], [math.sin(third), math.cos(third)]])
    first = tendons(T, np.array([*tilt, common]), position, part * position)
    turned = tendons(T, np.array([*(turn @ np.array(tilt)), common]), position, part * position)
    np.testing.assert_allclose(np.roll(first, 1), turned, atol=1e-11)


@st.composite
def any_robot(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Weights of 1 to 4 outputs over 1 to 8 motors, tendons around an axis among them, and what is wanted."""
    outputs = draw(st.integers(1, 4))
    motors = draw(st.integers(outputs, 8))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    angles = rng.uniform(0.0, 2.0 * math.pi, motors)
    tendons_only = outputs <= 2 and draw(st.booleans())
    W = np.array([np.cos(angles), np.sin(angles)])[:outputs] if tendons_only else rng.normal(size=(outputs, motors))
    assume(np.linalg.svd(W, compute_uv=False)[-1] > 0.1)
    return W, rng.normal(size=outputs + 1) * draw(st.floats(0.1, 5.0))


@given(robot=any_robot())
def test_the_inverse_of_any_robot_gives_the_least_motors_and_a_shared_cocontraction(
    robot: tuple[np.ndarray, np.ndarray],
) -> None:
    W, wanted = robot
    outputs, motors = W.shape
    T, inverse = redefinition_of(W, tuple("abcd"[:outputs]))
    tilt, common = inverse[:, :-1], inverse[:, -1]
    # Rounding by the condition of W, at most some 1e2 here.
    np.testing.assert_allclose(W @ tilt, np.eye(outputs), atol=1e-11)
    np.testing.assert_allclose(T[:-1] @ common, 0.0, atol=1e-9)
    # No null space of W in it: no motors that give the same are smaller.
    np.testing.assert_allclose(null_space(W).T @ tilt, 0.0, atol=1e-11)
    if motors > outputs:
        assert common.mean() == pytest.approx(1.0)
        assert T[-1] @ inverse @ wanted == pytest.approx(wanted[-1], abs=1e-8)
        # The nearest of the null space to (1, .., 1): what is left of it stands on the null space.
        nearest = common / (common @ common) * common.sum()
        np.testing.assert_allclose(null_space(W).T @ (np.ones(motors) - nearest), 0.0, atol=1e-8)
    else:
        assert not common.any()


@given(robot=any_robot(), seed=st.integers(0, 1000), unipolar=st.booleans())
def test_any_robot_gives_away_no_more_tilt_than_a_linear_program(
    robot: tuple[np.ndarray, np.ndarray], seed: int, unipolar: bool
) -> None:
    W, wanted = robot
    motors, rng = W.shape[1], np.random.default_rng(seed)
    inverse = redefinition_of(W, tuple("abcd"[: len(W)]))[1]
    # Co-contraction a thousand times the mean in one motor is one that the program cannot tell from none.
    assume(np.abs(inverse[:, -1]).max() < 1e3 and np.all((inverse[:, -1] == 0.0) | (np.abs(inverse[:, -1]) > 1e-3)))
    low = np.zeros(motors) if unipolar else -rng.uniform(0.5, 6.0, motors)
    high = rng.uniform(1.0, 6.0, motors)
    got = allocated(inverse, wanted, (low, high), -10.0, taut=True)
    assert np.all(got >= low - ROUNDING)
    assert np.all(got <= high + ROUNDING)
    asked = wanted[:-1]
    p, c = inverse[:, :-1] @ asked, inverse[:, -1]
    kept = float(W @ got @ asked / (asked @ asked))
    # The direction of tilt stays; 1e-9: conditions of W up to 1e2, motors up to 1e2.
    np.testing.assert_allclose(W @ got, kept * asked, atol=1e-9)
    # Co-contraction comes before tilt, within what all motors can at rest, and rises for the tilt's sake alone.
    at_rest = linprog(
        [0.0], A_ub=np.concatenate([c, -c])[:, None], b_ub=np.concatenate([high, -low]), bounds=[(None, None)]
    )
    assert at_rest.success
    rows, limits = np.block([[p[:, None], c[:, None]], [-p[:, None], -c[:, None]]]), np.concatenate([high, -low])
    ends = [
        linprog([s], A_ub=np.concatenate([c, -c])[:, None], b_ub=limits, bounds=[(-1e4, 1e4)]).x[0] for s in (1.0, -1.0)
    ]
    least = min(max(wanted[-1], ends[0]), ends[1])
    best = linprog([-1.0, 0.0], A_ub=rows, b_ub=limits, bounds=[(0.0, 1.0), (least, None)]).x[0]
    # The program is solved to 1e-9; small shares of co-contraction widen that.
    assert kept == pytest.approx(best, abs=1e-5)


def pi(*, least_position: float = -6.0, least_cocontraction: float = -6.0) -> LinearController:
    settings = PiSettings(lead_limit=0.8, reference_time=0.12, least_cocontraction=least_cocontraction)
    return settings.design(neck(), robot=neck_within(lowest=least_position))


def test_a_least_cocontraction_keeps_tendons_taut_under_a_payload_that_slackens_them() -> None:
    steps = NeckSteps(orientations=(math.radians(45.0),), payloads=(0.8,))
    slack, taut = (neck_step(controller, None, steps, 0) for controller in (pi(), pi(least_cocontraction=0.8)))
    tensions = [np.column_stack([result[f"tension_{j}"] for j in (1, 2, 3)]) for result in (slack, taut)]
    last = slice(-100, None)
    assert tensions[0][last].min() == 0.0
    assert tensions[1][last].min() > 0.3


def test_a_least_position_raises_the_cocontraction_and_no_motor_is_below_it() -> None:
    steps = NeckSteps(orientations=(math.radians(90.0),), payloads=(0.4,))
    free, taut = (neck_step(controller, None, steps, 0) for controller in (pi(), pi(least_position=-0.8)))
    motors = [np.column_stack([result[f"motor_setpoint_{j}"] for j in (1, 2, 3)]) for result in (free, taut)]
    assert motors[0].min() < -1.2
    assert motors[1].min() >= -0.8 - ROUNDING
    # The tilt is the same, only the mean is not: both end at 15 deg.
    np.testing.assert_allclose(free["roll"][-50:].mean(), taut["roll"][-50:].mean(), atol=math.radians(0.2))
    assert motors[1][-1].mean() > motors[0][-1].mean() + 0.4


def test_a_rise_of_the_least_cocontraction_is_no_bump() -> None:
    """Motors at rest below it come to it with the reference filter, 0.12 s here, not at the slew limit."""
    block = pi(least_cocontraction=1.0).block()
    U = np.zeros((200, 10))
    U[:, 8:] = 1.0
    P = block.run(block.initial_state(), U)[1]
    steps = np.abs(np.diff(np.vstack([np.zeros(3), P]), axis=0))
    # The filter moves by 1 - exp(-0.02 / 0.12) of what is left; motors stand still here: lead limit 0.8 ends it.
    assert steps.max() <= 1.0 - math.exp(-0.02 / 0.12) + 1e-12
    np.testing.assert_allclose(P[-1], 0.8, atol=1e-9)


def test_files_of_before_the_rule_are_read(tmp_path: Path) -> None:
    pi().save(tmp_path / "c.npz")
    header, arrays = read_archive(tmp_path / "c.npz")
    old = {key: value for key, value in header.items() if not key.startswith(("format", "least"))}
    write_archive(tmp_path / "old.npz", old, arrays)
    assert load(tmp_path / "old.npz").limits.least_position == -6.0


@pytest.mark.parametrize("name", ["least_position", "least_cocontraction"])
def test_a_rule_that_leaves_no_room_is_refused(name: str) -> None:
    with pytest.raises(SettingsError, match=rf"`{name}` must be below `position_limit`, 2 rad"):
        replace(ControllerLimits(position_limit=2.0), **{name: 2.5})
