"""What users write against softneck is typed: `py.typed` ships, and mypy finds their mistakes and no other."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from .data import ROOT

GOOD = """
import softneck
from softneck.plant import NeckParameters
from softneck.signals import Recording, signal

recording: Recording = softneck.record(signal("eq22"), softneck.VirtualNeck(NeckParameters.paper()), seed=1)
train, rest = recording.split(0.7)
model = softneck.identify("rls", train, delay=0.08)
free = model.simulate(rest)
error: float = float((free[:, :2] - rest.outputs).std())
names: tuple[str, ...] = free.channels
table = free.to_pandas()
fits: float | None = softneck.validate(model, rest).fits["inf"]["pitch"]
result = softneck.simulate({"duration_s": 3.0, "plant": "paper"})
holds: bool = result.holds
runs = softneck.study("loop.toml", vary={}, workers=0)
path: str = softneck.build_fmu(model.block(), "Neck.fmu").name
found: bool = softneck.verify("pi.npz", {"rls": model}).holds
"""
BAD = """
import softneck

model = softneck.identify("rls", "neck.csv")
model.simulatte("neck.csv")
wrong: int = model.summary()
softneck.build_fmu("Neck.fmu")
"""


def check(script: str, folder: Path) -> list[str]:
    """Return the lines that mypy complains about."""
    tool = Path(sys.executable).with_name("mypy")
    found = str(tool) if tool.exists() else shutil.which("mypy")
    if found is None:
        pytest.skip("mypy is not installed (dependency group `lint`)")
    (folder / "user.py").write_text(script, encoding="utf-8")
    # This tree, whatever is installed; what is wrong inside it is pyright's to say.
    done = subprocess.run(
        [found, "--strict", "--follow-imports=silent", "--python-executable", sys.executable, "user.py"],
        cwd=folder, env={"MYPYPATH": str(ROOT), "PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    return [line for line in done.stdout.splitlines() if "error:" in line]


@pytest.mark.slow
def test_a_script_of_a_user_is_clean_under_strict_mypy_and_its_mistakes_are_found(tmp_path: Path) -> None:
    assert check(GOOD, tmp_path) == []
    complaints = check(BAD, tmp_path)
    # A name that is not there, a path for a recording, a wrong type, a path for a block and no path.
    assert sorted({line.split(":")[1] for line in complaints}) == ["5", "6", "7"]


def test_the_marker_of_typed_packages_ships() -> None:
    assert (ROOT / "softneck" / "py.typed").is_file()
