"""The system description of a robot's parts: connectors by its channels, pressures in SI base units."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from softneck.core import FileFormatError, SettingsError
from softneck.cosim import LoopSetup, load_loop, load_ssp, make_loop, simulate, write_ssp
from softneck.cosim.loops._loop_file import reference_of
from softneck.cosim.loops._write_ssp import Component, system_description
from softneck.design import design_controller
from softneck.robot import Robot
from softneck.robot._file import preset_text
from softneck.runtime import Port

from ..design.test_robots import plant

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
SSC = "{http://ssp-standard.org/SSP1/SystemStructureCommon}"


def test_pressures_and_lengths_are_connectors_with_units() -> None:
    inputs = tuple(Port(name=f"motor_setpoint_{j}", unit="Pa") for j in (1, 2))
    plant = Component("plant", "resources/plant.fmu", inputs, (Port(name="level", unit="m"),), ())
    root = ElementTree.fromstring(system_description("tank", [plant], [], step=0.02, duration=1.0))
    names = [item.get("name") for item in root.iter(f"{SSD}Connector")]
    assert names == ["motor_setpoint_1", "motor_setpoint_2", "level"]
    units = {unit.get("name"): unit[0].attrib for unit in root.iter(f"{SSC}Unit")}
    assert units == {"Pa": {"kg": "1", "m": "-1", "s": "-2"}, "m": {"m": "1"}}


def test_the_reference_of_another_robots_loop_becomes_a_block(tmp_path: Path) -> None:
    file = tmp_path / "loop.toml"
    file.write_text(
        'duration_s = 2.0\nrobot = "antagonist"\n[reference]\nkind = "step"\npitch_deg = 10.0\nat_s = 1.0\n'
    )
    tank = tmp_path / "tank.toml"
    channels = '[motors]\nnames = ["pump"]\nunit = "V"\n[outputs]\nnames = ["level"]\nunit = "m"\n'
    tank.write_text(f'name = "tank"\n{channels}[directions]\nkind = "identified"\n')
    block = reference_of(file).block()
    assert [port.name for port in block.outputs] == ["pitch_reference", "cocontraction_reference", "enabled"]
    _, told = block.run(block.initial_state(), np.zeros((99, 0)))
    # A step's outputs are those of the next sample.
    np.testing.assert_array_equal(told[:, 0], np.where(np.arange(1, 100) < 50, 0.0, np.radians(10.0)))
    with pytest.raises(SettingsError, match="pitch_deg"):
        reference_of(file, robot=str(tank))


def archive_of_an_antagonist(folder: Path) -> tuple[LoopSetup, Path]:
    model = plant(Robot.preset("antagonist"))
    loop = make_loop({
        "duration_s": 1.0, "order": "jacobi", "plant": model, "controller": design_controller("pi", model),
        "reference": {"kind": "step", "pitch_deg": 5.0, "at_s": 0.1},
    })  # fmt: skip
    return loop, write_ssp(loop, folder / "loop.ssp", compiled=False)


def with_annotation(archive: Path, target: Path, new: str) -> Path:
    """Write an archive with another robot in its annotation."""
    with zipfile.ZipFile(archive) as whole, zipfile.ZipFile(target, "w") as other:
        for name in whole.namelist():
            data = whole.read(name)
            other.writestr(name, re.sub(rb"<Robot>.*?</Robot>", new.encode(), data) if name.endswith(".ssd") else data)
    return target


def test_an_archive_and_its_fmus_say_whose_they_are(tmp_path: Path) -> None:
    loop, archive = archive_of_an_antagonist(tmp_path)
    with pytest.raises(SettingsError, match=r"FMU of robot `antagonist` .* the loop of robot `neck`"):
        load_loop(archive, robot="neck")
    made = simulate(loop)
    # By its own annotation, and, as one without it, by the robot file beside it.
    (tmp_path / "beside").mkdir()
    bare = with_annotation(archive, tmp_path / "beside" / "loop.ssp", "")
    with pytest.raises(SettingsError, match=r"FMU of robot `antagonist` .* the loop of robot `neck`"):
        load_ssp(bare)
    (tmp_path / "beside" / "robot.toml").write_text(preset_text("antagonist"))
    for path in (archive, bare):
        read = simulate(load_ssp(path))  # pyright: ignore[reportArgumentType]
        np.testing.assert_array_equal(read["pitch"], made["pitch"])
        assert read.metrics == made.metrics


def test_a_damaged_annotation_is_one_line(tmp_path: Path) -> None:
    _, archive = archive_of_an_antagonist(tmp_path)
    for number, text in enumerate(("{", "[1]", '{"name": "a"}', "[" * 100_000, '{"motors": {"names": 3}}')):
        damaged = with_annotation(archive, tmp_path / f"{number}.ssp", f"<Robot>{text}</Robot>")
        with pytest.raises(FileFormatError, match=rf"{number}\.ssp: its SystemStructure\.ssd has no robot in"):
            load_ssp(damaged)
