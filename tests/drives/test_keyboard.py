"""Keys and typed words over a pseudo-terminal, on drives in real time."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from softneck.drives import read_run_log, replay
from softneck.drives.master._cia402 import state_of
from softneck.drives.master._events import RULES, Reaction
from softneck.signals import read_recording

from ..data import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are Unix's")
# A machine that stalls ends a run by itself: such a try says nothing about keys.
_STALLS = ("stalled", "tpdo", "position did not come", "no drive answered", "heartbeat", "emergency", "dropped out",
           "stood still", "follow")  # fmt: skip


@dataclass(frozen=True)
class ProcessEnd:
    code: int
    said: str
    states: list[int]
    powered: bool
    restored: bool
    recording: Path
    log: Path

    @property
    def how(self) -> tuple[str, set[str], str]:
        """Phase and states of the drives as the log, which must be whole and replay, has them in the end; the fault."""
        log = read_run_log(self.log)
        assert log.cut == ""
        replay(log).require()
        states = {}
        for cycle in log.cycles:
            for frame in cycle.received:
                if frame.identifier & 0x780 == 0x180 and not frame.error:
                    states[frame.identifier] = state_of(int.from_bytes(frame.data[:2], "little")).name
        stops = [name for _, name, _ in log.events if RULES[name].reaction is Reaction.STOP]
        return log.cycles[-1].phase, set(states.values()), stops[0] if stops else ""


RECORD = ("record", "sine", "-o", "r.csv")
# Closes the terminal.
CLOSE = b"close"


def played(
    tmp_path: Path, *steps: tuple[str, bytes | signal.Signals, float], simulated: bool = False,
    command: tuple[str, ...] = RECORD, pace: str = "2",
) -> ProcessEnd:  # fmt: skip
    """Run a command on a terminal; after each text was said, wait for a time and type, or send a signal."""
    import pty
    import termios

    drives, report = tmp_path / "drives.toml", tmp_path / "ended.json"
    text = (ROOT / "examples" / "drives" / "drives.toml").read_text(encoding="utf-8")
    head, ramp, rest = text.partition("[ramp]\nspeed_rad_s = 1.0\nsettle_s = 1.0\ntolerance_rad = 0.05")
    assert ramp
    drives.write_text(head + "[ramp]\nspeed_rad_s = 3.0\nsettle_s = 0.1\ntolerance_rad = 0.2" + rest, encoding="utf-8")
    served = str(Path(__file__).with_name("served.py"))
    words = [sys.executable, served, str(report), "drives", *command, "--drives", str(drives)]
    words += ["--log", "l.mcap"]
    words += ["--simulated", "--pace", pace] if simulated else ["--bus", "virtual:served", "--arm"]
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    child = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, cwd=tmp_path,
                             env={**os.environ, "PYTHONPATH": _paths()},
                             preexec_fn=lambda: _take(theirs))  # fmt: skip
    said, waiting = "", list(steps)
    until = time.monotonic() + 60.0
    mark = 0
    while child.poll() is None and time.monotonic() < until:
        if ours < 0:
            time.sleep(0.05)
            continue
        if select.select([ours], [], [], 0.05)[0]:
            said += os.read(ours, 4096).decode(errors="replace")
        if waiting and (found := said.find(waiting[0][0], mark)) >= 0:
            mark = found + len(waiting[0][0])
            time.sleep(waiting[0][2])
            what = waiting.pop(0)[1]
            if isinstance(what, signal.Signals):
                child.send_signal(what)
            elif what == CLOSE:
                os.close(theirs)
                os.close(ours)
                ours = -1
            else:
                os.write(ours, what)
    if child.poll() is None:
        child.kill()
    child.wait()
    if ours < 0:
        return _ended(child.returncode, said, report, tmp_path, restored=True)
    while select.select([ours], [], [], 0.1)[0]:
        said += os.read(ours, 4096).decode(errors="replace")
    after = termios.tcgetattr(theirs)
    os.close(ours)
    os.close(theirs)
    return _ended(child.returncode, said, report, tmp_path, restored=before == after)


def _ended(code: int, said: str, report: Path, folder: Path, *, restored: bool) -> ProcessEnd:
    ended = json.loads(report.read_text(encoding="utf-8")) if report.is_file() else {"states": [], "powered": False}
    return ProcessEnd(code, said, ended["states"], ended["powered"], restored, folder / "r.csv", folder / "l.mcap")


def _paths() -> str:
    """Relative entries of the search path mean the folder that the tests run in."""
    entries = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(str(Path(entry).resolve()) for entry in entries if entry)


def _take(terminal: int) -> None:
    import fcntl
    import termios

    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)


@pytest.mark.parametrize(
    ("key", "code", "line"),
    [
        (b" ", 1, "by the operator. The drives are off"),
        pytest.param(b"\x1b", 1, "by the operator. The drives are off", marks=pytest.mark.slow),
        pytest.param(b"\x03", 130, "interrupted", marks=pytest.mark.slow),
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


@pytest.mark.slow
def test_other_words_move_nothing(tmp_path: Path) -> None:
    ended = played(tmp_path, ("to go on", b"yes\n", 0.0))
    assert ended.code == 2
    assert "`yes` was typed, not `MOVE served`. Nothing was sent." in " ".join(ended.said.split())
    assert not ended.powered
    assert ended.states == [0x40] * 3
    assert not ended.recording.exists()


# -- every way to end, on simulated drives; the log tells how they ended ----------------------------------------------

TERM, HUP, TSTP = (getattr(signal, name, signal.SIGINT) for name in ("SIGTERM", "SIGHUP", "SIGTSTP"))
LEFT, STOPPED = ("done", {"DISABLED"}, ""), ("stopped", {"DISABLED"}, "operator")
RUN = ("record: sine", 1.0)


@pytest.mark.parametrize(
    ("keys", "code", "how", "line"),
    [
        pytest.param((TERM,), 143, LEFT, "ended by SIGTERM; the drives are off", id="SIGTERM", marks=pytest.mark.slow),
        pytest.param((HUP,), 130, LEFT, "interrupted", id="SIGHUP", marks=pytest.mark.slow),
        pytest.param((b"\x1a",), 130, STOPPED, "interrupted", id="ctrl-z", marks=pytest.mark.slow),
        pytest.param((b"\x03", b"\x03"), 130, STOPPED, "interrupted", id="ctrl-c-twice", marks=pytest.mark.slow),
        pytest.param((TERM, TERM), 143, STOPPED, "ended by SIGTERM", id="SIGTERM-twice", marks=pytest.mark.slow),
        pytest.param((b"\x03", b" "), 130, STOPPED, "interrupted", id="space-while-ramping", marks=pytest.mark.slow),
        pytest.param((TSTP,), 130, STOPPED, "interrupted", id="SIGTSTP", marks=pytest.mark.slow),
    ],
)
def test_every_end_of_a_recording(
    tmp_path: Path, keys: tuple, code: int, how: tuple[str, set[str], str], line: str
) -> None:
    """The second key comes while the motors are on their way to rest."""
    steps = [(RUN[0], keys[0], RUN[1]), *(("", key, 0.15) for key in keys[1:])]
    ended = played(tmp_path, *steps, simulated=True)
    assert ended.code == code, ended.said
    assert line in " ".join(ended.said.split())
    assert ended.how == how
    assert ended.restored
    assert 10 < len(read_recording(ended.recording).time) < 1000


@pytest.mark.parametrize(
    ("key", "code", "how"),
    [pytest.param(b" ", 1, STOPPED, marks=pytest.mark.slow), pytest.param(b"\x1b", 1, STOPPED, marks=pytest.mark.slow),
     pytest.param(b"\x03", 130, LEFT, marks=pytest.mark.slow), pytest.param(TERM, 143, LEFT, marks=pytest.mark.slow)],
    ids=["space", "escape", "ctrl-c", "SIGTERM"],
)  # fmt: skip
def test_every_end_of_a_jog(
    tmp_path: Path, key: bytes | signal.Signals, code: int, how: tuple[str, set[str], str]
) -> None:
    ended = played(
        tmp_path,
        ("jog: motor 1", key, 1.0),
        simulated=True,
        command=("commission", "--only", "jog", "--motor", "1"),
        pace="1",
    )
    assert ended.code == code, ended.said
    assert ended.how == how
    assert ended.restored


@pytest.mark.slow
def test_a_closed_terminal_costs_neither_recording_nor_log(tmp_path: Path) -> None:
    """Nobody is there to read: what is printed goes nowhere, and that must not be what ends the command."""
    ended = played(tmp_path, (RUN[0], CLOSE, RUN[1]), simulated=True)
    assert ended.how == LEFT
    assert 10 < len(read_recording(ended.recording).time) < 1000
    assert ended.code == 130


@pytest.mark.parametrize(
    ("key", "code"),
    [pytest.param(b" ", 1, marks=pytest.mark.slow), pytest.param(b"\x03", 130, marks=pytest.mark.slow),
     pytest.param(TERM, 143, marks=pytest.mark.slow), pytest.param(b"\x1a", 130, marks=pytest.mark.slow),
     pytest.param(HUP, 130, marks=pytest.mark.slow)],
    ids=["space", "ctrl-c", "SIGTERM", "ctrl-z", "SIGHUP"],
)  # fmt: skip
def test_every_end_of_zero_switches_off(tmp_path: Path, key: bytes | signal.Signals, code: int) -> None:
    """On the bus, in real time: one drive after the other gets power, so that the first one says when."""
    ended = played(
        tmp_path, ("to go on", b"MOVE served\n", 0.0), ("ANY POWER", key, 0.2), command=("commission", "--only", "zero")
    )
    said = " ".join(ended.said.split())
    if "by the operator" not in said and any(word in said for word in _STALLS):
        pytest.skip(f"this machine stalled: {said[-200:]}")
    assert ended.code == code, ended.said
    assert all(state in (0x40, 0x08) for state in ended.states)
    assert ended.restored
    assert len(read_run_log(tmp_path / "l.mcap").frames()) > 100
