"""What people read on the console: every character of a table, whatever it means to the library that draws it."""

from __future__ import annotations

import contextlib
import io
import re
from types import SimpleNamespace
from typing import Any

import pytest
import rich.console
from hypothesis import example, given
from hypothesis import strategies as st
from rich.console import Console

from softneck.cli import _simulate
from softneck.cli.shared._console import note, print_table, progress

# What a terminal shows in a place of its own: no controls, and no marks that join the letter before them.
SHOWN = st.text(st.characters(categories=("L", "N", "P", "S")), min_size=1, max_size=12)


def _printed(title: str, head: list[str], rows: list[list[str]]) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_table(title, head, rows)
    return out.getvalue()


@given(title=SHOWN, name=SHOWN, cells=st.lists(SHOWN, min_size=1, max_size=3))
@example(title="Pulled [rad]", name="[bold]", cells=["run[1].csv", "[/]", ":warning:", "\\[deg]"])
def test_a_table_shows_every_character_of_title_heading_and_cells(title: str, name: str, cells: list[str]) -> None:
    first, *table = _printed(title, ["what", name], [[cell, cell] for cell in cells]).splitlines()
    assert first == title
    assert name in table[1]
    for line, cell in zip(table[3:], cells, strict=False):
        assert line.count(cell) >= 2


@pytest.mark.parametrize("columns", ["40", "80", "200"])
def test_a_narrow_terminal_shows_every_word_of_a_table(monkeypatch: pytest.MonkeyPatch, columns: str) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    out = io.StringIO()
    monkeypatch.setattr(out, "isatty", lambda: True)
    rows = [["play", "95.7 +- 0.2", "largest motions", "chosen"],
            ["greybox", "-", "-", "not identified: kind `greybox` has motors in rad or deg"]]  # fmt: skip
    with contextlib.redirect_stdout(out):
        print_table("fit", ["kind", "worst", "of", ""], rows)
    for word in " ".join(cell for row in rows for cell in row).split():
        assert word in out.getvalue()


@pytest.mark.parametrize("unit", ["rad", "deg", "N", "s", "kg m^2", "rad/s", "%", "-", "1/s", "/", "bold", "red"])
def test_units_in_brackets_survive_in_every_place(unit: str) -> None:
    text = f"pulled [{unit}]"
    assert _printed(text, [text, text], [[text, text]]).count(text) == 5


def test_a_table_in_a_pipe_is_neither_cut_nor_folded() -> None:
    path = "/a/" + "long/" * 80 + "name of a file.csv"
    printed = _printed(path, ["file", "fit [%]"], [[path, "80.0"]])
    assert printed.count(path) == 2


@pytest.mark.parametrize("text", ["run[1].csv", "[/]", "[rad]"])
def test_progress_shows_names_of_files_as_they_are(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = io.StringIO()
    monkeypatch.setattr(
        rich.console, "Console", lambda stderr: Console(file=drawn, force_terminal=True, width=120, stderr=stderr)
    )
    with progress(text) as tell:
        tell(0.5, text)
    # Without the sequences that move the cursor and colour.
    assert f"{text}: {text}" in re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", drawn.getvalue())


@pytest.mark.parametrize("text", ["run[1].csv", "[/]", "no channel pitch [deg]"])
def test_remarks_are_printed_as_they_are(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    note(text)
    assert capsys.readouterr().err == f"{text}\n"


def test_values_in_a_large_unit_are_not_shown_as_zero() -> None:
    row = {"metric": "height.rms_error_m", "limit": 0.001, "value": 0.00012345, "holds": True}
    asked: Any = SimpleNamespace(limits=[row])
    assert _simulate._limits(asked)[1] == [["height.rms_error_m", "0.001", "0.00012345", "holds"]]
    shown: Any = SimpleNamespace(metrics={"height": {"rms_error_m": 0.00012345}}, robot=None)
    assert _simulate._metrics(shown)[1] == [["height.rms_error_m", "0.00012345"]]
