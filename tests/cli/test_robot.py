"""`softneck robot`, and what `info` says of a robot file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.robot import Robot

from .conftest import Call


@pytest.mark.parametrize("preset", ["neck", "arm", "antagonist", "finger", "trunk4"])
def test_a_new_robot_file_is_the_preset_and_holds(call: Call, tmp_path: Path, preset: str) -> None:
    assert call("robot", "new", "--preset", preset).code == 0
    assert Robot.read(tmp_path / "robot.toml").hash == Robot.preset(preset).hash
    shown = json.loads(call("robot", "--json").out)
    assert shown.pop("hash") == Robot.preset(preset).hash
    assert shown.pop("holds")
    assert shown == Robot.preset(preset).as_dict()
    info = json.loads(call("info", "robot.toml", "--json").out)
    assert (info["type"], info["robot"]) == ("robot", preset)


def test_show_says_what_is_given_and_what_is_not(call: Call) -> None:
    out = call("robot", "arm").out
    assert "winch.radius_m = 0.0093" in out
    assert "not given: sensor.noise_std" in out
    assert call("robot").out.startswith("neck: 3 motor(s) [rad], 2 output(s)")


def test_bad_robots_are_one_line_and_exit_code_2(call: Call, tmp_path: Path) -> None:
    assert call("robot", "new").code == 0
    said = call("robot", "new")
    assert (said.code, "exists already" in said.error) == (2, True)
    assert call("robot", "new", "--preset", "nek").error.endswith(
        "must be one of neck, arm, antagonist, finger, trunk4; got 'nek'."
    )
    assert "must end in `.toml`" in call("robot", "new", "a.csv").error
    (tmp_path / "robot.toml").write_text('extends = "neck"\n[drives]\nfile = "d.toml"\n')
    said = call("robot")
    assert said.code == 2
    assert "`drives.file`" in said.error
    # The files are there, and are of another robot.
    (tmp_path / "d.toml").write_text('profile = "ipos2015"\n[[drive]]\nnode = 1\n')
    assert "three [[drive]] tables are needed" in call("robot").error
    (tmp_path / "robot.toml").write_text(
        'name = "b"\nmotors = { names = ["a"], unit = "bar" }\noutputs = { names = ["x"], unit = "rad" }\n'
        'directions = { kind = "identified" }\nplant = { neck = "paper" }\n'
    )
    assert "the virtual plant has motors in rad or deg, and `motors.unit` of robot `b`" in call("robot").error
    (tmp_path / "robot.toml").write_text('extends = "neck"\n[plant]\nneck = "n.toml"\n')
    assert "n.toml` is neither a neck preset" in call("robot").error
    (tmp_path / "robot.toml").write_text('extends = "neck"\n[motor]\nunit = "deg"\n')
    said = call("info", "robot.toml")
    assert (said.code, "unknown key `motor`; did you mean `motors`?" in said.error) == (2, True)
