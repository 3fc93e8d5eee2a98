"""Linear predictive control of other robots than the neck: tightened limits, measured disturbances, the QP itself."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import load
from softneck.core import Matrix, SettingsError
from softneck.design import MeasuredDisturbance, MpcController, MpcSettings
from softneck.design.predictive import _mpc_state_runtime as rt
from softneck.design.predictive._tightening import directions
from softneck.robot import Robot

from ..data import slow_but
from .test_robots import BELLOWS, DELAY, POLE, TS, plant

ROBOTS = slow_but(["antagonist", "trunk4"], [], nightly=["trunk4"])
GAIN = 0.08


def followed(
    controller: MpcController,
    reference: Matrix,
    *,
    error: float = 0.0,
    told: float = 0.0,
    push: Matrix | None = None,
    seed: int = 5,
) -> tuple[Matrix, Matrix]:
    """Outputs and motors of the loop over lags of GAIN, written out: measurements are wrong by up to `error`."""
    robot = controller.robot
    m, n, rng = len(robot.outputs.names), len(robot.motors.names), np.random.default_rng(seed)
    W = np.asarray(robot.weights())
    state, line, y, u = controller.initial_state(), [np.zeros(m)] * DELAY, np.zeros(m), np.zeros(n)
    bias, extra = 0.5 * error * rng.choice([-1.0, 1.0], m), np.zeros(m)
    seen, given = [], []
    for k, wanted in enumerate(reference):
        true = y + extra
        measured = true + bias + 0.5 * error * rng.uniform(-1.0, 1.0, m)
        pushed = [] if push is None else [told * push[k]]
        state, u = controller.step(state, [*wanted, 0.0, *measured, *u, 1.0, 1.0, *pushed])
        line.append(GAIN * W @ u)
        y = POLE * y + (1.0 - POLE) * line.pop(0)
        if push is not None:
            keep = math.exp(-TS / 0.3)
            extra = keep * extra + (1.0 - keep) * np.array([0.5 * push[k], *[0.0] * (m - 1)])
        seen.append(true)
        given.append(u)
    return np.array(seen), np.array(given)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_measured_disturbance_is_met_before_it_shows(name: str, tmp_path: Path) -> None:
    robot = Robot.preset(name)
    known = MeasuredDisturbance(name="base_tilt", unit="rad", pitch=0.5, time=0.3)
    settings = MpcSettings(bandwidth=8.0, horizon=15, moves=5, disturbances=(known,))
    settings.design(plant(robot)).save(tmp_path / "mpc.npz")
    controller = load(tmp_path / "mpc.npz")
    assert controller.disturbances == (known,)
    push = np.where(np.arange(200) >= 50, 0.1, 0.0)
    rest = np.zeros((200, len(robot.outputs.names)))
    worst = [np.abs(followed(controller, rest, told=told, push=push)[0][:, 0]).max() for told in (0.0, 1.0)]
    # What the dead time lets through is left.
    assert worst[1] < 0.75 * worst[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["antagonist", "trunk4"])
def test_tightened_limits_hold_where_others_do_not(name: str) -> None:
    robot = Robot.preset(name)
    limit, error = 0.15, 0.03
    settings = MpcSettings(
        bandwidth=6.0, horizon=15, moves=5, angle_limit=limit, minimum_tautness=-2.5, tautness_lever=6.93,
        measurement_bound=error, reference_time=0.05,
    )  # fmt: skip
    loose, tight = (replace(settings, tightening=tightening).design(plant(robot)) for tightening in (False, True))
    back = tight.design["back_off_rad"]
    assert 0.0 < back["angle"] < 0.5 * limit
    m = len(robot.outputs.names)
    reference = np.repeat([1.0, -1.0, 1.4, 0.0], 75)[:, None] * limit * np.ones(m)
    beyond = [
        max(np.abs(followed(c, reference, error=error, seed=seed)[0]).max() - limit for seed in range(4))
        for c in (loose, tight)
    ]
    # Half of a measurement's error is constant: so much a limit that is not tightened is passed by.
    assert beyond[0] > 0.25 * error
    # Other draws of the random half than the trials' ask for a tenth of it more.
    assert beyond[1] < 0.05 * error


@pytest.mark.parametrize("name", ROBOTS)
def test_the_qp_as_a_function_is_the_one_that_is_solved(name: str) -> None:
    """In units of its own: bounds, cost and rows are the program's, and a motor's range is its robot's."""
    table = Robot.preset(name).as_dict()
    table["motors"] |= {"setpoint_min": -2.0, "setpoint_max": 3.0}
    robot = Robot.from_dict(table)
    controller = MpcSettings(bandwidth=6.0, horizon=8, moves=3, angle_limit=0.15).design(plant(robot))
    program, a = controller.program(), rt.MpcArrays(controller.arrays)
    m, n = len(robot.outputs.names), len(robot.motors.names)
    unit = a.constants[-2 * m - 1]
    theta = np.zeros(a.K.shape[1])
    theta[-1] = 1.0
    H, f, A, lower, upper = (np.array(item.full()) for item in program.function()(theta, [2.5, 15.6 * TS, 0.15, 0.0]))
    np.testing.assert_array_equal(H, a.H)
    np.testing.assert_array_equal(A, a.A)
    np.testing.assert_allclose(f[:, 0], a.F @ theta, atol=1e-12)
    limits = np.array([2.5, 15.6, 12.0, -9.0, 0.15]) / np.array([unit] * 4 + [1.0])
    own = program.bounds(theta, limits, np.zeros(n))
    of = a.kinds[:, 0] != rt.MPC_ROW_SLACK
    np.testing.assert_allclose(lower[of, 0], own[0][of], rtol=1e-12)
    np.testing.assert_allclose(upper[of, 0], own[1][of], rtol=1e-12)
    at = a.kinds[:, 0] == rt.MPC_ROW_POSITION
    np.testing.assert_allclose(unit * lower[at, 0], -2.0)
    np.testing.assert_allclose(unit * upper[at, 0], 2.5)


