"""Every kind of model of every preset robot: identified, better than a straight line, saved, and run as an FMU."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck import identify, load
from softneck.core._kinds import kinds_of
from softneck.cosim.parts._fmu_part import drive_fmu
from softneck.fmu import build_fmu
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import Recording, signal

ROBOTS = ("arm", "antagonist", "finger", "trunk4")
# As few numbers, starts and steps as beat a straight line: a minute or two for each robot.
SETTINGS: dict[str, dict[str, Any]] = {kind: {} for kind in kinds_of("model")} | {
    "nn": {"hidden": (8, 8), "iterations": 150},
    "greybox": {"evaluations": 40},
}
FREE = 100


@cache
def recorded(name: str, seed: int) -> Recording:
    """30 s of the robot's virtual plant; the arm names none and has the lab's neck."""
    robot = Robot.preset(name)
    plant = VirtualNeck.of(robot, NeckParameters.preset("lab")) if name == "arm" else VirtualNeck.of(robot)
    return record(signal("mixed", robot=robot, duration=30.0, seed=seed), plant, seed=seed)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("kind", kinds_of("model"))
def test_every_kind_takes_every_robot(kind: str, name: str, tmp_path: Path) -> None:
    train, test = recorded(name, 1), recorded(name, 2)
    model = identify(kind, train, train=1.0, **SETTINGS[kind])
    Y, t = test.outputs, test.time
    free = model.simulate(test)[:, : Y.shape[1]]
    line = np.column_stack([np.polyval(np.polyfit(t, y, 1), t) for y in Y.T])
    rms = [np.sqrt(np.mean((Y - found)[FREE:] ** 2, axis=0)) for found in (free, line)]
    assert (rms[0] < rms[1]).all(), rms
    model.save(tmp_path / "m.npz")
    again = load(tmp_path / "m.npz")
    assert again.robot.hash == train.robot.hash
    np.testing.assert_array_equal(again.simulate(test), model.simulate(test))
    block = again.block()
    build_fmu(block, tmp_path / "M.fmu")
    inputs = {motor: test.channels[motor][:60] for motor in test.robot.set_points}
    found = drive_fmu(tmp_path / "M.fmu", inputs, parameters={"use_measurement": 0.0})
    rows = np.full((60, len(block.inputs)), np.nan)
    rows[:, : len(inputs)] = test.set_points[:60]
    state = again.initial_state(use_measurement=0.0)
    expected = np.vstack([state.outputs, block.run(state, rows)[1][:-1]])
    # The same operations, once compiled; a search among points answers to rounding.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
