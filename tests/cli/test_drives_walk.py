"""An owner's first day, command by command, on drives whose SDO answers take 50 ms over a wire at 1 Mbit/s."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.cli import main
from softneck.drives.simulated import _drives
from softneck.drives.simulated._habits import WireHabits
from softneck.drives.simulated._wire import Wire
from softneck.signals import read_recording

from ..drives.conftest import Project
from ..drives.conftest import project as project  # the fixture

pytestmark = pytest.mark.slow
SLOW = WireHabits(sdo_latency=0.05, queue=16, bitrate=1e6)


@pytest.fixture
def wires(monkeypatch: pytest.MonkeyPatch) -> list[Wire]:
    """All wires that the simulated drives of a command hang on."""
    made: list[Wire] = []

    def slow(_habits: WireHabits, cycle: float) -> Wire:
        made.append(Wire(SLOW, cycle))
        return made[-1]

    monkeypatch.setattr(_drives, "Wire", slow)
    return made


def test_the_walk_of_an_owner(
    project: Project, wires: list[Wire], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    def step(*words: str) -> dict[str, Any]:
        with pytest.raises(SystemExit) as ended:
            main(["drives", *words, "--json"])
        said = capsys.readouterr()
        assert not ended.value.code, (words, said.err)
        return json.loads(said.out)

    found = step("commission", "--simulated", "-o", "found")
    assert (tmp_path / "found" / "drives.toml").is_file(), found
    drives = ("--drives", str(tmp_path / "found" / "drives.toml"), "--simulated")
    assert [item["node"] for item in step("scan", *drives)["nodes"]] == [1, 2, 3]
    assert step("zero", *drives)["zeroed"]
    step("jog", "1", "--amplitude", "0.3", *drives)
    step("record", "aprbs", "--duration", "4", "-o", "r.csv", "--log", "r.mcap", *drives)
    step("run", str(project.controller), "--loop", str(project.loop), "--certificate", str(project.certificate),
         "--log", "run.mcap", "-o", "run.csv", "--simulated")  # fmt: skip
    for log in ("r.mcap", "run.mcap"):
        assert step("replay", log)["equal"], log
    with pytest.raises(SystemExit) as ended:
        main(["import", "r.mcap", "-o", "again.csv"])
    assert not ended.value.code
    one, again = read_recording("r.csv"), read_recording("again.csv")
    for name, values in one.channels.items():
        np.testing.assert_array_equal(again.channels[name], values, err_msg=name)
    # The wire was there: frames went over it, and none was lost.
    assert len(wires) >= 6
    assert all(wire.bits for wire in wires)
    assert not any(sum(wire.lost.values()) for wire in wires)
