"""Builds the small C plant of `foreign/` as an FMU, with the machine's own compiler."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

SOURCES = Path(__file__).with_name("foreign")
NAMES = {f"u{j}": f"motor_setpoint_{j}" for j in (1, 2, 3)} | {"alpha": "pitch", "beta": "roll"}


def build_foreign(folder: Path, version: int) -> Path:
    """Compile and pack the plant as an FMU of that FMI version."""
    compiler = [shutil.which("cc") or ""] if shutil.which("cc") else [sys.executable, "-m", "ziglang", "cc"]
    library = folder / f"Foreign{version}.so"
    # FMI wants every call exported; those that the plant does not have answer "error".
    calls = [name for name in dir(FMU2Slave if version == 2 else FMU3Slave) if name.startswith(f"fmi{version}")]
    stubs = folder / f"stubs{version}.c"
    stubs.write_text("".join(f"__attribute__((weak)) int {name}(void) {{ return 3; }}\n" for name in calls))
    headers = Path(fmpy.__file__).parent / "c-code"
    command = [*compiler, "-shared", "-fPIC", "-O1", f"-DFMI={version}", f"-I{headers}"]
    done = subprocess.run(
        [*command, str(SOURCES / "plant.c"), str(stubs), "-o", str(library), "-lm"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        pytest.skip(f"no C compiler: {done.stderr[-300:]}")
    path = folder / f"Foreign{version}.fmu"
    place = fmpy.platform if version == 2 else fmpy.platform_tuple
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(SOURCES / f"modelDescription{version}.xml", "modelDescription.xml")
        archive.write(library, f"binaries/{place}/Foreign.so")
    return path
