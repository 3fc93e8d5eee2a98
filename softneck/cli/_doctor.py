"""softneck doctor: which parts of this machine work."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from importlib import metadata

import click

from softneck import fmu
from softneck.core import FileFormatError

from .shared._console import print_json, print_table
from .shared._options import common_options


@click.command("doctor", epilog="Example: softneck doctor --json")
@common_options()
def command(as_json: bool) -> None:
    """Check this machine: packages, compilers, FMU platforms, CAN, extras."""
    python = _check("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    checks = [python, *_packages(), _compiler(), _fmu_platform(), _compiled_fmus(), _can(), *_extras()]
    bad = [check for check in checks if check["state"] == "missing"]
    if as_json:
        print_json({"checks": checks, "healthy": not bad})
    else:
        rows = [[check["name"], check["state"], check["detail"]] for check in checks]
        print_table("softneck doctor", ["what", "state", "detail"], rows)
    click.get_current_context().exit(1 if bad else 0)


def _check(name: str, state: str, detail: str) -> dict[str, str]:
    return {"name": name, "state": state, "detail": detail}


def _requirements() -> list[str]:
    """Return the names of all packages that the installed softneck requires."""
    asked = [line for line in metadata.requires("softneck") or [] if "extra ==" not in line]
    return [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in asked]


def _packages() -> list[dict[str, str]]:
    found = []
    for name in _requirements():
        try:
            found.append(_check(name, "ok", metadata.version(name)))
        except metadata.PackageNotFoundError:
            found.append(_check(name, "missing", f"pip install {name}"))
    return found


def _compiler() -> dict[str, str]:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler:
        return _check("C compiler", "ok", compiler)
    if importlib.util.find_spec("ziglang"):
        return _check("C compiler", "ok", "ziglang wheel")
    return _check("C compiler", "absent", "not needed: a wheel brings compiled FMUs along")


def _fmu_platform() -> dict[str, str]:
    from pythonfmu.builder import FmuBuilder

    if FmuBuilder.has_binary():
        return _check("pythonfmu binary", "ok", f"{platform.system()} {platform.machine()}")
    return _check("pythonfmu binary", "missing", "pythonfmu ships linux64 and win64 only; FMUs will not run here")


def _compiled_fmus() -> dict[str, str]:
    try:
        built, how = fmu.platforms_built()
    except FileFormatError as error:
        return _check("compiled FMUs", "missing", str(error))
    if not built:
        return _check("compiled FMUs", "optional", how)
    state = "ok" if len(built) == len(fmu.PLATFORMS) else "optional"
    return _check("compiled FMUs", state, f"{', '.join(built)} ({how})")


def _can() -> dict[str, str]:
    ip = shutil.which("ip")
    if ip is None or not sys.platform.startswith("linux"):
        return _check("CAN interfaces", "absent", "iproute2 is not installed" if ip is None else "no SocketCAN here")
    shown = subprocess.run([ip, "-o", "link", "show", "type", "can"], capture_output=True, text=True, check=False)
    names = [line.split(":")[1].strip() for line in shown.stdout.splitlines() if ":" in line]
    return _check("CAN interfaces", "ok" if names else "absent", ", ".join(names) or "none; drives can be simulated")


def _extras() -> list[dict[str, str]]:
    dask = "ok" if importlib.util.find_spec("distributed") else "absent"
    jit = "off by NUMBA_DISABLE_JIT" if os.environ.get("NUMBA_DISABLE_JIT", "0") != "0" else "on"
    return [
        _check("extra dask", dask, "studies on a cluster"),
        _check("compiled runtimes", "ok" if jit == "on" else "absent", f"numba {jit}"),
    ]
