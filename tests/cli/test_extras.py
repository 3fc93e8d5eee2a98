"""What a missing extra says: one line, which one to install, exit code 2."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from softneck import load
from softneck.cli._main import run
from softneck.core import SettingsError, _errors
from softneck.core._errors import EXTRAS, missing_extra
from softneck.signals import write_recording

from ..data import ROOT, neck_recording


def test_each_extra_named_is_one_that_installs_the_package() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    distributions = {"can": "python-can", "serial": "pyserial", "sklearn": "scikit-learn",
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
    assert "pip install 'softneck[files]'" in said


def test_a_model_without_casadi_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    model = load(Path(__file__).parents[1] / "golden" / "rls.npz")
    monkeypatch.setattr(_errors, "find_spec", lambda _: None)
    with pytest.raises(SettingsError, match=r"casadi is not installed.*pip install 'softneck\[mpc\]'"):
        model.casadi()


def test_any_other_missing_module_is_an_error_of_ours() -> None:
    assert missing_extra(ModuleNotFoundError("no", name="softneck.nothing")) is None
