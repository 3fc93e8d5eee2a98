"""The reference of the `drives` commands says what they print: every key of every `--json`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from softneck.cli._main import run

from ..data import ROOT
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
    "words", ["scan", "check", "zero", "jog 1", "stop", "reset", "record steps --duration 5 -o r.csv"]
)
def test_json_has_the_keys_of_the_reference(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["drives", *words.split(), "--simulated", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of(words.split()[0])


@pytest.mark.slow
def test_run_and_replay_have_the_keys_of_the_reference(
    project: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    files = ["--loop", str(project.loop), "--certificate", str(project.certificate), "--log", "run.mcap"]
    words = ["drives", "run", str(project.controller), *files, "--simulated", "-o", "r.csv", "--json"]
    assert run(words) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of("run")
    assert run(["drives", "replay", "run.mcap", "--core-only", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == keys_of("replay")


def test_every_command_has_a_row() -> None:
    from softneck.cli.drives._commands import command

    for name in command.commands:
        assert keys_of(name), name
