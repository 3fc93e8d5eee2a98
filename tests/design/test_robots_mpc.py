"""Linear predictive control of other robots than the neck: measured disturbances."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from softneck import load
from softneck.core import Matrix, SettingsError
from softneck.design import MeasuredDisturbance, MpcController, MpcSettings
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


def test_gains_of_a_disturbance_are_by_the_outputs_names() -> None:
    one = MeasuredDisturbance(name="load", unit="N", gains={"x": 1e-3, "z": -2e-3})
    np.testing.assert_array_equal(one.on(BELLOWS), [1e-3, 0.0, -2e-3])
    with pytest.raises(SettingsError, match=r"`load` moves `x`, which robot `antagonist` .* does not have"):
        one.on(Robot.preset("antagonist"))
    with pytest.raises(SettingsError, match="`push` moves `roll`"):
        MeasuredDisturbance(name="push", roll=0.1).on(Robot.preset("antagonist"))