def test_trials_go_along_each_output_and_along_all_together() -> None:
    neck = list(directions(2, np.random.default_rng(0), neck=True))
    # The neck's four directions are as they were.
    np.testing.assert_allclose([way for way, _ in neck], [[1, 0], [1, 1], [0, 1], [-1, -1]], atol=1e-15)
    found = {m: list(directions(m, np.random.default_rng(0), neck=False)) for m in (1, 2, 3)}
    # Every output is wrong to both sides: one sign alone left a single one's limit passed by a degree.
    assert [way.tolist() for way, _ in found[2]] == [[1, 0]] * 2 + [[0, 1]] * 2 + [[1, 1]] * 2 + [[-1, -1]] * 2
    assert [(way.tolist(), bias.tolist()) for way, bias in found[1]] == [([1.0], [1.0]), ([1.0], [-1.0])]
    np.testing.assert_array_equal([way for way, _ in found[3]][6:], [[1.0] * 3] * 2 + [[-1.0] * 3] * 2)


def test_gains_of_a_disturbance_are_by_the_outputs_names() -> None:
    one = MeasuredDisturbance(name="load", unit="N", gains={"x": 1e-3, "z": -2e-3})
    np.testing.assert_array_equal(one.on(BELLOWS), [1e-3, 0.0, -2e-3])
    with pytest.raises(SettingsError, match=r"`load` moves `x`, which robot `antagonist` .* does not have"):
        one.on(Robot.preset("antagonist"))
    with pytest.raises(SettingsError, match="`push` moves `roll`"):
        MeasuredDisturbance(name="push", roll=0.1).on(Robot.preset("antagonist"))


def test_a_bound_of_measurements_is_asked_for_where_no_file_says_one() -> None:
    table: dict[str, Any] = Robot.preset("antagonist").as_dict()
    del table["sensor"]["noise_std"]
    with pytest.raises(SettingsError, match=r"gives no `sensor.noise_std`, which `tightening` needs; add it, or give"):
        MpcSettings(bandwidth=6.0, horizon=8, moves=3, angle_limit=0.15, tightening=True).design(
            plant(Robot.from_dict(table))
        )
