"""`softneck new`: a project whose test passes at once."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import pytest

from softneck.cli._main import run

from .test_plugin import run_pytest


@pytest.mark.slow
def test_the_new_project_s_test_passes_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "my neck"
    assert run(["new", str(folder), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert {"identify.py", "design.py", "loop.toml", "study.toml", "test_closed_loop.py"} <= set(files)
    done = run_pytest(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed" in done.stdout
    assert run(["simulate", str(folder / "loop.toml"), "-o", str(tmp_path / "run.csv")]) == 0
    assert run(["fmu", str(folder / "loop.toml"), "-o", str(tmp_path / "loop.ssp")]) == 0
    if shutil.which("cc"):
        for name in ("Pi", "Kalman", "VirtualNeck"):
            assert _runs_python(folder / "fmus" / f"{name}.fmu")
            assert not _runs_python(folder / "fmus" / "compiled" / f"{name}.fmu")
        with zipfile.ZipFile(tmp_path / "loop.ssp") as archive:
            archive.extractall(tmp_path / "ssp")
        parts = list((tmp_path / "ssp" / "resources").glob("*.fmu"))
        assert [path.stem for path in parts if _runs_python(path)] == []
        assert len(parts) == 4
    # And to simulated drives, by the commands that its README lists.
    monkeypatch.chdir(folder)
    listed = [line[2:].split() for line in Path("README.md").read_text().splitlines() if line.startswith("$ softneck ")]
    to_drives = [words[1:] for words in listed if words[1] == "verify" or "drives_loop.toml" in words]
    assert [words[0] for words in to_drives] == ["verify", "simulate", "drives"]
    for words in to_drives:
        assert run(words) == 0, words


def _runs_python(fmu: Path) -> bool:
    with zipfile.ZipFile(fmu) as archive:
        return any(name.endswith(".py") for name in archive.namelist())


def test_what_stands_there_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop.toml").write_text("mine")
    assert run(["new", str(tmp_path)]) == 2
    assert "is not empty (it holds loop.toml); take a new folder" in capsys.readouterr().err
    assert (tmp_path / "loop.toml").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["loop.toml"]
    assert run(["new", str(tmp_path), "--force"]) == 0


def test_a_folder_with_anything_in_it_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("etc", "home", "usr", "var"):
        (tmp_path / name).mkdir()
    assert run(["new", str(tmp_path)]) == 2
    assert "is not empty (it holds etc, home, usr, ...)" in capsys.readouterr().err
    assert len(list(tmp_path.iterdir())) == 4
