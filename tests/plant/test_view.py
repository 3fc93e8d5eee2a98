"""The 3-D view: one file that needs nothing, drawn and played by a real browser."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plant._geometry_runtime import bend_functions, lean_angles, tilt_rotation
from softneck.plots import neck_view
from softneck.plots._neck3d import bend_of
from softneck.robot import Robot
from softneck.signals import Excitation, Recording, signal


@pytest.fixture(scope="module")
def recording() -> Recording:
    whole = signal("rotation")
    part = Excitation("rotation", whole.time[:250], whole.set_points[:250])
    return record(part, VirtualNeck(NeckParameters.paper()), seed=1)


def test_the_page_carries_all_it_needs_and_escapes_its_title(recording: Recording) -> None:
    page = neck_view(recording, title="<script>alert(1)</script>")
    assert "<script>alert" not in page
    assert not re.search(r"https?://|@import|\bsrc\s*=|\bhref\s*=|fetch\(", page)
    assert "@@" not in page
    assert len(page) < 200_000


def test_the_bend_that_is_drawn_is_the_one_that_was_measured() -> None:
    b = np.random.default_rng(1).uniform(-0.7, 0.7, (50, 2))
    R = tilt_rotation(0.0, 0.0)
    angles = np.array([lean_angles((x, y, 0.0, 0.0), bend_functions(x * x + y * y), R)[:2] for x, y in b])
    # The same geometry, once by atan2 and once by tan: rounding.
    np.testing.assert_allclose(bend_of(angles), b, atol=1e-14)


def test_what_cannot_be_drawn_is_refused(recording: Recording) -> None:
    upside_down = recording.with_channels(pitch=recording.channels["pitch"] + 2.0)
    with pytest.raises(DataError, match="exceeds 90 deg"):
        neck_view(upside_down)
    lost = recording.with_channels(pitch=np.full(len(recording), np.nan))
    with pytest.raises(DataError, match="no sample of pitch and roll"):
        neck_view(lost)


@pytest.mark.parametrize("name", ["trunk4", "antagonist", "finger"])
def test_robots_that_tendons_bend_are_drawn_by_theirs(name: str) -> None:
    robot = Robot.preset(name)
    outputs = len(robot.outputs.names)
    angles = np.linspace(0.0, 0.5, 50 * outputs).reshape(50, outputs)
    channels = dict.fromkeys(robot.set_points, np.ones(50)) | dict(zip(robot.outputs.names, angles.T, strict=True))
    page = neck_view(Recording(0.02 * np.arange(50), 0.02, channels, robot=robot))
    found = re.search(r"^const data = (.*);$", page, re.MULTILINE)
    assert found is not None
    data = json.loads(found[1])
    assert tuple(data["tendons"]) == robot.directions.angles_deg
    assert (tuple(data["names"]), data["unit"]) == (robot.outputs.names, "rad")
    assert len(data["pull"][0]) == len(robot.set_points)
    plane = np.column_stack([angles, np.zeros(50)])[:, :2]
    # Rounded to five digits in the page.
    np.testing.assert_allclose(data["bend"], bend_of(plane), atol=1e-5)


def test_a_robot_that_no_tendons_bend_is_not_drawn() -> None:
    robot = Robot.from_dict({
        "name": "tank", "motors": {"names": ["pump"], "unit": "V"}, "outputs": {"names": ["level"], "unit": "V"},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    recording = Recording(0.02 * np.arange(5), 0.02, {"motor_setpoint_1": np.ones(5), "level": np.ones(5)}, robot=robot)
    with pytest.raises(DataError, match=r"robot `tank` \(\w{8}\) has no view in 3-D: only robots bent by tendons"):
        neck_view(recording)


@pytest.mark.slow
@pytest.mark.parametrize("plain", [False, True], ids=["with tensions", "set-points, pitch and roll only"])
def test_a_browser_draws_and_plays_it(recording: Recording, tmp_path: Path, chromium: str, plain: bool) -> None:
    kept = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "pitch", "roll")
    channels = {name: recording.channels[name] for name in kept} if plain else recording.channels
    page = tmp_path / "neck.html"
    page.write_text(neck_view(Recording(recording.time, 0.02, channels)), encoding="utf-8")
    command = [
        chromium, "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2500",
        f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body is not None
    assert 'data-drawn="yes"' in body[0]
    frame = re.search(r'data-frame="(\d+)"', body[0])
    assert frame is not None
    # 2.5 s of virtual time play about 125 frames of 20 ms; a page that stands still stays at 0.
    assert 10 < int(frame[1]) < 250
    assert "Uncaught" not in done.stderr
