"""What an FMU contains, that it is valid, and that building leaves no trace but the file."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import fmpy
import pytest
from fmpy.validation import validate_fmu

from softneck import load
from softneck.core import OutputFileError, SettingsError, to_si
from softneck.fmu import FmuInfo, build_fmu, fmu_info
from softneck.fmu.describe._description import _SHOWN
from softneck.runtime import Block, Port

from ..data import with_starts

GOLDEN = Path(__file__).parents[1] / "golden"
KINDS = ["lag", "controller", "neck", "pi"]


@pytest.mark.parametrize("kind", KINDS)
def test_fmpy_finds_nothing_to_complain_about(kind: str, toys: Any, tmp_path: Path) -> None:
    path = build_fmu(getattr(toys, kind)(), tmp_path / "Toy.fmu")
    assert validate_fmu(str(path)) == []  # schema, names, structure, start values, units


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_input_gives_the_same_bytes(kind: str, toys: Any, tmp_path: Path) -> None:
    info = FmuInfo(description="a toy", documentation="<p>for tests</p>")
    (tmp_path / "other").mkdir()
    first = build_fmu(getattr(toys, kind)(), tmp_path / "Toy.fmu", info=info).read_bytes()
    second = build_fmu(getattr(toys, kind)(), tmp_path / "other" / "Toy.fmu", info=info).read_bytes()
    assert first == second


@pytest.mark.parametrize("change", ["array", "start", "info", "name"])
def test_another_content_gives_another_guid(change: str, toys: Any, tmp_path: Path) -> None:
    block, info, name = toys.lag(), FmuInfo(), "Toy"
    before = fmpy.read_model_description(str(build_fmu(block, tmp_path / "Toy.fmu", info=info))).guid
    if change == "array":
        block = toys.lag(pole=0.9000001)
    elif change == "start":
        block = with_starts(block, pitch_start=0.1)
    elif change == "info":
        info = FmuInfo(author="somebody else")
    else:
        name = "Toy2"
    after = fmpy.read_model_description(str(build_fmu(block, tmp_path / f"{name}.fmu", info=info, force=True))).guid
    assert after != before


def test_variables_carry_what_the_ports_say(lag_fmu: Path) -> None:
    model = fmpy.read_model_description(str(lag_fmu))
    by_name = {v.name: v for v in model.modelVariables}
    pitch, drive = by_name["pitch"], by_name["motor_setpoint_1"]
    assert (pitch.unit, pitch.displayUnit, pitch.nominal) == ("rad", "deg", "0.5")
    assert (pitch.min, pitch.max) == ("-100.0", "100.0")
    assert (drive.causality, drive.variability, drive.start) == ("input", "continuous", "0.0")
    assert drive.description == "drive <&>"
    assert (by_name["driven"].type, by_name["driven"].start) == ("Boolean", "true")
    assert (by_name["pitch_start"].causality, by_name["pitch_start"].variability) == ("parameter", "fixed")
    assert {"deg"} == {display.name for unit in model.unitDefinitions for display in unit.displayUnits}
    assert model.defaultExperiment is not None
    assert model.defaultExperiment.stepSize == "0.02"
    assert model.generationDateAndTime is not None
    assert model.generationDateAndTime.endswith("Z")
    assert model.coSimulation is not None
    assert model.coSimulation.canGetAndSetFMUstate
    assert model.coSimulation.canSerializeFMUstate
    assert model.coSimulation.canHandleVariableCommunicationStepSize


def test_references_get_the_range_of_the_neck_unless_they_have_their_own(toys: Any, tmp_path: Path) -> None:
    path = build_fmu(toys.pi(), tmp_path / "Pi.fmu")
    ranges = {v.name: (v.min, v.max) for v in fmpy.read_model_description(str(path)).modelVariables}
    assert ranges["pitch_reference"] == ("-0.8", "0.8")
    assert ranges["cocontraction_reference"] == ("-6.0", "6.0")
    assert ranges["pitch"] == (None, None)


def test_the_archive_is_sorted_deflated_and_timeless(lag_fmu: Path) -> None:
    with zipfile.ZipFile(lag_fmu) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        html = archive.read("documentation/index.html").decode()
    assert names == sorted(names)
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_DEFLATED}
    assert {entry.date_time for entry in entries} == {(1980, 1, 1, 0, 0, 0)}
    assert {"documentation/index.html", "documentation/licenses/pythonfmu.txt"} <= set(names)
    # One module of ours and its loader under content-hashed names, and none of softneck's packages.
    modules = [name for name in names if name.endswith(".py") and "/pythonfmu/" not in name]
    assert len(modules) == 2
    assert all(name.startswith("resources/softneck_") for name in modules)
    assert "Python 3.11 or newer with numpy" in html
    assert "drive &lt;&amp;&gt;" in html


def test_the_date_follows_source_date_epoch(toys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    path = build_fmu(toys.lag(), tmp_path / "Toy.fmu")
    assert fmpy.read_model_description(str(path)).generationDateAndTime == "2023-11-14T22:13:20Z"


def test_building_leaves_the_interpreter_as_it_was(toys: Any, tmp_path: Path) -> None:
    build_fmu(toys.lag(), tmp_path / "First.fmu")  # what is imported once and for all is there now
    before = list(sys.path), set(sys.modules), Path.cwd(), dict(os.environ), sys.dont_write_bytecode
    build_fmu(toys.controller(), tmp_path / "Second.fmu")
    assert (list(sys.path), set(sys.modules), Path.cwd(), dict(os.environ), sys.dont_write_bytecode) == before
    assert sorted(item.name for item in tmp_path.iterdir()) == ["First.fmu", "Second.fmu"]


def test_an_fmu_that_ran_before_changes_nothing(tmp_path: Path) -> None:
    """It leaves its own pythonfmu in `sys.modules`, which has no binaries."""
    here = build_fmu(load(GOLDEN / "pi.npz").block(), tmp_path / "Pi.fmu")
    script = """
