"""FMUs without Python: every kind equals its block, is valid, keeps its whole state, and runs in other importers."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import threading
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from softneck.design.predictive._settings import MpcNumbers
from softneck.fmu import build_compiled_fmu, build_fmu, unpacked
from softneck.runtime import Block

from ..data import slow_but
from ..oracles.bake_off import bake_off_neck
from .every_kind import FAMILIES, NATIVE, TS, as_block, block_of, inputs_of, plain_run

ROWS = 400
pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None and not os.environ.get("CI"), reason="no C compiler here, and no library is built"
)


@pytest.fixture(scope="module", params=slow_but(NATIVE, FAMILIES))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def path(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp(kind) / f"{kind}.fmu"
    build_compiled_fmu(block_of(kind), target)
    return target


def _run(fmu: Any, block: Block, u: np.ndarray, first: int = 0) -> np.ndarray:
    names, outputs = [p.name for p in block.inputs], [p.name for p in block.outputs]
    seen = []
    for k, row in enumerate(u, start=first):
        fmu.set(**dict(zip(names, row, strict=True)))
        fmu.fmu.doStep(k * TS, TS)
        seen.append(fmu.get(*outputs))
    return np.array(seen)


def _assert_equal(seen: np.ndarray, expected: np.ndarray) -> None:
    # The bound: 1e-12 of the size of the signal; measured 6e-15 at most (tanh, exp and sums in other order).
    scale = np.maximum(np.nanmax(np.abs(expected), axis=0), 1e-3)
    np.testing.assert_allclose(seen / scale, expected / scale, rtol=0, atol=1e-12)


def test_a_compiled_fmu_computes_what_the_block_does(kind: str, path: Path, running: Any) -> None:
    block = block_of(kind)
    u = inputs_of(block, ROWS)
    state = block.initial_state()
    with running(path) as fmu:
        fmu.begin(**as_block(block))
        _assert_equal(np.array([fmu.get(*[p.name for p in block.outputs])]), state.outputs[None])
        _assert_equal(_run(fmu, block, u), block.run(state, u)[1])


@pytest.mark.slow
def test_a_payload_pulls_tendons_tauter_in_c_as_well(tmp_path: Path, running: Any) -> None:
    settings = MpcNumbers(bandwidth=6.0, moves=5, minimum_tautness=0.2, payload_tautness=1.0)
    block = settings.design(bake_off_neck()).block()
    path = tmp_path / "mpc.fmu"
    build_compiled_fmu(block, path)
    u = inputs_of(block, ROWS)
    u[:, [port.name for port in block.inputs].index("payload")] += 1.0
    with running(path) as fmu:
        fmu.begin(**as_block(block))
        seen = _run(fmu, block, u)
    # A limit of weight 1e3 makes the QP worse conditioned than the others' sums; its solver ends at 1e-10 rad.
    np.testing.assert_allclose(seen, block.run(block.initial_state(), u)[1], rtol=0, atol=1e-10)


def test_it_has_the_variables_of_the_python_one(kind: str, path: Path, tmp_path: Path) -> None:
    assert validate_fmu(str(path)) == []
    other = fmpy.read_model_description(str(build_fmu(block_of(kind), tmp_path / path.name)))
    facts = [
        [(v.name, v.valueReference, v.causality, v.variability, v.start, v.unit, v.min) for v in m.modelVariables]
        for m in (fmpy.read_model_description(str(path)), other)
    ]  # fmt: skip
    assert facts[0] == facts[1]


def test_the_whole_state_replays_to_the_bit(kind: str, path: Path, running: Any) -> None:
    block = block_of(kind)
    u = inputs_of(block, 60)
    noise = {"noise_std": 0.01, "noise_seed": 4.0} if "noise_std" in {p.name for p in block.parameters} else {}
    with running(path) as one, running(path) as two:
        one.begin(**noise)
        _run(one, block, u[:30])
        text = one.fmu.serializeFMUstate(one.fmu.getFMUstate())
        expected = _run(one, block, u[30:], 30)
        two.begin()
        _run(two, block, u[:7])
        two.fmu.setFMUstate(two.fmu.deSerializeFMUstate(text))
        np.testing.assert_array_equal(_run(two, block, u[30:], 30), expected)
        two.fmu.reset()
        two.begin(**noise)
        np.testing.assert_array_equal(_run(two, block, u[30:], 0).shape, expected.shape)


def test_fmi3_computes_the_same_bits(kind: str, path: Path, tmp_path: Path, running: Any) -> None:
    block = block_of(kind)
    u = inputs_of(block, 60)
    build_compiled_fmu(block, tmp_path / f"{kind}.fmu", fmi=3)
    assert validate_fmu(str(tmp_path / f"{kind}.fmu")) == []
    with running(path) as two:
        two.begin()
        expected = _run(two, block, u)
    with unpacked(tmp_path / f"{kind}.fmu") as folder:
        seen = _run3(folder, block, u)
    np.testing.assert_array_equal(seen, expected)


def _run3(folder: Path, block: Block, u: np.ndarray) -> np.ndarray:
    model = fmpy.read_model_description(str(folder))
    assert model.coSimulation is not None
    name = model.coSimulation.modelIdentifier
    fmu = FMU3Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier=name, instanceName="three")
    fmu.instantiate()
    fmu.enterInitializationMode(startTime=0.0)
    fmu.exitInitializationMode()
    n_in, booleans = len(block.inputs), [i for i, port in enumerate(block.inputs) if port.boolean]
    reals = [i for i in range(n_in) if i not in booleans]
    seen, saved = np.zeros((len(u), len(block.outputs))), b""
    for k, row in enumerate(u):
        if k == len(u) // 2:  # there and back again
            state = fmu.getFMUState()
            saved = fmu.serializeFMUState(state)
            fmu.freeFMUState(state)
            state = fmu.deserializeFMUState(saved)
            fmu.setFMUState(state)
            fmu.freeFMUState(state)
        if reals:
            fmu.setFloat64(reals, row[reals].tolist())
        if booleans:
            fmu.setBoolean(booleans, [bool(row[i]) for i in booleans])
        fmu.doStep(currentCommunicationPoint=k * TS, communicationStepSize=TS)
        for i, port in enumerate(block.outputs):
            seen[k, i] = (fmu.getBoolean if port.boolean else fmu.getFloat64)([n_in + i])[0]
    time = fmu.getFloat64([v.valueReference for v in model.modelVariables if v.causality == "independent"])[0]
    assert time == pytest.approx(len(u) * TS, rel=1e-12)
    fmu.terminate()
    fmu.freeInstance()
    return seen


def test_a_seed_is_an_integer(tmp_path: Path, running: Any) -> None:
    """Int32 in FMI 3.0, Integer in FMI 2.0; the same noise out of both."""
    block, noise = block_of("rls"), [port.name for port in block_of("rls").parameters].index("noise_std")
    first = len(block.inputs) + len(block.outputs)
    for fmi in (2, 3):
        build_compiled_fmu(block, tmp_path / f"Rls{fmi}.fmu", fmi=fmi)
    with running(tmp_path / "Rls2.fmu") as fmu:
        fmu.begin(noise_std=0.1, noise_seed=7.0)
        fmu.fmu.doStep(0.0, TS)
        expected = fmu.get("pitch", "roll")
    with unpacked(tmp_path / "Rls3.fmu") as folder:
        model = fmpy.read_model_description(str(folder))
        seed = next(v for v in model.modelVariables if v.name == "noise_seed")
        assert (seed.type, seed.start, seed.min, seed.max) == ("Int32", "0", "0", "2147483647")
        fmu = FMU3Slave(guid=model.guid, unzipDirectory=str(folder), modelIdentifier="Rls3", instanceName="three")
        fmu.instantiate()
        fmu.setFloat64([first + noise], [0.1])
        fmu.setInt32([seed.valueReference], [7])
        fmu.enterInitializationMode(startTime=0.0)
        fmu.exitInitializationMode()
        fmu.doStep(currentCommunicationPoint=0.0, communicationStepSize=TS)
        assert list(fmu.getInt32([seed.valueReference])) == [7]
        assert list(fmu.getFloat64([len(block.inputs), len(block.inputs) + 1])) == expected
        for wrong in (first + noise, seed.valueReference + 100):  # a Float64, and no variable at all
            with pytest.raises(FMICallException):
                fmu.getInt32([wrong])
        fmu.freeInstance()
    assert 0.0 not in expected


def test_the_same_block_gives_the_same_bytes(kind: str, path: Path, tmp_path: Path) -> None:
    build_compiled_fmu(block_of(kind), tmp_path / path.name)
    assert (tmp_path / path.name).read_bytes() == path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
    assert {"modelDescription.xml", "resources/model.bin", "sources/softneck.c", "sources/README.txt"} <= names


@pytest.mark.slow
def test_instances_in_threads_do_not_disturb_each_other(tmp_path: Path, running: Any) -> None:
    build_compiled_fmu(block_of("residual"), tmp_path / "Residual.fmu")
    block, u = block_of("residual"), inputs_of(block_of("residual"), 200)
    results: list[np.ndarray] = []

    def one(fmu: Any) -> None:
        fmu.begin()
        results.append(_run(fmu, block, u))

    with ExitStack() as stack:
        # Loading is for one thread: fmpy changes the directory of the process meanwhile.
        fmus = [stack.enter_context(running(tmp_path / "Residual.fmu")) for _ in range(4)]
        threads = [threading.Thread(target=one, args=(fmu,)) for fmu in fmus]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(results) == 4
    for seen in results[1:]:
        np.testing.assert_array_equal(seen, results[0])


SCRIPTS = Path(__file__).with_name("importers")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("importer", "name"),
    [("libcosim", "nlsm"), ("libcosim", "neck"), ("ecos", "guarded"), ("ecos", "kalman"), ("pathsim", "pi")],
)
def test_an_importer_computes_what_python_does(importer: str, name: str, tmp_path: Path) -> None:
    package = {"libcosim": "libcosimpy", "ecos": "ecospy", "pathsim": "pathsim_fmi"}[importer]
    if importlib.util.find_spec(package) is None and not os.environ.get("CI"):
        pytest.skip(f"not installed: {package}")
    path, block = tmp_path / f"{name}.fmu", block_of(name)
    build_compiled_fmu(block, path)
    u = inputs_of(block, 60, missing=False)
    booleans = [port.name for port in (*block.inputs, *block.outputs) if port.boolean]
    np.savez(
        tmp_path / "job.npz", step=TS, inputs=u, names=[port.name for port in block.inputs],
        booleans=np.array(booleans, dtype=str), outputs=[port.name for port in block.outputs],
    )  # fmt: skip
    out = tmp_path / "out.npy"
    script = [sys.executable, str(SCRIPTS / f"{importer}.py"), str(path), str(tmp_path / "job.npz"), str(out)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=120, check=False)
    assert out.is_file(), done.stderr[-2000:]
    expected = plain_run(block, u)
    if importer == "pathsim":
        expected = expected[:, [i for i, port in enumerate(block.outputs) if not port.boolean]]
    _assert_equal(np.load(out), expected)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_fmutool_finds_it_compliant(fmi: int, tmp_path: Path) -> None:
    tool = Path(sys.executable).with_name("fmutool")
    if not tool.is_file() and not os.environ.get("CI"):
        pytest.skip("not installed: fmu-manipulation-toolbox")
    build_compiled_fmu(block_of("kalman"), tmp_path / "Kalman.fmu", fmi=fmi)
    command = [str(tool), "-input", str(tmp_path / "Kalman.fmu"), "-check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    text = done.stdout + done.stderr
    assert f"seems to be compliant with FMI-{fmi}.0" in text, text[-2000:]
    assert "No semantic error" in text or fmi == 3, text[-2000:]  # the tool checks the semantics of FMI 2 alone
