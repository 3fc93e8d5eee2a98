"""What a newcomer copies runs, and stands once."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "examples" / "first_script.py"


def test_the_readmes_script_is_the_example() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = readme.split("```python\n")[1].split("```")[0]
    assert shown.strip() in SCRIPT.read_text(encoding="utf-8")


def test_the_first_script_leaves_an_fmu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert (tmp_path / "build" / "Neck.fmu").is_file()
