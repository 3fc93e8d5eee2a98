"""Two necks are never used for choosing: no script that chooses can name them or reach them by a list."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from ..data import ROOT
from .held_out import HELD_OUT
from .necks import CHOOSING, NECKS

# What only shows: it prints what each neck is like, and chooses nothing.
SHOWS = {
    "benchmarks/foreign_necks.py", "benchmarks/baseline.py", "benchmarks/observer.py", "benchmarks/promises.py",
    "benchmarks/tune.py", "benchmarks/payload.py",
}  # fmt: skip
SCRIPTS = [
    path
    for folder in ("benchmarks", "softneck")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if str(path.relative_to(ROOT)) not in SHOWS
]


def reaches(text: str) -> list[str]:
    """Return by which names a script reaches a neck that is held out."""
    found = [name for name in HELD_OUT if re.search(rf"\b{name}\b", text, re.IGNORECASE)]
    if "foreign_necks" not in text:
        return found
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            names |= {item.name for item in node.names}
        elif isinstance(node, ast.Name):
            names.add(node.id)
        elif isinstance(node, ast.Attribute):
            names.add(node.attr)
    return found + sorted(names & {"NECKS", "HELD_OUT", "held_out"})


def test_two_necks_are_held_out_and_the_others_choose() -> None:
    assert len(HELD_OUT) == 2
    assert len(CHOOSING) == len(NECKS) - 2 >= 4
    assert not set(CHOOSING) & set(HELD_OUT)


@pytest.mark.parametrize(
    "line",
    [
        "ForeignNeck(name='{name}')",
        "from tests.foreign_necks.necks import NECKS",
        "from tests.foreign_necks import necks; necks.NECKS",
        "from tests.foreign_necks.held_out import HELD_OUT",
    ],
)
def test_a_script_that_reaches_for_them_is_seen(line: str) -> None:
    assert reaches(line.format(name=HELD_OUT[0]))


def test_no_script_that_chooses_reaches_a_neck_that_is_held_out() -> None:
    assert len(SCRIPTS) > 300
    found = {str(path.relative_to(ROOT)): reaches(path.read_text(encoding="utf-8")) for path in SCRIPTS}
    assert {path: names for path, names in found.items() if names} == {}


def test_what_shows_is_there() -> None:
    assert all(Path(ROOT / path).is_file() for path in SHOWS)
