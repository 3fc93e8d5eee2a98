"""softneck import and resample as users call them: questions, previews, one line for no log, all files or none."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from softneck.cli import _import
from softneck.signals import read_recording, write_recording

from ..data import ROOT, neck_recording
from ..signals import log_writers as write
from ..signals.test_doubts import log
from ..signals.test_formats import columns
from .conftest import Call


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*") if path.is_file()}


def test_a_doubt_is_marked_where_nobody_can_be_asked(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=12.0, platform=25.0, positions=False)
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--json")
    # Taken as rad, twice the range: refused with the fix, and the doubt stands in the file.
    assert (said.code, said.out) == (2, "")
    assert re.search(r"reaches \d+\.\d+ rad, (which is 2 turns|more than a turn); the motors' range is 6 rad", said.err)
    assert 'degrees (`unit = "deg"`)' in said.err
    assert "NOT SURE (" in (tmp_path / "r.layout.toml").read_text()
    assert files(tmp_path) == {"log.csv", "r.layout.toml"}


def test_in_a_terminal_a_doubt_is_asked(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log(tmp_path, motors=12.0, platform=25.0, positions=False)
    monkeypatch.setattr("softneck.cli._import.is_terminal", lambda: True)
    asked: list[str] = []

    def answer(text: str, **_more: object) -> str:
        asked.append(text)
        return "deg"

    monkeypatch.setattr(_import.click, "prompt", answer)
    said = call("import", "log.csv", "--guess", "-o", "r.csv")
    assert said.code == 0, said.err
    assert asked == ["unit of motor set-points"]
    assert np.abs(read_recording("r.csv").set_points).max() == pytest.approx(np.radians(12.0))
    assert "as you answered" in (tmp_path / "r.layout.toml").read_text()
    again = call("import", "log.csv", "--layout", "r.layout.toml", "-o", "again.csv")
    assert (again.code, (tmp_path / "again.csv").read_bytes()) == (0, (tmp_path / "r.csv").read_bytes())
    # All taken: as without a terminal.
    assert call("import", "log.csv", "--guess", "--yes", "-o", "taken.csv").code == 2
    assert len(asked) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "code", "left"), [(b"deg\n", 0, {"r.csv", "r.layout.toml"}), (None, 130, set())])
def test_in_a_real_terminal(tmp_path: Path, answer: bytes | None, code: int, left: set[str]) -> None:
    log(tmp_path, motors=12.0, platform=25.0)
    command = [
        sys.executable,
        "-c",
        "from softneck.cli import main; main()",
        "import",
        "log.csv",
        "--guess",
        "-o",
        "r.csv",
    ]
    ours, theirs = pty.openpty()
    child = subprocess.Popen(
        command, cwd=tmp_path, stdin=theirs, stdout=theirs, stderr=theirs, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    os.close(theirs)
    said, asked = b"", False
    with contextlib.suppress(OSError):  # the terminal is gone when the command is
        while part := os.read(ours, 4096):
            said += part
            if b"[rad]: " in said and not asked:
                asked = True
                if answer is None:
                    child.send_signal(signal.SIGINT)
                    # One that comes before the command reads is noted, and the read waits: a person presses it again.
                    while not select.select([ours], [], [], 1.0)[0]:
                        child.send_signal(signal.SIGINT)
                else:
                    os.write(ours, answer)
    os.close(ours)
    assert (child.wait(60), asked) == (code, True), said
    assert files(tmp_path) == {"log.csv", *left}


def test_columns_that_are_said_to_be_wrong_import_nothing(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = {name: c for name, c in columns().items() if name[0] != "s"}
    pd.DataFrame(table).rename(columns={f"x{j}": f"encoder{j}" for j in (1, 2, 3)}).to_csv("log.csv", index=False)
    monkeypatch.setattr("softneck.cli._import.is_terminal", lambda: True)
    monkeypatch.setattr(_import.click, "confirm", lambda *_args, **_more: False)
    said = call("import", "log.csv", "--guess", "-o", "r.csv")
    assert said.code == 2
    assert "motor set-points: column 'encoder1'" in said.err.splitlines()[-1]
    assert files(tmp_path) == {"log.csv"}


@pytest.mark.parametrize("right", [True, False])
def test_in_a_terminal_what_is_not_sure_of_another_robot_is_asked(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, right: bool
) -> None:
    time = 0.02 * np.arange(400.0)
    pd.DataFrame({"time [s]": time, "p_cmd [%]": np.sin(time), "tip [mm]": np.cos(time)}).to_csv("log.csv", index=False)
    monkeypatch.setattr("softneck.cli._import.is_terminal", lambda: True)
    asked: list[str] = []
    monkeypatch.setattr(_import.click, "confirm", lambda text, **_: asked.append(text) or right)
    said = call("import", "log.csv", "--guess", "-o", "r.csv")
    assert asked[0] == "robot: p_cmd [%] move, tip [mm] are outputs (80 % sure): by titles. Is that right?"
    if right:
        assert (said.code, len(asked)) == (0, 2)  # the unit `%` too
        assert "NOT SURE" not in (tmp_path / "r.layout.toml").read_text()
    else:
        assert (said.code, files(tmp_path)) == (2, {"log.csv"})
        assert "was said to be wrong. Name the right columns, with units in their titles: `softneck" in said.err


def test_a_preview_shows_doubts_first_and_what_was_made(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    frame = pd.read_csv("log.csv")
    frame["roll"] *= -1.0
    frame.assign(fan=1.0).to_csv("log.csv", index=False)
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--html", "p.html", "--json")
    facts = json.loads(said.out)
    assert facts["html"] == "p.html"
    (doubt,) = facts["doubts"]
    assert (doubt["about"], doubt["channels"], doubt["choices"]) == ("sign of roll", ["roll"], ["as logged"])
    assert 0.0 < doubt["confidence"] < 0.9
    page = (tmp_path / "p.html").read_text()
    order = [page.index(word) for word in ("<h2>Doubts", "sign of roll", "<h2>Mapping", "<h2>Raw columns and channels",
                                           "<h2>Left out", "column &#39;fan&#39;")]  # fmt: skip
    assert order == sorted(order)
    by_layout = call("import", "log.csv", "--layout", "r.layout.toml", "-o", "s.csv", "--html", "q.html")
    assert by_layout.code == 0
    # A layout leaves nothing to doubt, and the page has no section of doubts.
    assert "Doubts" not in (tmp_path / "q.html").read_text()
    kept = call("import", "log.csv", "--layout", "r.layout.toml", "-o", "t.csv", "--html", "q.html")
    assert "q.html: exists already" in kept.error
    assert not (tmp_path / "t.csv").exists()


def test_a_preview_of_what_lacks_something_says_what(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    pd.read_csv("log.csv").drop(columns="time").to_csv("log.csv", index=False)
    assert call("import", "log.csv", "--guess", "-o", "r.csv", "--html", "p.html").code == 2
    page = (tmp_path / "p.html").read_text()
    # Once: the verdict asks for it, and nothing repeats it.
    assert "No recording: the sample time" in page
    assert page.count("no column rises by equal steps") == 1
    frame = pd.read_csv("log.csv")
    rows = re.findall(r'<td class="text"[^>]*>(\w+)</td>' + 4 * r"<td[^>]*>([^<]*)</td>", page)
    assert [row[0] for row in rows] == list(frame.columns)
    for title, unit, least, largest, taken in rows:
        assert (least, largest) == (f"{frame[title].min():.4g}", f"{frame[title].max():.4g}")
        assert (unit == "-") == (taken == "not recognised")
    assert {row[0]: row[4] for row in rows}["roll"] == "roll"
    assert files(tmp_path) == {"log.csv", "p.html", "r.layout.toml"}


def test_one_axis_comes_with_its_robot(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    pd.read_csv("log.csv").drop(columns="roll").to_csv("log.csv", index=False)
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--json")
    assert json.loads(said.out)["robot_file"] == "r.robot.toml"
    assert read_recording("r.csv").robot.outputs.names == ("pitch",)
    again = call("import", "log.csv", "--layout", "r.layout.toml", "--robot", "r.robot.toml", "-o", "again.csv")
    assert again.code == 0, again.err
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "r.csv").read_bytes()


def test_a_bag_is_a_log_to_info_and_import(call: Call, tmp_path: Path) -> None:
    write.write_mcap(tmp_path / "bag.mcap", columns())
    assert json.loads(call("info", "bag.mcap", "--json").out)["type"] == "log"
    assert call("import", "bag.mcap", "--guess", "-o", "r.csv").code == 0
    assert len(read_recording("r.csv")) == 400
    said = call("import", "bag.mcap", "-o", "s.csv")
    assert (said.code, "not a log of `softneck drives`" in said.error) == (2, True)


NO_LOGS = {
    "picture.csv": (
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(400),
        "is a PNG picture, not a log; export the log as CSV",
    ),
    "photo.xlsx": (b"\xff\xd8\xff\xe0\0\x10JFIF" + bytes(400), "is a JPEG picture, not a log"),
    "empty.csv": (b"", "cannot be read as a table (it is empty)"),
    "blank.mcap": (b" \n \n", "it is empty"),
    "archive.xlsx": (b"PK\x03\x04" + bytes(400), "is a ZIP archive that holds no spreadsheet"),
    "packed.csv": (b"\x1f\x8b" + bytes(400), "is compressed by gzip, not a log; unpack it with gunzip"),
    "bag.db3": (b"SQLite format 3\0" + bytes(400), "becomes MCAP by `ros2 bag convert`"),
    "old.bag": (b"#ROSBAG V2.0\n" + bytes(400), "is a bag of ROS 1"),
    "noise.csv": (bytes(range(256)) * 4, "is not a text"),
    "cut.mcap": (b"\x89MCAP0\r\n" + bytes(100), "cannot be read as MCAP"),
}


@pytest.mark.parametrize("name", NO_LOGS)
def test_what_is_no_log_is_one_line(call: Call, tmp_path: Path, name: str) -> None:
    content, message = NO_LOGS[name]
    (tmp_path / name).write_bytes(content)
    said = call("import", name, "--guess", "-o", "r.csv", "--html", "p.html", "--json")
    assert (said.code, said.out) == (2, "")
    assert message in said.error
    assert said.error.startswith(f"softneck: {name}: ")
    assert files(tmp_path) == {name}


def test_a_folder_names_the_file_in_it(call: Call, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    assert "bag: is a folder; name a file in it." in call("import", "bag", "--guess", "-o", "r.csv").error
    assert "bag: is a folder; name a file in it." in call("info", "bag").error
    (tmp_path / "bag" / "bag_0.mcap").write_bytes(b"")
    assert "such as bag/bag_0.mcap" in call("import", "bag", "--guess", "-o", "r.csv").error


@pytest.mark.parametrize("full", ["recording", "layout", "page"])
def test_a_full_disk_leaves_nothing(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: str) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    real = Path.write_text

    def write_text(path: Path, text: str, **more: str) -> int:
        said = "<!doctype" in text if full == "page" else "[channels]" in text
        if said and full != "recording":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, text, **more)

    def no_space(*_args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", write_text)
    if full == "recording":
        monkeypatch.setattr("softneck.signals.recording._files._write_csv", no_space)
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--html", "p.html")
    assert said.code == 2
    name = {"recording": ".csv", "layout": "r.layout.toml", "page": "p.html"}[full]
    assert name in said.err.splitlines()[-1]
    assert "No space left on device. Nothing was left behind" in said.err.splitlines()[-1]
    assert files(tmp_path) == {"log.csv"}


def test_ctrl_c_leaves_nothing(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log(tmp_path, motors=3.0, platform=20.0)

    def stop(*_args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("softneck.signals.recording._files._write_csv", stop)
    said = call("import", "log.csv", "--guess", "-o", "r.csv", "--html", "p.html")
    assert (said.code, said.err.splitlines()[-1].startswith("softneck: interrupted")) == (130, True)
    assert files(tmp_path) == {"log.csv"}


def test_a_folder_that_cannot_be_written(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    (tmp_path / "file").write_text("")
    said = call("import", "log.csv", "--guess", "-o", "file/r.csv")
    assert (said.code, "cannot be written" in said.err.splitlines()[-1]) == (2, True)
    assert files(tmp_path) == {"log.csv", "file"}


def test_import_resamples_where_asked(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    assert call("import", "log.csv", "--guess", "-o", "plain.csv").code == 0
    said = json.loads(call("import", "log.csv", "--guess", "--resample", "0.05", "-o", "slow.csv", "--json").out)
    assert said["sample_time_s"] == 0.05
    assert "resampled from 20 to 50 ms" in said["notes"]
    assert call("import", "log.csv", "--guess", "--resample", "robot", "-o", "robot.csv").code == 0
    assert (tmp_path / "robot.csv").read_bytes() == (tmp_path / "plain.csv").read_bytes()
    for wrong in ("0", "-1", "fast", "true", "inf"):
        assert "--resample takes a sample time" in call(
            "import", "log.csv", "--guess", "--resample", wrong, "-o", "w.csv").err.splitlines()[-1]  # fmt: skip
    assert not (tmp_path / "w.csv").exists()


def test_resample_brings_a_recording_to_another_sample_time(call: Call, tmp_path: Path) -> None:
    write_recording("a.csv", neck_recording(400))
    said = json.loads(call("import", "a.csv", "--resample", "0.05", "-o", "b.csv", "--json").out)
    facts = {"recording": "b.csv", "rows": 160, "runs": 1, "sample_time_s": 0.05, "sample_time_before_s": 0.02}
    assert {name: said[name] for name in facts} == facts
    assert call("import", "a.csv", "--resample", "0.02", "-o", "same.csv").code == 0
    assert (tmp_path / "same.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    assert call("import", "b.csv", "--resample", "robot", "-o", "c.csv").code == 0
    assert read_recording("c.csv").sample_time == 0.02
    assert "b.csv: exists already" in call("import", "a.csv", "--resample", "0.1", "-o", "b.csv").error
    assert (
        "--resample takes a sample time in seconds" in call("import", "a.csv", "--resample", "0", "-o", "d.csv").error
    )
    assert "none.csv: no such file" in call("import", "none.csv", "--resample", "1", "-o", "d.csv").error
    assert not (tmp_path / "d.csv").exists()


def test_a_log_that_its_layout_cannot_import_leaves_a_page_with_the_reason(call: Call, tmp_path: Path) -> None:
    log(tmp_path, motors=3.0, platform=20.0)
    frame = pd.read_csv("log.csv")
    frame.loc[5:40, "roll"] = -999.0
    frame.to_csv("log.csv", index=False)
    said = call("import", "log.csv", "--guess", "--yes", "-o", "r.csv", "--html", "p.html")
    assert said.code == 2
    page = (tmp_path / "p.html").read_text()
    assert "No recording: " in page
    assert "mark missed samples" in page
    assert "<h2>Columns of the log" in page
    assert files(tmp_path) == {"log.csv", "p.html", "r.layout.toml"}
