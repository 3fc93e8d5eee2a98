"""The 3-D view: one file that needs nothing, drawn and played by a real browser."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.plant._geometry_runtime import bend_functions, lean_angles, tilt_rotation
from softneck.plots import neck_view
from softneck.plots._neck3d import bend_of
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
    with pytest.raises(SettingsError, match="`link_length` must be positive"):
        neck_view(recording, link_length=0.0)


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
