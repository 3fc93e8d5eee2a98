"""A whole loop without Python: neck, observer, controller and reference as compiled FMUs in other masters."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.cosim import FmuPart, load_loop, simulate, write_ssp
from softneck.cosim.loops._write_ssp import block_without_python
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.fmu import build_compiled_fmu, build_fmu
from softneck.fmu.describe._description import exported_block
from softneck.fmu.python._zip import read_zip, write_zip
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, Port

from ..fmu.every_kind import _linear, block_of
from ._foreign import build_foreign
from .test_ssp import LOOP, MASTERS, PACKAGES, run_in

pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)


@pytest.mark.slow
@pytest.mark.parametrize("master", list(PACKAGES))
def test_other_masters_compute_our_jacobi_loop_without_python(master: str, tmp_path: Path) -> None:
    linear = _linear()
    build_fmu(VirtualNeck(NeckParameters.paper()).block(), tmp_path / "VirtualNeck.fmu")  # becomes a compiled one
    build_compiled_fmu(KalmanSettings().design(linear).block(), tmp_path / "kalman.fmu")
    PiSettings().design(linear).save(tmp_path / "pi.npz")
    (tmp_path / "loop.toml").write_text(LOOP)
    setup = load_loop(tmp_path / "loop.toml")
    archive = write_ssp(setup, tmp_path / "Loop.ssp")
    with zipfile.ZipFile(archive) as members:
        for name in members.namelist():
            if name.endswith(".fmu"):
                (tmp_path / "part.fmu").write_bytes(members.read(name))
                with zipfile.ZipFile(tmp_path / "part.fmu") as part:
                    assert "resources/model.bin" in part.namelist()
                    assert not any(file.endswith(".py") for file in part.namelist())
    ours = simulate(setup)
    signals = {
        ("plant", "pitch"): "pitch", ("plant", "tension_1"): "tension_1", ("observer", "pitch"): "pitch_estimate",
        ("controller", "motor_setpoint_1"): "motor_setpoint_1", ("reference", "pitch_reference"): "pitch_reference",
    }  # fmt: skip
    compared = {"in its Python binding": run_in(master, archive, list(signals), 100, tmp_path)}
    if sys.platform == "linux":
        compared["from C, with no Python in the process"] = _run_from_c(master, archive, list(signals), 100, tmp_path)
    for how, theirs in compared.items():
        _assert_equal(how, signals, theirs, ours)
    assert np.abs(ours["pitch"]).max() > 0.02  # the loop does move


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("OMSimulator") is None, reason="OMSimulator is not on PATH; no registry has it")
def test_omsimulator_computes_our_jacobi_loop(tmp_path: Path) -> None:
    linear = _linear()
    build_compiled_fmu(VirtualNeck(NeckParameters.paper()).block(), tmp_path / "VirtualNeck.fmu")
    build_compiled_fmu(KalmanSettings().design(linear).block(), tmp_path / "kalman.fmu")
    PiSettings().design(linear).save(tmp_path / "pi.npz")
    (tmp_path / "loop.toml").write_text(LOOP)
    setup = load_loop(tmp_path / "loop.toml")
    archive = write_ssp(setup, tmp_path / "Loop.ssp")
    ours, out = simulate(setup), tmp_path / "loop.csv"
    folders = [f"--workingDir={tmp_path}", f"--tempDir={tmp_path}", f"--resultFile={out}"]
    command = ["OMSimulator", *folders, "--stopTime=2", str(archive)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    log = done.stdout + done.stderr
    assert "error:" not in log, log[-2000:]
    with out.open(newline="") as file:
        head, *lines = csv.reader(file)
    rows = np.array([[float(cell) for cell in line if cell] for line in lines])
    # Its table has each moment before and after the step to it.
    after = rows[np.searchsorted(rows[:, 0], np.arange(100) * 0.02 + 1e-9) - 1]
    signals = {
        "plant.pitch": "pitch",
        "observer.roll": "roll_estimate",
        "controller.motor_setpoint_1": "motor_setpoint_1",
    }
    for theirs, name in signals.items():
        (place,) = (i for i, text in enumerate(head) if text.endswith(theirs))
        # It writes 12 digits.
        np.testing.assert_allclose(after[1:, place], ours[name][1:], rtol=1e-11, atol=1e-12, err_msg=name)
    assert np.abs(ours["pitch"]).max() > 0.02


@pytest.mark.parametrize("kind", ["kalman", "pi", pytest.param("guarded", marks=pytest.mark.slow)])
def test_a_python_fmu_gives_its_block_back(kind: str, tmp_path: Path) -> None:
    """What becomes a compiled FMU is what the Python one was made of: the same arrays, ports and starts."""
    block = exported_block(block_of(kind))
    again = block_without_python(build_fmu(block, tmp_path / "Model.fmu"))
    assert again is not None
    for name in ("kind", "role", "runtime", "sample_time"):
        assert getattr(again, name) == getattr(block, name)
    for ours, theirs in zip(block.arrays, again.arrays, strict=True):
        np.testing.assert_array_equal(theirs, ours)
    for ours, theirs in zip(_ports(block), _ports(again), strict=True):
        # XML has no range of a Boolean; NaN as a start value is not equal to itself.
        kept = replace(ours, minimum=None, maximum=None) if ours.boolean else ours
        assert repr(theirs) == repr(kept)


def test_an_fmi3_fmu_of_ours_says_what_may_be_missing(tmp_path: Path) -> None:
    for fmi in (2, 3):
        build_compiled_fmu(block_of("kalman"), tmp_path / f"Kalman{fmi}.fmu", fmi=fmi)
    two, three = (FmuPart(tmp_path / f"Kalman{fmi}.fmu") for fmi in (2, 3))
    assert three.role == two.role == "observer"
    assert [port.missing for port in three.inputs] == [port.missing for port in two.inputs]
    assert any(port.missing for port in three.inputs)


def test_a_compiled_fmu_stays_what_it_is(tmp_path: Path) -> None:
    build_compiled_fmu(block_of("pi"), tmp_path / "pi.fmu")
    assert block_without_python(tmp_path / "pi.fmu") is None


def _ports(block: Block) -> tuple[Port, ...]:
    return (*block.inputs, *block.outputs, *block.parameters)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda facts: facts.pop("module_of_runtime"), "made by another version of softneck"),
        (lambda facts: facts.update(runtime="softneck_0"), "made by another version of softneck"),
        (lambda facts: facts.update(module_of_runtime="this"), "cannot be in a compiled FMU"),
    ],
)
def test_a_python_fmu_that_cannot_be_made_again_is_refused(change: Any, message: str, tmp_path: Path) -> None:
    members = read_zip(build_fmu(block_of("pi"), tmp_path / "pi.fmu"))
    facts = json.loads(members["resources/block.json"])
    change(facts)
    write_zip(tmp_path / "pi.fmu", members | {"resources/block.json": json.dumps(facts).encode()})
    with pytest.raises(SettingsError, match=message):
        block_without_python(tmp_path / "pi.fmu")
    assert "this" not in sys.modules


def test_a_foreign_fmu_that_needs_its_tool_is_refused(tmp_path: Path) -> None:
    members = read_zip(build_foreign(tmp_path, 2))
    text = members["modelDescription.xml"].decode()
    tool = text.replace("<CoSimulation ", '<CoSimulation needsExecutionTool="true" ')
    write_zip(tmp_path / "Tool.fmu", members | {"modelDescription.xml": tool.encode()})
    assert block_without_python(tmp_path / "Foreign2.fmu") is None
    with pytest.raises(SettingsError, match=r"Tool\.fmu: needs another program .* `--backend python`"):
        block_without_python(tmp_path / "Tool.fmu")


def _assert_equal(how: str, signals: dict[tuple[str, str], str], theirs: np.ndarray, ours: Any) -> None:
    for (part, name), column in zip(signals, theirs.T, strict=True):
        # The limit; the neck and the controller run in Python in ours, all else in the same library.
        expected = ours[signals[part, name]]
        np.testing.assert_allclose(column[1:], expected[1:], rtol=0, atol=1e-12, err_msg=f"{part}.{name} {how}")


def _run_from_c(master: str, archive: Path, signals: list[tuple[str, str]], rows: int, folder: Path) -> np.ndarray:
    specification = importlib.util.find_spec(PACKAGES[master])
    assert specification is not None
    assert specification.origin is not None
    name = {"libcosim": "libcosimc.so", "ecos": "libecosc.so"}[master]
    library = next(path for path in Path(specification.origin).parent.rglob(name) if path.is_file())
    command = ["cc", "-std=c99", "-D_DEFAULT_SOURCE", "-o", str(folder / "host"), str(MASTERS / "host.c"), "-ldl"]
    subprocess.run(command, check=True, timeout=120)
    names = [f"{part}::{variable}" for part, variable in signals]
    done = subprocess.run(
        [str(folder / "host"), master, str(library), str(archive), "0.02", str(rows), *names], capture_output=True,
        timeout=120, check=False, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    values = np.frombuffer(done.stdout[-rows * len(names) * 8 :], dtype=float)  # masters may talk on stdout before
    return values.reshape(rows, len(names))
