"""Importers that nobody here wrote accept every kind of FMU and compute what Python does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softneck.fmu import build_fmu

from ..data import slow_but
from ..importers import need
from .every_kind import KINDS, SHORT, TS, block_of, inputs_of, plain_run

SCRIPTS = Path(__file__).with_name("importers")
PACKAGES = {"libcosim": "libcosimpy", "ecos": "ecospy", "pathsim": "pathsim_fmi"}
ROWS = 60


@pytest.fixture(scope="module", params=slow_but(KINDS, SHORT, set(KINDS) - {*SHORT, "mpc"}))
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def path(kind: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(block_of(kind), tmp_path_factory.mktemp(kind) / f"{kind}.fmu")


@pytest.mark.slow
@pytest.mark.parametrize("importer", list(PACKAGES))
def test_an_importer_computes_what_python_does(importer: str, kind: str, path: Path, tmp_path: Path) -> None:
    need(PACKAGES[importer])
    block = block_of(kind)
    u = inputs_of(block, ROWS, missing=False)
    names = [port.name for port in block.inputs]
    booleans = [port.name for port in (*block.inputs, *block.outputs) if port.boolean]
    outputs = [port.name for port in block.outputs]
    job, out = tmp_path / "job.npz", tmp_path / "out.npy"
    np.savez(
        job, step=TS, inputs=u, names=names,
        booleans=np.array(booleans, dtype=str), outputs=outputs,
    )  # fmt: skip
    script = [sys.executable, str(SCRIPTS / f"{importer}.py"), str(path), str(job), str(out)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=120, check=False)
    assert out.is_file(), done.stderr[-2000:]
    seen = np.load(out)
    expected = plain_run(block, u)
    if importer == "pathsim":
        expected = expected[:, [i for i, port in enumerate(block.outputs) if not port.boolean]]
    # The same text on the same numbers, in another process: only a BLAS that sums in another order may differ.
    np.testing.assert_allclose(seen, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_fmutool_finds_it_compliant(kind: str, path: Path) -> None:
    need("fmu_manipulation_toolbox")
    tool = Path(sys.executable).with_name("fmutool")
    done = subprocess.run(
        [str(tool), "-input", str(path), "-check"], capture_output=True, text=True, timeout=120, check=False
    )
    text = done.stdout + done.stderr
    assert "seems to be compliant with FMI-2.0" in text, text[-2000:]
    assert "No semantic error" in text, text[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("command", [["info"], ["validate"], ["simulate", "--stop-time", "0.2"]], ids=lambda c: c[0])
def test_fmpys_own_command_line_works_on_it(command: list[str], kind: str, path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fmpy", command[0], str(path), *command[1:]],
        capture_output=True, text=True, timeout=120, check=False, cwd=path.parent,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-1000:]
