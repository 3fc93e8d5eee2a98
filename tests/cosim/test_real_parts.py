"""The line of the main job: an identified model, its observer and controller, over files and over FMUs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softneck.core import load
from softneck.cosim import load_loop, simulate
from softneck.fmu import unpacked
from softneck.plant import NeckParameters, VirtualNeck

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")

LOOP = """
duration_s = 2.0
[plant]
{plant}
[observer]
{observer}
[controller]
{controller}
[reference]
kind = "step"
pitch_deg = 6.0
roll_deg = -4.0
at_s = 0.4
[limits]
"pitch.rms_error_deg" = 6.0
"""


def _loop(folder: Path, plant: str, ending: str) -> Path:
    key = "file" if ending == "npz" else "fmu"
    path = folder / f"{plant.partition('.')[0]}_{ending}.toml"
    source = f'{"model" if plant.endswith("npz") else "fmu"} = "{plant}"'
    parts = {name: f'{key} = "{file}.{ending}"' for name, file in (("observer", "kalman"), ("controller", "pi"))}
    path.write_text(LOOP.format(plant=source, **parts))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("order", ["sequential", "jacobi"])
def test_files_and_fmus_make_the_same_loop(order: str, folder: Path) -> None:
    paths = [_loop(folder, "rls.npz", "npz"), _loop(folder, "rls.fmu", "fmu")]
    results = []
    for path in paths:
        path.write_text(f'order = "{order}"\n{path.read_text()}')
        results.append(simulate(load_loop(path)))
    assert set(results[0].signals.signals) == set(results[1].signals.signals)
    for name in results[0].signals.signals:
        # Compiled and plain Python differ by rounding only; the loop is stable.
        np.testing.assert_allclose(results[0][name], results[1][name], rtol=0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(("said", "differs"), [("", False), (", use_motor_positions = false", True)])
def test_a_loop_gives_a_controller_s_fmu_its_motors_unless_told_not_to(said: str, differs: bool, folder: Path) -> None:
    results = []
    for ending, more in (("npz", ""), ("fmu", said)):
        path = _loop(folder, f"rls.{ending}", ending)
        path.write_text(
            path.read_text().replace(f'pi.{ending}"', f'pi.{ending}"\nparameters = {{ lead_limit = 0.05{more} }}')
        )
        results.append(simulate(load_loop(path))["motor_setpoint_1"])
    # This model's motors are where they are sent at once; the drives inside are behind, and lead less.
    assert (np.abs(results[1] - results[0]).max() > 0.01) == differs


def test_the_loop_closes_over_the_virtual_neck_s_fmu(folder: Path) -> None:
    result = simulate(load_loop(_loop(folder, "VirtualNeck.fmu", "fmu")))
    assert np.isfinite(result.frame.to_numpy()).all()
    assert {"pitch", "pitch_measured", "pitch_estimate", "tension_1"} <= set(result.signals.signals)
    assert set(result.certificate()["files"]) == {"loop", "plant", "observer", "controller"}
    assert np.abs(result["motor_setpoint_1"]).max() > 0.1  # the controller does act


_HOST = """
import sys
for name in ("softneck", "numba", "scipy", "control", "filterpy", "casadi", "pandas"):
    sys.modules[name] = None  # a host with numpy alone
import json
import fmpy
from fmpy.fmi2 import FMU2Slave
seen = {}
for folder in sys.argv[1:]:
    model = fmpy.read_model_description(folder)
    name = model.coSimulation.modelIdentifier
    fmu = FMU2Slave(guid=model.guid, unzipDirectory=folder, modelIdentifier=name, instanceName=name)
    fmu.instantiate(loggingOn=True)
    fmu.setupExperiment(startTime=0.0)
    for v in model.modelVariables:
        if v.name == "use_motor_positions":
            fmu.setBoolean([v.valueReference], [1])
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    drives = [v.valueReference for v in model.modelVariables if v.causality == "input" and v.type == "Real"]
    outputs = [v.valueReference for v in model.modelVariables if v.causality == "output" and v.type == "Real"]
    for k in range(20):
        fmu.setReal(drives, [0.05] * len(drives))
        fmu.doStep(k * 0.02, 0.02)
    seen[name] = [value.hex() for value in fmu.getReal(outputs)]
    fmu.terminate()
    fmu.freeInstance()
print(json.dumps(seen))
"""


def test_a_host_with_numpy_alone_runs_every_fmu(folder: Path) -> None:
    names = ("rls", "kalman", "pi", "VirtualNeck")
    blocks = [load(folder / f"{name}.npz").block() for name in names[:3]]
    blocks.append(VirtualNeck(NeckParameters.paper()).block())
    with (
        unpacked(folder / "rls.fmu") as a,
        unpacked(folder / "kalman.fmu") as b,
        unpacked(folder / "pi.fmu") as c,
        unpacked(folder / "VirtualNeck.fmu") as d,
    ):
        command = [sys.executable, "-c", _HOST, *map(str, (a, b, c, d))]
        child = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (child.returncode, child.stderr) == (0, "")
    seen = json.loads(child.stdout)
    for name, block in zip(names, blocks, strict=True):
        row = [port.start if port.boolean else 0.05 for port in block.inputs]
        outputs = block.run(block.initial_state(), np.tile(row, (20, 1)))[1][-1]
        expected = [y for y, port in zip(outputs, block.outputs, strict=True) if not port.boolean]
        # Compiled here, plain there: rounding only.
        np.testing.assert_allclose([float.fromhex(text) for text in seen[name]], expected, rtol=1e-12, atol=1e-12)
