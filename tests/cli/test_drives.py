"""softneck drives: every subcommand on simulated drives, and what it refuses in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from softneck.core import write_certificate
from softneck.cosim import load_loop, simulate
from softneck.design import PiSettings
from softneck.signals import read_recording

from ..drives.certified import write_verified
from .conftest import Call

LOOP = """duration_s = 1.5
[plant]
python = "neck_for_drives_cli:make"
[controller]
file = "pi.npz"
[reference]
kind = "step"
pitch_deg = 5.0
at_s = 0.2
[limits]
"pitch.overshoot_pct" = 30.0
"""
NECK = """from softneck.plant import NeckParameters, VirtualNeck


def make():
    return VirtualNeck(NeckParameters.paper()).block(noise_seed=1)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, models: dict) -> Path:
    folder = tmp_path_factory.mktemp("drives_cli")
    PiSettings().design(models["rls"]).save(folder / "pi.npz")
    (folder / "loop.toml").write_text(LOOP, encoding="utf-8")
    (folder / "neck_for_drives_cli.py").write_text(NECK, encoding="utf-8")
    write_verified(folder / "pi.npz")
    write_certificate(folder / "loop.json", simulate(load_loop(folder / "loop.toml")).certificate())
    return folder


@pytest.mark.slow
def test_scan_check_zero_stop_and_reset_answer_in_json(call: Call) -> None:
    nodes = json.loads(call("drives", "commission", "--only", "scan", "--simulated", "--json").out)["nodes"]
    assert [node["node"] for node in nodes] == [1, 2, 3]
    report = json.loads(call("drives", "check", "--simulated", "--json").out)
    assert report["holds"]
    assert report["guarding"] == "life"
    assert json.loads(call("drives", "commission", "--only", "zero", "--simulated", "--json").out)["zeroed"]
    for name, key in (("stop", "stopped"), ("reset", "reset")):
        states = json.loads(call("drives", name, "--simulated", "--json").out)[key]
        assert [item["state"] for item in states] == ["DISABLED"] * 3


def test_tables_for_people(call: Call) -> None:
    for words in (
        ("commission", "--only", "scan"),
        ("check",),
        ("commission", "--only", "zero"),
        ("stop",),
        ("reset",),
    ):
        said = call("drives", *words, "--simulated")
        assert said.code == 0
        assert "3" in said.out


def test_run_writes_a_recording(call: Call, files: Path) -> None:
    run = ("drives", "run", files / "pi.npz", "--loop", files / "loop.toml", "--simulated")
    said = call(*run, "--certificate", files / "loop.json", "-o", "run.csv", "--json")
    assert said.code == 0, said.err
    result = json.loads(said.out)
    assert result["completed"]
    assert result["simulated"]
    assert len(read_recording("run.csv").time) == 75
    assert call(*run, "--certificate", files / "loop.json", "-o", "run.csv").error.startswith(
        "softneck: run.csv: exists"
    )
    assert call(*run, "--override", "certificate").code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("check",), "say which drives: --bus INTERFACE:CHANNEL or --simulated"),
        (("check", "--bus", "virtual:x"), "drives on a bus need --drives DRIVES.toml"),
        (("check", "--simulated", "--override", "luck"), "'luck' is not one of 'certificate', 'identity'"),
        (("check", "--simulated", "--drives", "none.toml"), "none.toml: no such file"),
        (("commission", "--only", "zero", "--bus", "virtual:x", "--drives", "{example}"),
         "say --arm if they may. Nothing was sent"),
        (("commission", "--only", "scan", "--bus", "socketcan:can_that_is_not"),
         "bus socketcan:can_that_is_not cannot be opened"),
        (("run", "{pi}", "--loop", "{loop}", "--simulated"), "loop.toml: has no certificate of `softneck simulate`"),
        (("run", "none.npz", "--loop", "{loop}", "--simulated"), "none.npz: no such file"),
        (("run", "{pi}", "--loop", "none.toml", "--simulated"), "none.toml"),
        (("run", "{pi}", "--loop", "{loop}", "--bus", "virtual:x", "--drives", "{example}", "--override",
          "certificate"), "say --arm"),
    ],
)  # fmt: skip
def test_bad_input(call: Call, files: Path, arguments: tuple[str, ...], message: str) -> None:
    from ..data import ROOT

    names = {
        "{pi}": files / "pi.npz",
        "{loop}": files / "loop.toml",
        "{example}": ROOT / "examples" / "drives" / "drives.toml",
    }
    said = call("drives", *(names.get(argument, argument) for argument in arguments))
    assert said.code in (1, 2)
    assert message in said.error
    assert said.out == ""
