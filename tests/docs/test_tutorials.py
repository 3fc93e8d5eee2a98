"""The tutorials do what they say: their files are written, their commands run, in order, in an empty folder."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).parents[2] / "docs" / "tutorials"
# What each leaves behind.
PAGES = {
    "csv_to_fmu": ("neck.csv", "neck.layout.toml", "quality.html", "rls.npz", "fit.html", "Neck.fmu", "report.html"),
    "design_study": ("pareto.png", "study/runs.parquet", "my_neck/build/study/report.html"),
    "closed_loop_ci": ("my_neck/loop.json", "my_neck/loop.html"),
    "your_robot": ("oe.npz", "loop.json", "Arm.fmu", "Pi.fmu", "loop.ssp"),
    "fmu_in_our_loop": ("Arm.fmu", "pi.npz", "loop.html"),
}
pytestmark = pytest.mark.slow


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Yield language and text of each code block."""
    for found in re.finditer(
        r"^```(\w+)\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    ):
        yield found[1], found[2]


def test_every_tutorial_is_run() -> None:
    assert {page.stem for page in TUTORIALS.glob("*.md")} == {*PAGES, "index"}


@pytest.mark.parametrize("name", PAGES)
def test_a_tutorial(name: str, tmp_path: Path) -> None:
    place = tmp_path
    for language, text in blocks(TUTORIALS / f"{name}.md"):
        if language == "console":
            for line in text.splitlines():
                place = command(line.removeprefix("$ "), place)
        else:
            # The first line of a file names it.
            file = place / text.splitlines()[0].removeprefix("# ")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
    for left in PAGES[name]:
        assert (tmp_path / left).is_file(), left


def command(line: str, place: Path) -> Path:
    """Run one line as a newcomer would; return the folder that he is in then."""
    words = shlex.split(line)
    if words[0] == "cd":
        return place / words[1]
    programs = {
        "softneck": ["-c", "from softneck.cli import main; main()"],
        "python": [],
        "pytest": ["-m", "pytest", "-p", "no:cacheprovider"],
    }
    run = [sys.executable, *programs[words[0]], *words[1:]]
    done = subprocess.run(run, cwd=place, capture_output=True, text=True, env={**os.environ, "MPLBACKEND": "Agg"})
    assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    return place
