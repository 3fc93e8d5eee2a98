"""The shipped systemd unit, as far as it shows without systemd; `make nightly-systemd` runs it under one."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from softneck.cli._main import run

UNIT = Path(__file__).parents[2] / "examples" / "drives" / "softneck-neck.service"


def settings(name: str) -> list[str]:
    """Return all values of a setting."""
    text = UNIT.read_text(encoding="utf-8").replace("\\\n", " ")
    return [line.partition("=")[2] for line in text.splitlines() if line.startswith(f"{name}=")]


def test_nothing_starts_by_itself_again() -> None:
    assert settings("Restart") == ["no"]


@pytest.mark.parametrize("name", ["ExecStart", "ExecStopPost"])
def test_its_commands_are_known(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *words = shlex.split(settings(name)[0])
    assert program.endswith("bin/softneck")
    assert run([*words[:2], "--help"]) == 0
    shown = capsys.readouterr().out.replace("\n", " ")
    for word in words:
        if word.startswith("--"):
            assert f"{word} " in shown, word


def test_the_words_are_those_of_its_bus() -> None:
    words = shlex.split(settings("ExecStart")[0])
    channel = words[words.index("--bus") + 1].partition(":")[2]
    assert f'"SOFTNECK_ARM=MOVE {channel}"' in settings("Environment")
    assert settings("BindsTo") == settings("After") == [f"sys-subsystem-net-devices-{channel}.device"]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze (systemd)")
def test_systemd_knows_every_setting(tmp_path: Path) -> None:
    # What is not installed here is left out: only the program is.
    text = UNIT.read_text(encoding="utf-8").replace("/opt/softneck/bin/softneck", str(shutil.which("true")))
    path = tmp_path / UNIT.name
    path.write_text(text, encoding="utf-8")
    done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
