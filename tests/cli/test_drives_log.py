"""softneck drives run --log, replay, info and import of what it leaves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.cli import main
from softneck.cli.drives._closing import log_folder
from softneck.cli.drives._target import Target, opened_log
from softneck.core import CheckFailedError, OutputFileError
from softneck.drives import default_drives, read_run_log
from softneck.drives.logs._run_log import run_facts
from softneck.signals import read_recording

from ..drives.conftest import Project
from ..drives.conftest import project as project  # the fixture


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def folder(project: Project, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    logs = ["--log", str(folder / "run.mcap")]
    code = run("drives", "run", str(project.controller), "--loop", str(project.loop), "--certificate",
               str(project.certificate), "--simulated", *logs, "-o", str(folder / "run.csv"), "--json")  # fmt: skip
    assert code == 0
    return folder


def test_a_run_replays_and_imports(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("simulate", str(folder / "run.mcap"), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["equal"]
    assert result["controller_answers"] == 200
    assert run("import", str(folder / "run.mcap"), "-o", str(folder / "again.csv")) == 0
    first, again = read_recording(folder / "run.csv"), read_recording(folder / "again.csv")
    for name, values in first.channels.items():
        np.testing.assert_array_equal(again.channels[name], values)


def test_info_tells_what_a_log_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", str(folder / "run.mcap"), "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["type"].startswith("log of")
    assert facts["nodes"] == "1, 2, 3"
    assert (facts["first_error"], facts["cut"]) == ("none", "no")
    assert facts["frames"] > 1000


def test_changed_files_are_told_and_a_difference_exits_with_1(
    folder: Path, project: Project, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = project.loop.read_text()
    project.loop.write_text(text.replace("at_s = ", "at_s = 1"))
    try:
        assert run("simulate", str(folder / "run.mcap")) == 1
    finally:
        project.loop.write_text(text)
    err = capsys.readouterr().err.replace("\n", " ")
    assert "the replay differs from the log at cycle" in err
    cut = tmp_path / "cut.mcap"
    content = (folder / "run.mcap").read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    assert run("simulate", str(cut)) == 0
    assert "replayed up to the cut" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(
    "words",
    [
        ("commission", "--only", "jog", "--motor", "1", "--travel", "0.3"),
        ("record", "aprbs", "--duration", "4", "-o", "r.csv"),
    ],
    ids=["jog", "record"],
)
def test_jog_and_record_replay_and_import(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    logs = ("--log", "l.mcap")
    assert run("drives", *words, "--simulated", *logs, "--json") == 0
    capsys.readouterr()
    assert run("simulate", "l.mcap", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["equal"]
    assert result["controller_answers"] > 100
    assert result["notes"] == []
    assert run("import", "l.mcap", "-o", "again.csv") == 0
    if words[0] == "record":
        assert (tmp_path / "again.csv").read_text() == (tmp_path / "r.csv").read_text()
    assert run("drives", *words, "--simulated", "--log", "l.mcap") == 2
    (tmp_path / "r.csv").unlink(missing_ok=True)
    assert run("drives", *words, "--simulated", "--log", "m.txt") == 2
    lines = capsys.readouterr().err.splitlines()
    assert "exists already" in lines[0]
    assert "a log ends in" in lines[1]


def test_zero_logs_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", "commission", "--only", "zero", "--simulated", "--log", str(tmp_path / "z.mcap")) == 0
    capsys.readouterr()
    assert run("info", str(tmp_path / "z.mcap"), "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["nodes"], facts["cut"]) == ("1, 2, 3", "no")
    # Each tendon is pulled for some tenths of a second and asked for its state every 20 ms.
    assert facts["frames"] > 100
    assert run("simulate", str(tmp_path / "z.mcap")) == 2
    assert "holds no cycle of the master; there is nothing to replay" in capsys.readouterr().err


# -- what nobody asked for, where drives may be real ------------------------------------------------------------------


REAL = Target(default_drives(), "socketcan:can0", False, True)


@pytest.fixture
def folder_of_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LOGS_DIRECTORY", f"{tmp_path / 'logs'}:/elsewhere")
    return tmp_path / "logs"


def test_a_bus_that_may_move_something_is_logged_unasked(
    folder_of_logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in (1, 2):
        with opened_log(REAL, "run", None, force=False) as log:
            assert log is not None
            log.describe(run_facts(default_drives().master_settings(0.02), {}, simulated=False))
        kept = sorted(folder_of_logs.glob("run_*Z*.mcap"))
        assert len(kept) == number
        assert f"log: {log.path}" in capsys.readouterr().err.replace("\n", "")
        assert read_run_log(log.path).facts["simulated"] is False


def test_what_ends_it_is_told_and_its_log_is_kept(folder_of_logs: Path) -> None:
    def interrupted() -> None:
        with opened_log(REAL, "zero", None, force=False) as log:
            assert log is not None
            log.describe({"files": {}})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(list(folder_of_logs.glob("zero_*.mcap"))) == 1
    # Nothing moved before the first cycle: a log that nobody asked for and that says nothing is removed.
    with pytest.raises(CheckFailedError, match="node 1"), opened_log(REAL, "run", None, force=False):
        raise CheckFailedError("node 1: homed: no.")
    assert list(folder_of_logs.glob("run_*")) == []


@pytest.mark.parametrize(
    ("chosen", "no_log"),
    [(REAL, True), (replace(REAL, bus="udp_multicast:239.74.163.2"), False), (replace(REAL, bus="virtual:x"), False),
     (replace(REAL, bus=None, simulated=True), False)],
    ids=["no-log", "udp", "virtual", "simulated"],
)  # fmt: skip
def test_elsewhere_nothing_is_logged_unasked(folder_of_logs: Path, chosen: Target, no_log: bool) -> None:
    with opened_log(chosen, "run", "none" if no_log else None, force=False) as log:
        assert log is None
    assert not folder_of_logs.exists()


def test_a_folder_that_cannot_be_written_is_one_line_before_anything_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path / "file"))
    with (
        pytest.raises(OutputFileError, match=r"cannot be written.*Or --log none\. Nothing was sent\."),
        opened_log(REAL, "run", None, force=False),
    ):
        pass
    monkeypatch.delenv("LOGS_DIRECTORY")
    assert "softneck" in log_folder().parts
