"""The page of a project shows loops of any robot, in its outputs and units."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from softneck.cosim import Result
from softneck.loop import LoopResult, metrics
from softneck.report._project import _metrics, project_verdict, read_project
from softneck.robot import Robot
from softneck.signals import write_recording

from ..data import neck_recording


class _Run:
    """What the page reads of a loop's result."""

    def __init__(self, robot: Robot) -> None:
        time = np.arange(200) * 0.02
        step = np.where(time < 1.0, 0.0, 0.1)
        outputs = {name: (k + 1) * step for k, name in enumerate(robot.outputs.names)}
        signals = {**{f"{name}_true": y for name, y in outputs.items()}, **outputs}
        signals |= {f"{name}_reference": step for name in outputs}
        signals |= {f"motor_setpoint_{i + 1}": 0.25 * step for i in range(len(robot.motors.names))}
        self.robot = robot
        self.metrics = metrics(LoopResult(time, signals, {}, 0.02, robot))


@pytest.mark.parametrize("name", ["neck", "antagonist", "trunk4"])
def test_a_loop_of_any_robot_has_a_row(name: str) -> None:
    robot = Robot.preset(name)
    overshoot, settling, error, largest = _metrics(cast("Result", cast("Any", _Run(robot))))
    outputs = len(robot.outputs.names)
    # The second output goes twice as far as it is asked to.
    assert overshoot == "/".join(["0.00", "100.00"][:outputs])
    assert settling.split("/")[0] == "0.00"
    assert error.split("/")[0] == "0.00"
    assert float(largest) == 0.025


def test_what_is_not_sure_of_log_and_robot_is_in_the_heading(tmp_path: Path) -> None:
    write_recording(tmp_path / "log.csv", neck_recording(600))
    (tmp_path / "log.layout.toml").write_text("# NOT SURE (80 %): the only column in rad\npitch = 'tilt'\n")
    sensor = "".join(f"# NOT SURE ({sure} %): why\n{key} = 0.1\n" for key, sure in (("noise_std", 80), ("delay_s", 50)))
    (tmp_path / "robot.toml").write_text(f'extends = "neck"\n[sensor]\n{sensor}')
    sentence, _ = project_verdict(read_project(tmp_path))
    assert sentence.endswith(
        " Not sure of the log: pitch (80 % sure). Not sure of the robot: noise_std (80 % sure) and 1 more."
    )
