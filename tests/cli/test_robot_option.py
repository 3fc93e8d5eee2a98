"""`--robot` of the commands that read recordings and models."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from softneck.core import load
from softneck.identification import Rls
from softneck.robot import Robot
from softneck.signals import Recording, read_recording, write_recording

from .conftest import Call


@pytest.fixture
def neck_files(tmp_path: Path, recording: Path) -> Path:
    """Return a folder with a recording and a model of the neck."""
    shutil.copy(recording, tmp_path / "rec.csv")
    Rls().fit(read_recording(recording)).save(tmp_path / "rls.npz")
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        ("identify", "rls", "rec.csv", "-o", "a.npz"),
        ("identify", "auto", "rec.csv", "-o", "a.npz"),
        ("family", "rec.csv", "-o", "a.npz"),
        ("validate", "rls.npz", "--data", "rec.csv"),
        ("design", "pi", "rls.npz", "-o", "a.npz"),
        ("observer", "rls.npz", "-o", "a.npz"),
        ("fmu", "rls.npz", "-o", "a.fmu"),
    ],
    ids=lambda command: command[0] if isinstance(command, tuple) else command,
)
def test_another_robot_than_the_files_is_refused(call: Call, neck_files: Path, command: tuple[str, ...]) -> None:
    said = call(*command, "--robot", "arm")
    assert said.code == 2
    (line,) = said.error.strip().splitlines()
    assert "arm" in line
    # Of the recording three motors with `pitch` and `roll` are not the arm's channels; else both are named.
    assert "`neck`" in line or "yaw" in line
    assert not list(neck_files.glob("a.*"))


def test_a_controller_keeps_the_limits_of_the_necks_own_file(call: Call, neck_files: Path) -> None:
    own = 'extends = "neck"\n[motors]\nsetpoint_min = -3.0\nsetpoint_max = 4.0\nrate_limit = 5.0\n'
    (neck_files / "mine.toml").write_text(own)
    assert call("design", "pi", "rls.npz", "-o", "usual.npz", "--any-fit").code == 0
    assert call("design", "pi", "rls.npz", "-o", "pi.npz", "--any-fit", "--robot", "mine.toml").code == 0
    usual, limits = load(neck_files / "usual.npz").limits, load(neck_files / "pi.npz").limits
    assert (usual.position_limit, usual.slew_limit, usual.least_position) == (6.0, 12.5, -6.0)
    assert (limits.position_limit, limits.slew_limit, limits.least_position) == (4.0, 5.0, -3.0)
    # `robot.toml` beside the model says it as well.
    (neck_files / "mine.toml").rename(neck_files / "robot.toml")
    assert call("design", "pi", "rls.npz", "-o", "beside.npz", "--any-fit").code == 0
    limits = load(neck_files / "beside.npz").limits
    assert (limits.position_limit, limits.slew_limit) == (4.0, 5.0)


def test_a_model_carries_a_necks_own_file(neck_files: Path, call: Call) -> None:
    (neck_files / "mine.toml").write_text('name = "mine"\nextends = "neck"\n[motors]\nsetpoint_max = 4.0\n')
    mine = Robot.read(neck_files / "mine.toml")
    for robot in (None, mine):
        recording = read_recording(neck_files / "rec.csv", robot=robot)
        Rls().fit(recording).save(neck_files / "m.npz", force=True)
        said = load(neck_files / "m.npz").robot
        assert said.name == ("neck" if robot is None else "mine")
        assert max(said.motors.setpoint_max or (0.0,)) == (6.0 if robot is None else 4.0)
        assert said.hash == Robot.preset("neck").hash
    # A recording of another robot is not taken for it.
    other = Robot.preset("antagonist")
    channels = {name: np.zeros(50) for name in (*other.set_points, *other.outputs.names)}
    two = Recording(time=0.02 * np.arange(50), channels=channels, sample_time=0.02, robot=other)
    write_recording(neck_files / "two.csv", two)
    said = call("identify", "rls", "two.csv", "--robot", "mine.toml", "-o", "b.npz")
    assert said.code == 2
    assert "is a recording of robot `antagonist`" in said.error
    assert "`mine`" in said.error
