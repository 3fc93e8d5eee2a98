"""The end of a run: recording, reason, JSON and exit code are there whatever happens before, and nothing is read."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from softneck.cli import main
from softneck.cosim import load_loop
from softneck.drives import default_drives, prepare, read_run_log, run_simulated
from softneck.drives.bus._link import VirtualLink
from softneck.drives.running import _bus_loop
from softneck.signals import read_recording

from .bench import DISABLED
from .conftest import Project

RECORD = ("drives", "record", "aprbs", "--duration", "4", "--simulated", "--json", "-o")


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return int(ended.value.code or 0)


# Pre-flight and enabling take 1.2 s, the ramp to 5.7 s: while enabling, in the ramp, while the controller runs.
@pytest.mark.parametrize("when", [1.25, 3.0, 8.5])
def test_an_error_in_the_loop_switches_the_drives_off_and_keeps_what_was_measured(
    project: Project, when: float
) -> None:
    links = list[VirtualLink]()

    def fails(link: VirtualLink) -> None:
        links[:] = [link]
        if link.now > when:
            raise OSError(5, "a display went away")

    result = run_simulated(prepare(load_loop(project.loop), project.controller), default_drives(), hook=fails)
    assert (result.phase, result.completed) == ("stopped", False)
    assert result.fault is not None
    assert (result.fault.name, result.fault.detail) == ("loop_failed", "OSError: [Errno 5] a display went away")
    # Healthy drives are off, and no guard of theirs had to trip.
    assert [drive.axis.state for drive in links[0].neck.drives] == [DISABLED] * 3
    assert (len(result.signals.time) > 10) == (when > 6.0)
    with pytest.raises(OSError, match="a display went away"):
        result.require()


def test_a_failure_to_disarm_keeps_the_recording_and_ends_with_exit_code_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: Any) -> dict[int, str]:
        raise RuntimeError("no way out")

    monkeypatch.setattr(_bus_loop, "disarm", fails)
    assert run(*RECORD, str(tmp_path / "r.csv")) == 3
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert (found["rows"], found["recording"]) == (200, str(tmp_path / "r.csv"))
    assert (found["fault"]["event"], found["fault"]["node"]) == ("not_off", 1)
    assert len(read_recording(tmp_path / "r.csv")) == 200
    assert "RuntimeError: no way out" in said.err


def _after_the_run(monkeypatch: pytest.MonkeyPatch, act: Callable[[], object]) -> None:
    """Let `act` happen when the drives are switched off."""
    disarm = _bus_loop.disarm

    def wrapper(*arguments: Any) -> dict[int, str]:
        act()
        return disarm(*arguments)

    monkeypatch.setattr(_bus_loop, "disarm", wrapper)


def test_a_recording_whose_folder_is_gone_goes_to_the_folder_of_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    # A file in the place of the folder: no run may make it again.
    _after_the_run(monkeypatch, lambda: (shutil.rmtree(folder), folder.write_text("")))
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path / "logs"))
    assert run(*RECORD, str(folder / "r.csv")) == 2
    said = capsys.readouterr()
    kept = Path(json.loads(said.out)["recording"])
    assert kept.parent == tmp_path / "logs"
    assert len(read_recording(kept)) == 200
    line = said.err.splitlines()[-1]
    assert line.startswith(f"softneck: {folder / 'r.csv'}: cannot be written")
    assert line.endswith(f"The recording is {kept}.")


def test_where_nothing_can_be_written_the_line_names_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, log = tmp_path / "out", tmp_path / "run.mcap"
    folder.mkdir()
    _after_the_run(monkeypatch, lambda: (shutil.rmtree(folder), folder.write_text("")))
    (tmp_path / "logs").write_text("")
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path / "logs"))
    assert run(*RECORD, str(folder / "r.csv"), "--log", str(log)) == 2
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert (found["recording"], found["rows"], found["completed"]) == (None, 200, True)
    assert f"The log has the data: softneck import {log} -o r.csv" in said.err.splitlines()[-1]
    assert run("import", str(log), "-o", str(tmp_path / "again.csv")) == 0
    assert len(read_recording(tmp_path / "again.csv")) == len(read_run_log(log).recording()) == 200


# Run as a script: a hook cannot be removed from a process.
_HOOKED = """
import sys
from pathlib import Path
from softneck.drives.running import _bus_loop
armed, seen = [False], []

def hook(event, arguments):
    if armed[0] and event in ("open", "import"):
        seen.append((event, str(arguments[0])))

start, disarm = _bus_loop.Master.start, _bus_loop.disarm

def begin(master):
    armed[0] = True
    start(master)

def end(*arguments):
    try:
        return disarm(*arguments)
    finally:
        armed[0] = False

_bus_loop.Master.start, _bus_loop.disarm = begin, end
sys.addaudithook(hook)
from softneck.cli._main import run
code = run(sys.argv[1:])
print(code, seen)
"""


@pytest.mark.parametrize("what", ["run", "record"])
def test_between_arming_and_off_nothing_is_opened_or_imported(project: Project, tmp_path: Path, what: str) -> None:
    words = {
        "run": [str(project.controller), "--loop", str(project.loop), "--certificate", str(project.certificate)],
        "record": ["aprbs", "--duration", "4"],
    }[what]
    command = [sys.executable, "-c", _HOOKED, "drives", what, *words, "--simulated", "-o", str(tmp_path / "r.csv")]
    done = subprocess.run(
        [*command, "--log", str(tmp_path / "l.mcap")], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.stdout.splitlines()[-1] == "0 []", done.stdout + done.stderr
