"""Calls of the command line inside this process, and the files that they start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from softneck.cli._main import run
from softneck.signals import write_recording

from ..data import neck_recording


@dataclass(frozen=True)
class Said:
    """What a call printed and returned."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line on stderr, beside lines of progress, which end in dots, and the robot that was found."""
        lines = [line for line in self.err.splitlines() if line.strip() and not line.endswith(" ...")]
        lines = [line for line in lines if not line.startswith("robot: ")]
        assert len(lines) == 1, self.err
        return lines[0]


Call = Callable[..., Said]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Run `softneck ARGUMENTS` in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run_it(*arguments: object) -> Said:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Said(code, printed.out, printed.err)

    return run_it


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording file of the synthetic neck."""
    path = tmp_path_factory.mktemp("recordings") / "neck.csv"
    write_recording(path, neck_recording(600))
    return path


@pytest.fixture(scope="session")
def rls_file(tmp_path_factory: pytest.TempPathFactory, models: dict) -> Path:
    """A saved model that was trained on other rows than `recording`."""
    path = tmp_path_factory.mktemp("models") / "rls.npz"
    models["rls"].save(path)
    return path
