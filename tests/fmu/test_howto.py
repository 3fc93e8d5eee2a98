"""The commands and scripts of the page on other tools work as they are printed there."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softneck.fmu import build_compiled_fmu, build_fmu

from .every_kind import block_of
from .test_importers import need

PAGES = Path(__file__).parents[2] / "docs" / "howto"
PAGE = "fmu_in_tools.md"


def _parts(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (PAGES / page).read_text(encoding="utf-8"), re.DOTALL)


def _run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    # An embedded Python may abort at the end of its process; what the script printed is there by then.
    assert done.stdout or done.returncode == 0, done.stderr[-2000:]
    assert "Traceback" not in done.stderr, done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("howto")
    build_fmu(block_of("rls"), place / "Neck.fmu")
    return place


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as the pages of other simulators want it: nothing there needs Python."""
    place = tmp_path_factory.mktemp("elsewhere")
    build_compiled_fmu(block_of("rls"), place / "Neck.fmu")
    return place


def test_fmpy_s_commands_run(folder: Path) -> None:
    lines = [line.removeprefix("$ ") for part in _parts(PAGE, "console") for line in part.splitlines()]
    # Those before make the FMU; `make documents` runs them.
    commands = [line for line in lines if line.startswith("python -m fmpy")]
    assert len(commands) == 3
    for command in commands:
        _run([sys.executable, *shlex.split(command)[1:]], folder)
    assert (folder / "neck.csv").read_text().startswith('"time"')


@pytest.mark.parametrize(("place", "package"), [("folder", "fmpy"), ("elsewhere", "fmpy"), ("elsewhere", "libcosimpy")])
def test_the_scripts_compute_the_same_pitch(place: str, package: str, request: pytest.FixtureRequest) -> None:
    need(package)
    (script,) = [part for part in _parts(PAGE, "python") if f"from {package}" in part]
    printed = _run([sys.executable, "-c", script], request.getfixturevalue(place))
    block = block_of("rls")
    steps = 175 if package == "fmpy" else 200  # 2 rad for 3.5 s, and for 4 s
    u = [[2.0, 0.0, 0.0, *[float("nan")] * 5]] * steps
    _, y = block.run(block.initial_state(), np.array(u))
    numbers = [line for line in printed.splitlines() if re.fullmatch(r"[\[\](), \d.e+-]+", line)]  # not the log
    value = float(re.findall(r"-?\d+\.\d+(?:e-?\d+)?", numbers[-1])[0])
    wanted = np.degrees(y[-1, 0]) if package == "fmpy" else y[-1, 0]
    assert value == pytest.approx(wanted, rel=1e-9)  # printed in full


def test_every_section_says_what_was_run() -> None:
    text = (PAGES / PAGE).read_text(encoding="utf-8")
    for tool in ("fmpy", "libcosim", "OpenModelica and OMSimulator", "Simulink"):
        section = text.split(f"\n## {tool}\n")[1].split("\n## ")[0]
        assert "**Run here**" in section or "**Not run here:**" in section
    assert "--backend compiled" in text.split("LD_PRELOAD")[0]
    assert PAGE.removesuffix(".md") in (PAGES / "exchange.md").read_text(encoding="utf-8")
