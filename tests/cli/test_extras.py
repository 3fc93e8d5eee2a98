"""What a missing extra says: one line, which one to install, exit code 2."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from softneck.cli import _projects
from softneck.cli._main import run
from softneck.core import SettingsError, _errors
from softneck.core._errors import EXTRAS, missing_extra
from softneck.signals import write_recording
from softneck.signals.importing.formats._mat import mat_arrays

from ..data import ROOT, neck_recording


def test_each_extra_named_is_one_that_installs_the_package() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    distributions = {"can": "python-can", "serial": "pyserial",
                     "python_calamine": "python-calamine", "mcap_ros2": "mcap-ros2-support"}  # fmt: skip
    for package, (extra, _) in EXTRAS.items():
        name = distributions.get(package, package)
        assert any(line.startswith((f"{name}>", f"{name}[")) for line in extras[extra]), package


def test_a_command_names_the_extra_that_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "a.parquet", neck_recording(50))
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert run(["info", str(tmp_path / "a.parquet")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "run: pip install 'h5py" in said
    assert "'pyarrow>=" in said
    assert "softneck[" not in said


def test_a_file_without_its_package_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_errors, "find_spec", lambda _: None)
    with pytest.raises(SettingsError, match=r"pyarrow is not installed.*pip install .*pyarrow"):
        write_recording(tmp_path / "a.parquet", neck_recording(50))
    (tmp_path / "a.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(SettingsError, match=r"h5py is not installed.*pip install .*h5py"):
        mat_arrays(tmp_path / "a.mat")


@pytest.mark.parametrize("there", [True, False])
def test_a_new_project_says_how_its_test_runs(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_projects, "find_spec", lambda name: name if there else None)
    assert run(["new", str(tmp_path / "p")]) == 0
    said = capsys.readouterr().out
    assert "python identify.py && python design.py && softneck simulate loop.toml\n" in said
    assert ("pip install pytest" in said) != there


def test_what_the_design_card_names_is_installed_with_softneck() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    core = {line.partition(">")[0] for line in project["dependencies"]}
    assert core >= {"numpy", "scipy", "control", "filterpy", "fmpy", "pythonfmu", "numba", "pandas", "bokeh", "casadi"}


def test_any_other_missing_module_is_an_error_of_ours() -> None:
    assert missing_extra(ModuleNotFoundError("no", name="softneck.nothing")) is None
