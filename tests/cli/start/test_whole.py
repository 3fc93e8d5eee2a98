"""A whole run on the log of a neck whose truth is known: all twelve steps, twice."""

from __future__ import annotations

import json
import shlex
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from softneck.cli.start._plan import STAGES
from softneck.core import load
from softneck.identification.selection import _auto

from ...data import neck_recording
from ..conftest import Call

# What `tune` finds with so few judgements need not keep all that is asked.
QUICK = ("--yes", "--kinds", "pi", "--budget", "12", "--json")


def foreign_log() -> None:
    """As another lab's logger writes the synthetic neck: degrees, other titles."""
    neck = neck_recording(1500)
    angles = dict(zip(("pitch", "roll"), np.degrees(neck.outputs.T), strict=True))
    motors = {f"target_motor{j}": np.degrees(neck.set_points[:, j - 1]) for j in (1, 2, 3)}
    pd.DataFrame({"time": neck.time, **motors, **angles}).to_csv("log.csv", index=False)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_log_goes_to_a_verdict_and_the_folder_is_a_project(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_auto, "kinds_to_try", lambda: ("rls", "play"))
    foreign_log()
    said = call("start", "log.csv", "-o", "p", *QUICK)
    assert said.code in (0, 1), said.err
    facts = json.loads(said.out)
    assert tuple(dict.fromkeys(step["stage"] for step in facts["steps"])) == STAGES
    assert facts["holds"] == (said.code == 0) == (not facts["failed"])
    assert set(facts["failed"]) <= {"tune", "verify", "loop", "test"}
    folder = Path("p")
    # Both sorts of model are kept, each with what it was worth on rows that it did not see.
    kinds = {sort: model["kind"] for sort, model in facts["models"].items()}
    assert kinds == {"linear": "rls", "nonlinear": "play"}
    for model in facts["models"].values():
        # The synthetic neck is linear with noise of a thousandth of its motion.
        assert min(model["fit"].values()) > 90.0
        assert load(folder / model["file"], role="model").findings["hold_out"]["rows"] > 0
    for name in ("Plant", "Observer", "Controller"):
        with zipfile.ZipFile(folder / "fmus" / f"{name}.fmu") as archive:
            assert not any(entry.endswith(".py") for entry in archive.namelist())
    test = (folder / "build" / "test.xml").read_text()
    assert ('failures="0"' in test, 'tests="1"' in test) == ("test" not in facts["failed"], True)
    assert (folder / facts["report"]).stat().st_size > 0
    assert (folder / "loop.certificate.json").is_file()
    # Nothing is done twice, the verdict stays, and each command is what a user runs by hand.
    again = json.loads(call("start", "log.csv", "-o", "p", *QUICK).out)
    assert all(step["done_before"] for step in again["steps"])
    assert (again["holds"], again["failed"]) == (facts["holds"], facts["failed"])
    monkeypatch.chdir(folder)
    by_hand = [step["command"] for step in facts["steps"] if step["stage"] in ("robot", "quality", "observer", "loop")]
    for line in by_hand:
        assert call(*shlex.split(line)[1:]).code == (1 if "loop" in facts["failed"] and "simulate" in line else 0), line
