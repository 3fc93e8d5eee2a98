"""Installing softneck compiles nothing: no program is started, and a wheel is for every platform."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# What pip calls, with every way to start a program refused (PEP 578's events).
CALL = """
import sys

def refuse(event, arguments):
    if event in {"subprocess.Popen", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn", "os.system"}:
        sys.exit(f"installing starts a program: {event} {arguments}")

sys.addaudithook(refuse)
from hatchling import build
print(getattr(build, sys.argv[1])(sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("hook", ["build_wheel", "build_editable"])
def test_installing_starts_no_program(hook: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CALL, hook, str(tmp_path)],
        cwd=ROOT, env={"PATH": ""}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    # Libraries for FMUs are data, made by `make native` before; nothing is a module in machine code.
    assert not [name for name in names if name.endswith((".so", ".pyd", ".dll", ".dylib"))]
    assert any(name.endswith("softneck.c") for name in names) == (hook == "build_wheel")


@pytest.mark.slow
def test_a_wheel_from_the_sdist_holds_every_file_once(tmp_path: Path) -> None:
    """The links at the top lead into the package: neither archive may follow them, nor lose what they lead to."""
    hook = "import sys; from hatchling import build; print(getattr(build, sys.argv[1])(sys.argv[2]))"
    for name, folder in (("build_sdist", ROOT), ("build_wheel", None)):
        if folder is None:
            with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
                archive.extractall(tmp_path, filter="data")
            folder = next(path for path in tmp_path.iterdir() if path.is_dir())
        subprocess.run([sys.executable, "-c", hook, name, str(tmp_path)], cwd=folder, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as archive:
        packed = sorted(name for name in archive.namelist() if ".dist-info/" not in name)
    built = {"__pycache__", "binaries"}
    files = (path.relative_to(ROOT) for path in (ROOT / "softneck").rglob("*") if path.is_file())
    assert packed == sorted(str(path) for path in files if not built & set(path.parts))


def test_a_program_that_is_started_would_be_seen(tmp_path: Path) -> None:
    code = CALL.partition("from hatchling")[0] + "import subprocess; subprocess.run(['true'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "installing starts a program" in done.stderr
