"""A loop as an SSP file: valid, the same bytes again, and the same numbers in masters that nobody here wrote."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] - it has no stubs

from softneck.core import OutputFileError, SettingsError
from softneck.cosim import load_loop, load_ssp, simulate, write_ssp
from softneck.cosim.loops._loop_file import LoopSetup, reference_of
from softneck.fmu import build_fmu
from softneck.loop import BlockPart, Loop, SensorFault

from ..importers import need
from ..references import StepReference
from ._foreign import build_foreign

MASTERS = Path(__file__).with_name("masters")
PACKAGES = {"libcosim": "libcosimpy", "ecos": "ecospy"}
LOOP = """
duration_s = 2.0
order = "jacobi"
[plant]
fmu = "VirtualNeck.fmu"
parameters = { noise_seed = 5, payload = 0.2 }
[observer]
fmu = "kalman.fmu"
[controller]
file = "pi.npz"
[reference]
kind = "ramp"
pitch_deg = 6.0
roll_deg = -4.0
at_s = 0.2
rise_s = 0.5
"""
_VALUES = "{http://ssp-standard.org/SSP1/SystemStructureParameterValues}"
_SPACE = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"


@pytest.fixture(scope="module")
def setup(folder: Path) -> LoopSetup:
    path = folder / "ssp_loop.toml"
    path.write_text(LOOP)
    return load_loop(path)


@pytest.fixture(scope="module")
def archive(setup: LoopSetup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ssp(setup, tmp_path_factory.mktemp("ssp") / "Loop.ssp", compiled=False)


def structure(path: Path) -> Any:
    with zipfile.ZipFile(path) as members:
        return etree.fromstring(members.read("SystemStructure.ssd"))


def parameters(path: Path, part: str) -> Any:
    with zipfile.ZipFile(path) as members:
        return etree.fromstring(members.read(f"resources/{part}.ssv"))


def run_in(master: str, path: Path, signals: list[tuple[str, str]], rows: int, folder: Path) -> np.ndarray:
    need(PACKAGES[master])
    job, out = folder / "job.json", folder / "out.npy"
    job.write_text(json.dumps({"step": 0.02, "rows": rows, "signals": signals}))
    command = [sys.executable, str(MASTERS / f"{master}.py"), str(path), str(job), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert out.is_file(), (done.stdout + done.stderr)[-2000:]
    return np.load(out)


@pytest.mark.slow
@pytest.mark.parametrize("master", list(PACKAGES))
def test_other_masters_compute_our_jacobi_loop(master: str, setup: LoopSetup, archive: Path, tmp_path: Path) -> None:
    ours = simulate(setup)
    signals = {
        ("plant", "pitch"): "pitch", ("plant", "roll"): "roll", ("plant", "tension_1"): "tension_1",
        ("plant", "pitch_measured"): "pitch_measured", ("observer", "pitch"): "pitch_estimate",
        ("controller", "motor_setpoint_1"): "motor_setpoint_1", ("controller", "motor_setpoint_3"): "motor_setpoint_3",
        ("reference", "pitch_reference"): "pitch_reference",
    }  # fmt: skip
    theirs = run_in(master, archive, list(signals), 100, tmp_path)
    for (part, name), column in zip(signals, theirs.T, strict=True):
        expected = ours[signals[part, name]]
        # Same FMUs, same order of calls; 1e-12 is the limit and leaves room for compiled against plain Python.
        np.testing.assert_allclose(column[1:], expected[1:], rtol=0, atol=1e-12, err_msg=f"{part}.{name}")
    assert np.abs(ours["pitch"]).max() > 0.02  # the loop does move


@pytest.mark.slow
@pytest.mark.parametrize("master", list(PACKAGES))
def test_another_master_reads_changed_parameters(master: str, archive: Path, tmp_path: Path) -> None:
    changed, name = tmp_path / "Changed.ssp", "resources/controller.ssv"
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(changed, "w") as new:
        for member in old.namelist():
            data = old.read(member)
            if member == name:
                table = etree.fromstring(data)
                for axis in ("pitch", "roll"):
                    real = table.find(f".//{_VALUES}Parameter[@name='{axis}_K']/{_VALUES}Real")
                    real.set("value", repr(0.5 * float(real.get("value"))))
                data = etree.tostring(table)
            new.writestr(member, data)
    signals = [("plant", "pitch"), ("controller", "motor_setpoint_1")]
    theirs, ours = run_in(master, changed, signals, 100, tmp_path), simulate(load_ssp(changed))
    for (_, signal), column in zip(signals, theirs.T, strict=True):
        # As above: the same FMUs in the same order of calls.
        np.testing.assert_allclose(column[1:], ours[signal][1:], rtol=0, atol=1e-12)
    plain = simulate(load_ssp(archive))
    assert np.abs(ours["pitch"] - plain["pitch"]).max() > 1e-3  # a softer controller is another loop


def test_fmpys_own_master_follows_the_loop(setup: LoopSetup, archive: Path) -> None:
    """It gives what nothing feeds the value of the last connection: no such input is in the structure."""
    fed = {
        (link.get("endElement"), link.get("endConnector")) for link in structure(archive).iter(f"{_SPACE}Connection")
    }
    inputs = {
        (item.get("name"), connector.get("name"))
        for item in structure(archive).iter(f"{_SPACE}Component")
        for connector in item.iter(f"{_SPACE}Connector")
        if connector.get("kind") == "input"
    }
    assert inputs == fed
    assert "payload" not in {name for _, name in inputs}
    theirs = simulate_ssp(str(archive), stop_time=2.0, step_size=0.02)
    ours = simulate(setup)
    for axis, expected in (("pitch", 6.0), ("roll", -4.0)):
        # It ignores parameters (a payload of 0.2 kg) and starts all at 0: the controller's integrator removes both.
        assert np.degrees(ours[axis][-1]) == pytest.approx(expected, abs=0.3)
        assert np.degrees(theirs[f"plant.{axis}"][-1]) == pytest.approx(expected, abs=0.3)


def test_units_that_differ_are_converted_on_the_way(fmus: Path, toys: Any, tmp_path: Path) -> None:
    foreign = build_foreign(tmp_path, 2)
    (tmp_path / "Pi.fmu").write_bytes((fmus / "Pi.fmu").read_bytes())
    (tmp_path / "loop.toml").write_text(
        'duration_s = 1.0\norder = "jacobi"\n[plant]\nfmu = "Foreign2.fmu"\nsample_time_s = 0.02\n'
        'names = { u1 = "motor_setpoint_1", u2 = "motor_setpoint_2", u3 = "motor_setpoint_3", alpha = "pitch", '
        'beta = "roll" }\nparameters = { T = 0.3 }\n[controller]\nfmu = "Pi.fmu"\n[reference]\nkind = "step"\n'
        "pitch_deg = 5.0\nat_s = 0.1\n"
    )
    assert foreign.is_file()
    setup = load_loop(tmp_path / "loop.toml")
    path = write_ssp(setup, tmp_path / "Foreign.ssp", compiled=False)
    factors = {
        item.getparent().get("endConnector"): float(item.get("factor"))
        for item in structure(path).iter("{http://ssp-standard.org/SSP1/SystemStructureCommon}LinearTransformation")
    }
    assert factors == {"pitch": pytest.approx(np.pi / 180), "roll": pytest.approx(np.pi / 180)}
    theirs = run_in("libcosim", path, [("plant", "alpha"), ("controller", "motor_setpoint_1")], 50, tmp_path)
    ours = simulate(setup)
    # The foreign plant speaks degrees; our results are in SI.
    np.testing.assert_allclose(np.radians(theirs[1:, 0]), ours["pitch"][1:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(theirs[1:, 1], ours["motor_setpoint_1"][1:], rtol=0, atol=1e-12)


def test_the_description_holds_to_the_schema(archive: Path) -> None:
    folder = Path(fmpy.__file__).parent / "ssp" / "schema"
    checker = etree.XMLSchema(etree.parse(str(folder / "SystemStructureDescription.xsd")))
    assert checker.validate(structure(archive)), checker.error_log
    values = etree.XMLSchema(etree.parse(str(folder / "SystemStructureParameterValues.xsd")))
    for part in ("plant", "controller"):
        assert values.validate(parameters(archive, part)), values.error_log


def test_it_names_parts_units_values_experiment_and_places(archive: Path) -> None:
    root = structure(archive)
    components = {item.get("name"): item for item in root.iter(f"{_SPACE}Component")}
    assert set(components) == {"plant", "observer", "controller", "reference"}
    with zipfile.ZipFile(archive) as members:
        assert {item.get("source") for item in components.values()} <= set(members.namelist())
    text = etree.tostring(root).decode()
    named = f"{_VALUES}Parameters/{_VALUES}Parameter[@name='%s']/*"
    assert dict(parameters(archive, "plant").find(named % "payload").attrib) == {"value": "0.2", "unit": "kg"}
    controller = parameters(archive, "controller")
    assert dict(controller.find(named % "use_motor_positions").attrib) == {"value": "true"}  # the controller was a file
    assert controller.find(named % "pitch_Ti").get("unit") == "s"  # what a person turns is there to be changed
    assert root.find(f"{_SPACE}DefaultExperiment").attrib == {"startTime": "0", "stopTime": "2.0"}
    assert 'FixedStepMaster description="oms-ma" stepSize="0.02"' in text
    boxes = [item.find(f"{_SPACE}ElementGeometry").attrib for item in components.values()]
    corners = [tuple(float(box[key]) for key in ("x1", "y1", "x2", "y2")) for box in boxes]
    for i, a in enumerate(corners):  # no two boxes overlap
        assert not any(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3] for b in corners[i + 1 :])


# OMSimulator 2.1 and 3.0 (System.cpp, Model.cpp and ComponentFMUCS.cpp of its sources) refuse any other element there.
READ_BY_OMSIMULATOR = {
    "SystemStructureDescription": {"System", "Units", "Enumerations", "DefaultExperiment"},
    "System": {"ElementGeometry", "ParameterBindings", "Connectors", "Elements", "Connections", "Annotations"},
    "Elements": {"System", "Component"},
    "Component": {"Connectors", "ElementGeometry", "ParameterBindings"},
}


def test_a_strict_master_knows_every_element(archive: Path) -> None:
    for element in structure(archive).iter():
        known = READ_BY_OMSIMULATOR.get(etree.QName(element).localname)
        if known is not None:
            assert {etree.QName(child).localname for child in element} <= known


def test_the_same_loop_gives_the_same_bytes(setup: LoopSetup, archive: Path, tmp_path: Path) -> None:
    assert write_ssp(setup, tmp_path / "Loop.ssp", compiled=False).read_bytes() == archive.read_bytes()


def test_a_reference_fmu_of_a_loop_file_drives_the_loop_as_the_file_does(loop_file: Path) -> None:
    first = simulate(load_loop(loop_file))
    build_fmu(reference_of(loop_file).block(), loop_file.parent / "Wish.fmu")
    text = loop_file.read_text()
    begin, end = text.index("[reference]"), text.index("[limits]")
    loop_file.write_text(f'{text[:begin]}[reference]\nfmu = "Wish.fmu"\n{text[end:]}')
    setup = load_loop(loop_file)
    second = simulate(setup)
    for name in ("pitch", "pitch_reference", "motor_setpoint_1"):
        np.testing.assert_allclose(second[name], first[name], rtol=0, atol=1e-13)
    assert set(setup.files) == {"loop", "plant", "controller", "reference"}
    with pytest.raises(SettingsError, match="is an FMU already"):
        reference_of(loop_file)


def test_what_cannot_be_an_ssp_file_is_refused(setup: LoopSetup, archive: Path, toys: Any, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"must end in `\.ssp`"):
        write_ssp(setup, tmp_path / "loop.zip")
    with pytest.raises(OutputFileError, match="exists"):
        write_ssp(setup, archive)
    loop = Loop(
        plant=BlockPart(toys.neck()), controller=BlockPart(toys.pi()), reference=StepReference(pitch=0.1), duration=1.0,
        faults=(SensorFault(kind="freeze", start=0.5),),
    )  # fmt: skip
    with pytest.raises(SettingsError, match="cannot hold the loop's faults"):
        write_ssp(loop, tmp_path / "Faulty.ssp")
