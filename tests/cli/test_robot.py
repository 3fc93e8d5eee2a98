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
    assert "n.toml: no such file" in call("robot").error
    (tmp_path / "robot.toml").write_text('extends = "neck"\n[motor]\nunit = "deg"\n')
    said = call("info", "robot.toml")
    assert (said.code, "unknown key `motor`; did you mean `motors`?" in said.error) == (2, True)


def test_a_file_that_was_found_is_said_once_and_one_that_was_given_is_not(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call("robot", "new", "--preset", "finger").code == 0
    inside = tmp_path / "logs" / "monday"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    # Recording it reads the file for the plant, for the limits and for the recording.
    said = call("record", "steps", "-o", "a.csv", "--duration", "2", "--json")
    assert (said.code, said.err.count("robot: finger, from ../../robot.toml\n")) == (0, 1)
    json.loads(said.out)
    given = call("record", "steps", "-o", "b.csv", "--duration", "2", "--robot", "finger")
    assert (given.code, "robot: " in given.err) == (0, False)
    # An error about it names it as well; what its own file says is read from there.
    (tmp_path / "robot.toml").write_text('extends = "antagonist"\nname = "mine"\n')
    said = call("identify", "rls", "a.csv", "-o", "a.npz")
    assert said.code == 2
    here, there = (Robot.preset(name).hash[:8] for name in ("antagonist", "finger"))
    assert f"of robot `finger` ({there}), not of `mine` ({here}, from ../../robot.toml)." in said.error
    (tmp_path / "robot.toml").write_text("name = 1\n")
    assert "robot.toml: `name` must be a text" in call("info", "a.csv").error
