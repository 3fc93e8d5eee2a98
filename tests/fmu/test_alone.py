"""An FMU runs where softneck is not, whatever softneck or another environment has left in the shared cache folder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from softneck.fmu import build_fmu
from softneck.identification import Rls
from softneck.runtime._compile import have_numba

from ..data import short_neck

pytestmark = [
    pytest.mark.skipif(not have_numba(), reason="numba is not installed"),
    pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is moved by XDG_CACHE_HOME"),
]
# Of kind `rls`, whose step assigns slices: compiled by softneck it refers to a function of softneck's.
_SOFTNECK = """
import sys, softneck
block = softneck.load(sys.argv[2]).block()
state = block.initial_state()
for _ in range(5):
    state, outputs = block.step(state, [port.start for port in block.inputs])
print(*outputs[:2])
"""
_FMPY = """
import sys
from fmpy import simulate_fmu
found = simulate_fmu(sys.argv[1], stop_time=0.1, step_size=0.02, output_interval=0.02)
print(*[found[-1][name] for name in ("pitch", "roll")])
"""
_ALONE = f"import sys; sys.modules['softneck'] = None\n{_FMPY}"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The FMU of a model, and its file."""
    folder, model = tmp_path_factory.mktemp("alone"), Rls(delay=0.06).fit(short_neck())
    model.save(folder / "rls.npz")
    return build_fmu(model.block(), folder / "Rls.fmu"), folder / "rls.npz"


def _run(code: str, files: tuple[Path, Path], cache: Path, switch: str = "1") -> tuple[list[float], str]:
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "SOFTNECK_FMU_NUMBA": switch}
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, files)], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return [float(word) for word in done.stdout.split()], done.stderr


def _same(one: list[float], other: list[float]) -> bool:
    # Two compilations of one text; 5 steps of a stable model add their rounding to less than 1e-12.
    return one == pytest.approx(other, rel=1e-12, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("first", ["softneck", "alone"])
def test_two_environments_share_a_cache_folder(first: str, files: tuple[Path, Path], tmp_path: Path) -> None:
    order = [_SOFTNECK, _ALONE] if first == "softneck" else [_ALONE, _SOFTNECK]
    (one, _), (other, said) = _run(order[0], files, tmp_path), _run(order[1], files, tmp_path)
    assert _same(one, other)
    assert "which failed" not in said
    assert {path.name.split("-")[0] for path in (tmp_path / "softneck" / "runtime").iterdir()} == {"softneck", "fmu"}
    # Once compiled it is there; and an entry that names a module of another environment is compiled anew.
    for damaged in (False, True):
        for path in tmp_path.rglob("*.nbc") if damaged else ():
            path.write_bytes(b"csoftneck_absent\nthing\n.")  # pickle's line for a name of a module
        found, said = _run(_ALONE, files, tmp_path)
        assert (_same(found, one), said) == (True, "")


def test_a_numba_that_fails_leaves_plain_python(files: tuple[Path, Path], tmp_path: Path) -> None:
    broken = (
        "import numba.core.dispatcher as numba\n"
        "def fail(*_): raise RuntimeError('no LLVM')\n"
        "numba.Dispatcher.compile = fail\n"
    )
    expected, _ = _run(_ALONE, files, tmp_path, "0")
    found, said = _run(broken + _ALONE, files, tmp_path)
    assert found == expected
    assert "Rls: runs without numba, which failed: no LLVM" in said
