"""`make wheel` ends with this: the wheel holds what it must, and exports compiled FMUs where there is no compiler.

python tests/nightly/wheel.py build/dist/softneck-*.whl

The wheel is installed into a new venv, which borrows the dependencies of this Python and nothing else: not the checkout
that is installed beside them. PATH is empty, the cache too, and starting any program is an error.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from pathlib import Path

NATIVE = "softneck/fmu/compiled/binaries/"
PLATFORMS = ("x86_64-linux.so", "aarch64-linux.so", "x86_64-windows.dll", "x86_64-darwin.dylib", "aarch64-darwin.dylib")
SCRIPT = """
import os, subprocess, sys, time, zipfile
from pathlib import Path
import fmpy, numpy as np, softneck.plant
from softneck.cli import main
def refused(command, *arguments, **options):
    assert command[0] == "fc-list", f"exporting started {command}"  # matplotlib looks for fonts
    raise FileNotFoundError(command)
subprocess.Popen = os.system = refused
assert Path(softneck.plant.__file__).is_relative_to(sys.prefix), softneck.plant.__file__
for fmi, count in ((2, 3), (3, 5)):
    out = Path(f"Neck{fmi}.fmu")
    sys.argv = ["softneck", "fmu", "paper", "--backend", "compiled", "--fmi", str(fmi), "-o", str(out)]
    began = time.perf_counter()
    try:
        main()
    except SystemExit as end:
        assert not end.code, end.code
    spent = time.perf_counter() - began
    names = [name for name in zipfile.ZipFile(out).namelist() if name.startswith("binaries/")]
    assert len(names) == count, names
    result = fmpy.simulate_fmu(str(out), stop_time=1.0, output_interval=0.02, validate=True)
    assert len(result) > 50 and all(np.isfinite(result[name]).all() for name in result.dtype.names)
    size = out.stat().st_size / 1e3
    print(f"FMI {fmi}: {count} platforms, {size:.0f} kB, written in {spent:.2f} s, fmpy ran {len(result)} rows")
"""


def check(wheel: Path) -> str:
    """Return what was found; raise SystemExit with what is wrong."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        missing = [name for name in PLATFORMS if f"{NATIVE}{name}.deflate" not in names]
        if missing:
            raise SystemExit(f"{wheel.name}: has no library for {', '.join(missing)}; run `make native`.")
        strange = [
            name
            for name in names
            if not re.match(r"softneck(/|-[\w.]+\.dist-info/)", name) or re.search(r"/test_[^/]*[.]py$", name)
        ]
        if strange:
            raise SystemExit(f"{wheel.name}: holds {', '.join(strange[:5])}.")
        for name in names:
            if re.search(rb"index-url|/simple/", archive.read(name)):
                raise SystemExit(f"{wheel.name}: {name} names a package registry.")
    with tempfile.TemporaryDirectory(prefix="softneck-wheel-") as folder:
        return _export(wheel.resolve(), Path(folder))


def _export(wheel: Path, folder: Path) -> str:
    venv.create(folder / "venv", with_pip=False, symlinks=os.name != "nt")
    python = str(folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True, timeout=300)
    place = [python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"]
    packages = Path(subprocess.run(place, check=True, capture_output=True, text=True, timeout=60).stdout.strip())
    # Folders named in a .pth file are searched, their own .pth files (an editable softneck) are not read.
    borrowed = {sysconfig.get_paths()[key] for key in ("purelib", "platlib")}
    (packages / "borrowed.pth").write_text("".join(f"{path}\n" for path in sorted(borrowed)))
    environment = {key: value for key, value in os.environ.items() if key not in ("CC", "PYTHONPATH")}
    environment |= {"PATH": "", "XDG_CACHE_HOME": str(folder / "cache"), "SOFTNECK_FMU_NUMBA": "0"}
    done = subprocess.run(
        [python, "-c", SCRIPT], env=environment, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    if done.returncode != 0:
        raise SystemExit(f"exporting from the wheel failed:\n{done.stdout}{done.stderr[-2000:]}")
    return "\n".join(line for line in done.stdout.splitlines() if line.startswith("FMI "))


if __name__ == "__main__":
    for path in sys.argv[1:]:
        sys.stdout.write(f"{Path(path).name}:\n{check(Path(path))}\n")
