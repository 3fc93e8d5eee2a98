"""softneck drives jog and record, and what lets drives move."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from softneck.cli.drives._target import require_armed, words
from softneck.core import DataError, SettingsError, SoftneckError
from softneck.drives import baseline, default_drives
from softneck.drives.supervision._baseline import load_baseline
from softneck.drives.supervision._motor_models import Motion
from softneck.signals import read_recording

from ..data import ROOT
from .conftest import Call

EXAMPLE = ROOT / "examples" / "drives" / "drives.toml"


def test_jog_says_what_it_expected_and_saw(call: Call) -> None:
    said = call("drives", "commission", "--only", "jog", "--motor", "2", "--simulated", "--json")
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert (found["motor"], found["verdict"], found["holds"], found["phase"]) == (2, "ok", True, "done")
    assert found["expected"]["direction_deg"] == pytest.approx(120.0)
    assert "direction_deg" in call("drives", "commission", "--only", "jog", "--motor", "1", "--simulated").out


def test_record_is_a_recording_for_identify(call: Call) -> None:
    said = call("drives", "record", "aprbs", "--duration", "12", "--simulated", "-o", "r.csv", "--json")
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert found["completed"]
    assert found["rows"] == len(read_recording("r.csv")) == 600
    assert call("identify", "rls", "r.csv", "-o", "m.npz").code == 0
    assert "r.csv: exists" in call("drives", "record", "sine", "--simulated", "-o", "r.csv").error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("commission", "--only", "jog", "--motor", "4", "--simulated"), "4 is not in the range"),
        (("commission", "--only", "jog", "--motor", "1"), "say which drives"),
        (("commission", "--only", "jog", "--motor", "1", "--simulated", "--travel", "9"), "--travel"),
        (("commission", "--only", "jog", "--motor", "1", "--simulated", "--pace", "-1"), "--pace"),
        (
            ("commission", "--only", "jog", "--motor", "1", "--bus", "virtual:x", "--drives", EXAMPLE),
            "say --arm if they may. Nothing was sent",
        ),
        (
            ("commission", "--only", "jog", "--motor", "1", "--bus", "virtual:x", "--drives", EXAMPLE, "--pace", "2"),
            "--pace is for --simulated",
        ),
        (
            ("commission", "--only", "jog", "--motor", "1", "--bus", "socketcan:can_no", "--drives", EXAMPLE, "--arm"),
            "stdin is not one",
        ),
        (("record", "music", "--simulated", "-o", "r.csv"), "`signal` must be one of"),
        (("record", "sine", "--simulated", "-o", "r.txt"), "r.txt"),
        (("record", "sine", "--simulated", "-o", "r.csv", "--max-position", "7"), "beyond the 6 rad of [limits]"),
        (("record", "sine", "--simulated", "-o", "r.csv", "--payload", "9"), "--payload"),
    ],
)
def test_bad_input(call: Call, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...], message: str) -> None:
    monkeypatch.setattr("sys.stdin", None)
    said = call("drives", *arguments)
    assert said.code == 2
    assert message in said.error
    assert said.out == ""


def test_a_service_says_the_same_words(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert words("socketcan:can0") == "MOVE can0"
    monkeypatch.setattr("sys.stdin", None)
    monkeypatch.setenv("SOFTNECK_ARM", "MOVE can1")
    with pytest.raises(SettingsError, match=r"SOFTNECK_ARM is `MOVE can1`; for socketcan:can0 it must be `MOVE can0`"):
        require_armed("socketcan:can0", arm=True)
    monkeypatch.setenv("SOFTNECK_ARM", "MOVE can0")
    with pytest.raises(SettingsError, match="say --arm"):
        require_armed("socketcan:can0", arm=False)
    require_armed("socketcan:can0", arm=True)
    assert "nobody was asked" in capsys.readouterr().err


@pytest.mark.slow
def test_a_baseline_is_of_all_logs(call: Call) -> None:
    """Two payloads: what the supervisor compares with is of both, and is the same whenever it is asked for."""
    record = ("drives", "record", "aprbs", "--simulated", "--duration", 25, "--max-position", 1.5)
    assert call(*record, "-o", "a.csv", "--log", "a.mcap").code == 0
    assert call(*record, "-o", "b.csv", "--log", "b.mcap", "--payload", 0.5).code == 0
    baseline(["a.mcap", "b.mcap"]).save("b.json")
    told = load_baseline("b.json")
    assert told == baseline(["a.mcap", "b.mcap"])
    # Each run of 25 s, and a moment before and after it.
    assert 50.0 < told.seconds < 56.0
    with pytest.raises(DataError, match="too few to compare with"):
        baseline(["a.mcap"])


def test_a_baseline_of_no_log_or_of_a_minute_of_a_loop_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingsError, match="no log was given"):
        baseline([])
    with pytest.raises(SoftneckError, match=r"a\.mcap"):
        baseline(["a.mcap"])
    rows = np.zeros((6000, 3))
    loop = Motion(setpoints=rows, positions=rows, tensions=rows, values=rows[:, :2], rates=rows[:, :2],
                  due=np.ones(6000, dtype=bool), references=rows[:, :2])  # fmt: skip
    run = SimpleNamespace(settings=lambda: default_drives().master_settings(0.02))
    monkeypatch.setattr("softneck.drives.logs._replay.read_run_log", lambda _: run)
    monkeypatch.setattr("softneck.drives.logs._replay.logged_motion", lambda *_: loop)
    with pytest.raises(DataError, match="60 s of a loop's motion"):
        baseline(["run.mcap"])
