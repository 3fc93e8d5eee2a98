"""Shells complete our commands, and an unknown name is answered by the one that was meant."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from softneck.cli import _main
from softneck.core._kinds import kinds_of

from .conftest import Call


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("desing",), "softneck: no such command `desing`; did you mean `design`?"),
        (("drives", "recrod"), "softneck: no such command `recrod`; did you mean `record`?"),
        (("xyzzy",), "softneck: no such command `xyzzy`; the commands are start, demo, "),
        (("identify", "nnn", "a.csv"), "softneck: unknown kind of model `nnn`; did you mean `nn`? use one of rls, "),
        (
            ("design", "hif", "a.npz"),
            "softneck: unknown kind of controller `hif`; did you mean `hinf`? use one of pi, ",
        ),
        (
            ("identify", "rls", "a.csv", "--set", "dealy=0.1"),
            "softneck: unknown setting `dealy`; did you mean `delay`? this kind has ",
        ),
    ],
)
def test_a_mistyped_name_is_answered_by_the_one_that_was_meant(call: Call, words: tuple[str, ...], line: str) -> None:
    said = call(*words)
    assert (said.code, said.out) == (2, "")
    assert said.error.startswith(line)


def completed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, line: str) -> list[str]:
    """What bash is told for `line`, asked as the script does it: by the environment."""
    words = line.split(" ")
    monkeypatch.setenv("_SOFTNECK_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    with pytest.raises(SystemExit) as done:
        _main.run([])
    assert done.value.code == 0
    return [said.partition(",")[2] for said in capsys.readouterr().out.splitlines()]


def test_commands_options_and_kinds_are_completed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert completed(capsys, monkeypatch, "softneck de") == ["demo", "design"]
    assert completed(capsys, monkeypatch, "softneck ") == list(_main._COMMANDS)
    assert completed(capsys, monkeypatch, "softneck robot n") == ["new"]
    assert completed(capsys, monkeypatch, "softneck design --any") == ["--any-fit"]
    assert completed(capsys, monkeypatch, "softneck design ") == list(kinds_of("controller"))
    assert completed(capsys, monkeypatch, "softneck identify au") == ["auto"]


@pytest.mark.parametrize(
    ("words", "new"),
    [
        (("resample", "a.csv", "--sample-time", "0.05", "-o", "b.csv"), "softneck import REC --resample S -o REC2"),
        (("robot", "show", "arm"), "softneck robot FILE"),
    ],
)
def test_an_old_name_ends_with_the_new_one(call: Call, words: tuple[str, ...], new: str) -> None:
    said = call(*words)
    assert (said.code, said.out) == (2, "")
    assert said.error.endswith(f" any more: {new}")


def test_the_script_completes_when_bash_sources_it(tmp_path: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("there is no bash")
    command = tmp_path / "softneck"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -c "from softneck.cli._main import main; main()" "$@"\n')
    command.chmod(0o755)
    ask = f'eval "$(_SOFTNECK_COMPLETE=bash_source {command})" && '
    ask += f'COMP_WORDS=("{command}" val) COMP_CWORD=1 && _softneck_completion "{command}"'
    done = subprocess.run(
        [bash, "-c", ask + ' && echo "${COMPREPLY[@]}"'], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    # An old bash (macOS's 3.2) has no `compopt`, and no completion by click.
    if "compopt" in done.stderr or "complete: " in done.stderr:
        pytest.skip(done.stderr)
    assert done.stdout.split() == ["validate"], done.stderr
