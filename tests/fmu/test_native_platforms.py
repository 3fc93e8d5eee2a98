"""Other platforms give the bits of this one: Windows under wine, aarch64 under qemu; run by `make nightly`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softneck.fmu.compiled._compilers import PLATFORMS, compile_for, have_zig
from softneck.fmu.compiled._model_file import model_bytes
from softneck.fmu.compiled._sources import c_sources
from softneck.runtime import Block

from .every_kind import NATIVE, TS, block_of, inputs_of

ROWS = 200
GUID = "00000000-0000-0000-0000-000000000000"
# Debian: wine64; qemu-user and libc6-arm64-cross. The second one has no AVX2: it takes the other way through sn_wide.h.
RUNNERS = {
    "x86_64-linux": [],
    "x86_64-linux, old": ["qemu-x86_64", "-cpu", "Nehalem"],
    "x86_64-windows": ["wine64"],
    "aarch64-linux": ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"],
}
pytestmark = pytest.mark.skipif(
    not os.environ.get("SOFTNECK_NIGHTLY"), reason="cross-compiles for minutes and needs wine and qemu: make nightly"
)


def _runner(platform: str) -> list[str]:
    command = RUNNERS[platform]
    if not command:
        return []
    places = (shutil.which(command[0]), f"/usr/lib/wine/{command[0]}")
    found = next((place for place in places if place and Path(place).is_file()), None)
    assert found is not None, f"{command[0]} is not here; `make nightly` says which Debian packages it needs"
    return [found, *command[1:]]


@pytest.fixture(scope="module", params=list(RUNNERS))
def machine(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A folder with library and host of one platform."""
    assert have_zig(), "pip install --group native"
    platform = PLATFORMS[request.param.partition(",")[0]]
    folder = tmp_path_factory.mktemp(platform.name)
    (folder / f"softneck{platform.suffix}").write_bytes(compile_for(c_sources(), platform))
    host = Path(__file__).with_name("native_host.c")
    command = [sys.executable, "-m", "ziglang", "cc", "-target", platform.target, "-w", "-o", str(folder / "host.exe")]
    subprocess.run([*command, str(host)], check=True, capture_output=True, timeout=600)
    if platform.name == "x86_64-windows":
        # The first start makes a configuration and leaves services behind; a pipe that they inherit would never end.
        command = [*_runner(platform.name), "cmd", "/c", "exit"]
        null = subprocess.DEVNULL
        subprocess.run(command, env=_wine(folder), check=False, timeout=300, stdin=null, stdout=null, stderr=null)
    return request.param, folder


def _wine(folder: Path) -> dict[str, str]:
    return os.environ | {"WINEDEBUG": "-all", "WINEPREFIX": str(folder.parent / "wine")}


def _mask(ports: tuple, wanted: bool = True) -> str:
    return str(sum(1 << i for i, port in enumerate(ports) if port.boolean is wanted))


def _outputs(machine: tuple[str, Path], block: Block, u: np.ndarray, resources: Path) -> np.ndarray:
    platform, folder = machine
    library = folder / f"softneck{PLATFORMS[platform.partition(',')[0]].suffix}"
    sizes = [str(len(block.inputs)), str(len(block.outputs)), repr(TS), str(len(u))]
    # wine's drive Z: is the root.
    place = f"file:///Z:{resources}" if platform == "x86_64-windows" else f"file://{resources}"
    path = f"Z:{library}" if platform == "x86_64-windows" else str(library)
    environment = _wine(folder) | {"IN_BOOLEANS": _mask(block.inputs), "OUT_BOOLEANS": "0"}
    done = subprocess.run(
        [*_runner(platform), str(folder / "host.exe"), path, place, GUID, *sizes], input=u.astype("<f8").tobytes(),
        capture_output=True, env=environment, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode(errors="replace")[-2000:]
    return np.frombuffer(done.stdout, dtype="<f8").reshape(len(u), len(block.outputs))


_SEEN: dict[str, np.ndarray] = {}


@pytest.mark.parametrize("kind", NATIVE)
def test_all_platforms_give_the_same_bits(kind: str, machine: tuple[str, Path], tmp_path: Path) -> None:
    block = block_of(kind)
    u = inputs_of(block, ROWS)
    (tmp_path / "model.bin").write_bytes(model_bytes(block, kind, GUID))
    seen = _outputs(machine, block, u, tmp_path)
    expected = block.run(block.initial_state(), u)[1]
    scale = np.maximum(np.nanmax(np.abs(expected), axis=0), 1e-3)
    # As in test_native_kinds.py; between the platforms not one bit may differ.
    np.testing.assert_allclose(seen / scale, expected / scale, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(seen, _SEEN.setdefault(kind, seen))
