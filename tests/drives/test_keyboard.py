"""Keys and typed words over a pseudo-terminal, on drives in real time."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from softneck.signals import read_recording

from ..data import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are Unix's")
# A machine that stalls ends a run by itself: such a try says nothing about keys.
_STALLS = ("stalled", "tpdo", "position did not come", "no drive answered", "heartbeat", "emergency", "dropped out",
           "stood still", "follow")  # fmt: skip


@dataclass(frozen=True)
class Ended:
    code: int
    said: str
    states: list[int]
    powered: bool
    restored: bool
    recording: Path


def played(tmp_path: Path, *steps: tuple[str, bytes, float], simulated: bool = False) -> Ended:
    """Run `drives record` on a terminal; after each text was said, wait for a time and type."""
    import pty
    import termios

    drives, report, recording = tmp_path / "drives.toml", tmp_path / "ended.json", tmp_path / "r.csv"
    text = (ROOT / "examples" / "drives" / "drives.toml").read_text(encoding="utf-8")
    head, ramp, rest = text.partition("[ramp]\nspeed_rad_s = 1.0\nsettle_s = 1.0\ntolerance_rad = 0.05")
    assert ramp
    drives.write_text(head + "[ramp]\nspeed_rad_s = 3.0\nsettle_s = 0.1\ntolerance_rad = 0.2" + rest, encoding="utf-8")
    command = [sys.executable, str(Path(__file__).with_name("served.py")), str(report), "drives", "record", "sine",
               "-o", str(recording), "--drives", str(drives)]  # fmt: skip
    command += ["--simulated", "--pace", "2"] if simulated else ["--bus", "virtual:served", "--arm"]
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    child = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
                             preexec_fn=lambda: _take(theirs))  # fmt: skip
    said, waiting = "", list(steps)
    until = time.monotonic() + 60.0
    mark = 0
    while child.poll() is None and time.monotonic() < until:
        if select.select([ours], [], [], 0.05)[0]:
            said += os.read(ours, 4096).decode(errors="replace")
        if waiting and (found := said.find(waiting[0][0], mark)) >= 0:
            mark = found + len(waiting[0][0])
            time.sleep(waiting[0][2])
            os.write(ours, waiting.pop(0)[1])
    if child.poll() is None:
        child.kill()
    child.wait()
    while select.select([ours], [], [], 0.1)[0]:
        said += os.read(ours, 4096).decode(errors="replace")
    after = termios.tcgetattr(theirs)
    os.close(ours)
    os.close(theirs)
    ended = json.loads(report.read_text(encoding="utf-8")) if report.is_file() else {"states": [], "powered": False}
    return Ended(child.returncode, said, ended["states"], ended["powered"], before == after, recording)


def _take(terminal: int) -> None:
    import fcntl
    import termios

    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)


@pytest.mark.parametrize(
    ("key", "code", "line"),
    [
        (b" ", 1, "by the operator. The drives are off"),
        pytest.param(b"\x1b", 1, "by the operator. The drives are off", marks=pytest.mark.slow),
        (b"\x03", 130, "interrupted"),
    ],
    ids=["space", "escape", "ctrl-c"],
)
def test_keys_end_a_recording_and_keep_what_was_recorded(tmp_path: Path, key: bytes, code: int, line: str) -> None:
    """On simulated drives at twice real time: no stall of the machine can end it instead."""
    ended = played(tmp_path, ("record: sine", key, 1.0), simulated=True)
    assert ended.code == code, ended.said
    assert line in " ".join(ended.said.split())
    assert ended.restored
    assert 10 < len(read_recording(ended.recording).time) < 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "code", "line"), [(b" ", 1, "by the operator"), (b"\x03", 130, "interrupted")], ids=["space", "ctrl-c"]
)
def test_keys_switch_drives_on_a_bus_off(tmp_path: Path, key: bytes, code: int, line: str) -> None:
    """The words are typed, the drives get power; after the ramp and some seconds of signal somebody presses a key."""
    ended = played(tmp_path, ("to go on", b"MOVE served\n", 0.0), ("POWERED", key, 4.0))
    said = " ".join(ended.said.split())
    if line not in said and any(word in said for word in _STALLS):
        pytest.skip(f"this machine stalled: {said[-200:]}")
    assert ended.code == code, ended.said
    assert line in said
    assert ended.powered
    assert ended.restored
    # Switched off; a drive whose guarding ended before it was disarmed may say so by Fault, which is off as well.
    assert all(state in (0x40, 0x08) for state in ended.states)
    assert 10 < len(read_recording(ended.recording).time) < 1000


def test_other_words_move_nothing(tmp_path: Path) -> None:
    ended = played(tmp_path, ("to go on", b"yes\n", 0.0))
    assert ended.code == 2
    assert "`yes` was typed, not `MOVE served`. Nothing was sent." in " ".join(ended.said.split())
    assert not ended.powered
    assert ended.states == [0x40] * 3
    assert not ended.recording.exists()
