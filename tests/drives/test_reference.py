"""The reference of the `drives` commands says what they print: every key of every `--json`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from softneck.cli._main import run
from softneck.drives.master._events import RULES

from ..data import ROOT
from .broken import ROWS
from .conftest import Project

TEXT = (ROOT / "docs" / "reference" / "drives.md").read_text(encoding="utf-8")


def keys_of(command: str) -> set[str]:
    """Keys in the row of `command`, with those of every run where the row says so."""
    row = next(line for line in TEXT.splitlines() if line.startswith(f"| `{command}` |"))
    keys = set(re.findall(r"`(\w+)`", row.split("|")[4]))
    if "every run" in row:
        begin = TEXT.index("Of every run: ")
        sentence = re.sub(r"\([^)]*\)", "", TEXT[begin : TEXT.index("`nodes` have")])
        keys |= set(re.findall(r"`(\w+)`", sentence))
    return keys


@pytest.mark.parametrize(
    "words",
    [
        "commission --only scan",
        "check",
        "commission --only zero",
        "commission --only jog --motor 1",
        "stop",
        "reset",
        "record steps --duration 5 -o r.csv",
    ],
)
def test_json_has_the_keys_of_the_reference(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["drives", *words.split(), "--simulated", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of(" ".join(words.split()[: 3 if "--only" in words else 1]))


@pytest.mark.slow
def test_run_and_replay_have_the_keys_of_the_reference(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    files = ["--loop", str(project.loop), "--certificate", str(project.certificate), "--log", "run.mcap"]
    words = ["drives", "run", str(project.controller), *files, "--simulated", "-o", "r.csv", "--json"]
    assert run(words) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of("run")
    assert run(["simulate", "run.mcap", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of("simulate LOG.mcap")


def test_every_command_has_a_row() -> None:
    from softneck.cli.drives._commands import command

    for name in command.commands:
        assert keys_of(name), name


def rows_of(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without its head."""
    below = text[text.index(f"\n## {heading}\n") :].split("\n## ")[1]
    lines = [line for line in below.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[1:]]


def test_every_event_is_in_its_table_with_reaction_and_deadline() -> None:
    rows = {
        name.strip("`"): (reaction, deadline) for name, reaction, deadline, _ in rows_of(TEXT, "Events of the master")
    }
    deadlines = {
        name: (rule.reaction.value, f"{rule.cycles} T" if rule.cycles else f"{1000 * rule.seconds:.0f} ms")
        for name, rule in RULES.items()
    }
    assert rows == deadlines


def test_the_fault_table_has_the_rows_of_the_supervisor_and_the_events_that_should_name_them() -> None:
    told = {}
    for _, who, _, end, tests in rows_of(TEXT, "Fault table"):
        if "by its baseline" in who or who.startswith("the same"):
            told.update({row: set(re.findall(r"`(\w+)`", end)) - {"zero"} for row in re.findall(r"`([^`]+)`", tests)})
    assert set(told) == set(ROWS)
    for name, row in ROWS.items():
        assert row.names[0] in told[name], name
    assert set().union(*told.values()) == {row.names[0] for row in ROWS.values()}


def test_the_page_of_the_supervisor_has_its_rows() -> None:
    """What `benchmarks/supervisor.py report` prints, line by line in the order of the rows."""
    lines = (ROOT / "docs" / "theory" / "plausibility.md").read_text(encoding="utf-8").splitlines()
    begin = next(k for k, line in enumerate(lines) if line.startswith("row   "))
    assert [line[:36].rstrip() for line in lines[begin + 1 : begin + 1 + len(ROWS)]] == list(ROWS)
