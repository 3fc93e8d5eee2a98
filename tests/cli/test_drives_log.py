"""softneck drives run --log, replay, info and import of what it leaves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.cli import main
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
    logs = [word for end in ("mcap", "blf", "log") for word in ("--log", str(folder / f"run.{end}"))]
    code = run("drives", "run", str(project.controller), "--loop", str(project.loop), "--certificate",
               str(project.certificate), "--simulated", *logs, "-o", str(folder / "run.csv"), "--json")  # fmt: skip
    assert code == 0
    return folder


def test_a_run_replays_and_imports(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", "replay", str(folder / "run.mcap"), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["equal"]
    assert result["controller_answers"] == 200
    assert run("import", str(folder / "run.mcap"), "-o", str(folder / "again.csv")) == 0
    first, again = read_recording(folder / "run.csv"), read_recording(folder / "again.csv")
    for name, values in first.channels.items():
        np.testing.assert_array_equal(again.channels[name], values)


@pytest.mark.parametrize("ending", ["mcap", "blf", "log"])
def test_info_tells_what_a_log_is(folder: Path, ending: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", str(folder / f"run.{ending}"), "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["type"].startswith("log of")
    assert facts["nodes"] == "1, 2, 3"
    assert (facts["first_error"], facts["cut"]) == ("none", "no")
    assert facts["frames"] > 1000


def test_a_log_of_frames_cannot_be_replayed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", "replay", str(folder / "run.blf")) == 2
    assert "holds frames only; replay needs the `.mcap`" in capsys.readouterr().err


def test_changed_files_are_told_and_a_difference_exits_with_1(
    folder: Path, project: Project, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = project.write_loop("softer.toml", 'kind = "step"\npitch_deg = 14.0\nat_s = 1.0', 4.0)
    assert run("drives", "replay", str(folder / "run.mcap"), "--loop", str(other)) == 1
    err = capsys.readouterr().err.replace("\n", " ")
    assert "the replay differs from the log at cycle" in err
    cut = tmp_path / "cut.mcap"
    content = (folder / "run.mcap").read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    assert run("drives", "replay", str(cut)) == 0
    assert "replayed up to the cut" in capsys.readouterr().err.replace("\n", " ")