import sys
import fmpy
from softneck import load
from softneck.fmu import build_fmu
golden, here, there = sys.argv[1:]
fmpy.simulate_fmu(here, stop_time=0.1)
build_fmu(load(golden).block(), there)
"""
    there = tmp_path / "there" / "Pi.fmu"
    there.parent.mkdir()
    command = [sys.executable, "-c", script, str(GOLDEN / "pi.npz"), str(here), str(there)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert there.is_file(), done.stderr
    assert there.read_bytes() == here.read_bytes()


@pytest.mark.parametrize("name", ["1st", "my model", "a-b", "neck.v2", "lambda", "é", ""])
def test_a_name_that_is_no_identifier_is_refused(name: str, toys: Any, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"cannot be the model name|must end in"):
        build_fmu(toys.lag(), tmp_path / f"{name}.fmu")
    assert list(tmp_path.iterdir()) == []


def test_another_ending_is_refused(toys: Any, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"must end in `\.fmu`"):
        build_fmu(toys.lag(), tmp_path / "Toy.zip")


def test_an_existing_file_is_kept_unless_forced(toys: Any, tmp_path: Path) -> None:
    path = tmp_path / "Toy.fmu"
    path.write_text("mine")
    with pytest.raises(OutputFileError, match="exists already"):
        build_fmu(toys.lag(), path)
    assert path.read_text() == "mine"
    assert zipfile.is_zipfile(build_fmu(toys.lag(), path, force=True))


def test_a_folder_that_cannot_be_made_is_an_output_error(toys: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputFileError, match="cannot be written"):
        build_fmu(toys.lag(), tmp_path / "file" / "Toy.fmu")


def test_two_ports_of_one_name_are_refused(toys: Any, tmp_path: Path) -> None:
    block = replace(toys.lag(), outputs=(Port(name="pitch"), Port(name="pitch")))
    with pytest.raises(SettingsError, match="twice: pitch"):
        build_fmu(block, tmp_path / "Toy.fmu")


def test_a_port_name_or_role_that_fmi_cannot_carry_is_refused(toys: Any, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="`a b` cannot be the name"):
        build_fmu(replace(toys.lag(), inputs=(Port(name="a b"),)), tmp_path / "Toy.fmu")
    with pytest.raises(SettingsError, match="role `wheel` must be one of"):
        build_fmu(replace(toys.lag(), role="wheel"), tmp_path / "Toy.fmu")


def test_what_is_told_of_a_model_escapes_what_it_was_told(toys: Any) -> None:
    class Thing:
        settings: ClassVar[dict[str, str]] = {"form": "<b>"}

        def block(self) -> Block:
            return toys.lag()

        def summary(self) -> str:
            return "a lag & more\nsecond line"

    info = fmu_info(Thing(), scores="fit < 90 %", stop_time=4.0)
    assert (info.description, info.stop_time) == ("a lag & more", 4.0)
    for text in ("a lag &amp; more", "&lt;b&gt;", "fit &lt; 90 %", "Limits of use"):
        assert text in info.documentation


@pytest.mark.parametrize("unit", list(_SHOWN))
def test_the_unit_that_a_tool_displays_is_the_same_quantity(unit: str) -> None:
    shown = _SHOWN[unit]
    assert shown is not None
    name, factor = shown
    to_unit, si = to_si(name)
    assert si == unit
    # FMI's factor leads to the display unit, ours to SI: 180 / pi and pi / 180 each round once.
    assert factor * to_unit == pytest.approx(1.0, rel=1e-15)
