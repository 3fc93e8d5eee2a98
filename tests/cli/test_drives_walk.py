"""An owner's first day, command by command, on drives whose SDO answers take 50 ms.

Once they are obliging else, and once for each order of start-up with every other quirk that they may have.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.cli import main
from softneck.drives.running import _virtual
from softneck.drives.simulated import SimulatedSettings
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.signals import read_recording

from ..drives.conftest import Project
from ..drives.conftest import project as project  # the fixture

pytestmark = pytest.mark.slow
SLOW = DriveQuirks(sdo_latency=0.05)
STRICT = replace(SLOW, write_only=True, lacks=(0x1003, 0x1005, 0x1014, 0x1200))


@pytest.fixture(params=["slow", "off", "enabled"])
def strict(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[DriveQuirks]:
    """The quirks of all simulated drives of a command, as they asked for them."""
    made: list[DriveQuirks] = []
    quirks = SLOW if request.param == "slow" else replace(STRICT, mode_when=request.param)

    def asked(**how: Any) -> SimulatedSettings:
        made.append(quirks)
        return SimulatedSettings(**{**how, "quirks": quirks})

    monkeypatch.setattr(_virtual, "SimulatedSettings", asked)
    return made


def test_the_walk_of_an_owner(
    project: Project, strict: list[DriveQuirks], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    def step(*words: str) -> dict[str, Any]:
        with pytest.raises(SystemExit) as ended:
            main([*words, "--json"] if words[0] == "simulate" else ["drives", *words, "--json"])
        said = capsys.readouterr()
        assert not ended.value.code, (words, said.err)
        return json.loads(said.out)

    found = step("commission", "--simulated", "-o", "found")
    assert (tmp_path / "found" / "drives.toml").is_file(), found
    drives = ("--drives", str(tmp_path / "found" / "drives.toml"), "--simulated")
    assert [item["node"] for item in step("commission", "--only", "scan", *drives)["nodes"]] == [1, 2, 3]
    assert step("commission", "--only", "zero", *drives)["zeroed"]
    step("commission", "--only", "jog", "--motor", "1", "--travel", "0.3", *drives)
    step("record", "aprbs", "--duration", "4", "-o", "r.csv", "--log", "r.mcap", *drives)
    step("run", str(project.controller), "--loop", str(project.loop), "--certificate", str(project.certificate),
         "--log", "run.mcap", "-o", "run.csv", "--simulated")  # fmt: skip
    for log in ("r.mcap", "run.mcap"):
        assert step("simulate", log)["equal"], log
    with pytest.raises(SystemExit) as ended:
        main(["import", "r.mcap", "-o", "again.csv"])
    assert not ended.value.code
    one, again = read_recording("r.csv"), read_recording("again.csv")
    for name, values in one.channels.items():
        np.testing.assert_array_equal(again.channels[name], values, err_msg=name)
    # Each command had such drives.
    assert len(strict) >= 6
