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


@pytest.mark.slow
def test_the_first_script_leaves_an_fmu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert (tmp_path / "build" / "Neck.fmu").is_file()


@pytest.mark.slow
def test_the_pictures_of_set_membership_are_those_of_the_docs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All three are drawn; what they say is tested in tests/identification."""
    monkeypatch.setattr("sys.argv", ["set_membership.py", str(tmp_path)])
    runpy.run_path(str(ROOT / "examples" / "set_membership.py"), run_name="__main__")
    names = {path.name for path in tmp_path.glob("*.svg")}
    assert len(names) == 3
    assert names == {path.name for path in (ROOT / "docs" / "_static").glob("set_membership_*.svg")}


@pytest.mark.slow
@pytest.mark.nightly
def test_taut_tendons_make_every_kind_hold(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "benchmarks" / "taut_tendons.py"), run_name="__main__")
    before, after = capsys.readouterr().out.split("co-contraction at least")
    assert before.count("do not hold") == 3
    assert after.count("| hold") == 3
    assert "do not hold" not in after


@pytest.mark.slow
def test_the_picture_of_limits_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["mpc_limits.py", str(tmp_path)])
    runpy.run_path(str(ROOT / "examples" / "mpc_limits.py"), run_name="__main__")
    assert (tmp_path / "mpc_limits.png").is_file()
