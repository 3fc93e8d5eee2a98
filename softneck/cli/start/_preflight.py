"""What is looked at before the first step: the disk, the C compiler and the optional packages."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from pathlib import Path

from softneck.core import OutputFileError

from ..shared._console import note

# A project of 140 s of recording takes 7 MB; what is written anew beside what it replaces takes as much again.
_LEAST_BYTES = 50_000_000
#: Kind of controller -> the package that its design needs.
_NEEDS = {"nmpc": "casadi"}


def require_disk(folder: Path) -> None:
    """Raise OutputFileError where a project does not fit beside what is there."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free
    if free < _LEAST_BYTES:
        raise OutputFileError(
            f"{folder}: only {free / 1e6:.0f} MB are free there, a project takes up to {_LEAST_BYTES / 1e6:.0f} MB; "
            "free some, or choose another folder."
        )


def backend(*, neck: bool = True) -> str:
    """Return the backend of the FMUs: "python", which is said, where none can be compiled here.

    Args:
        neck: whose parts are as large as a neck's; only libraries of those come with softneck.
    """
    from softneck.fmu.compiled import _library

    if _library.local_compiler() is not None or _library.have_zig() or (neck and _library.packaged_library()):
        return "compiled"
    note("no C compiler was found: the FMUs are written with the Python backend and need softneck where they run")
    return "python"


def has_pytest() -> bool:
    """Return whether the closed loop's test can be run."""
    return find_spec("pytest") is not None


def kinds_here(kinds: str) -> str:
    """Return the kinds of controller of a search whose packages are installed; what is left out is said."""
    absent = {kind: _NEEDS[kind] for kind in kinds.split(",") if kind in _NEEDS and find_spec(_NEEDS[kind]) is None}
    for kind, package in absent.items():
        note(f"not searched: {kind}: {package} is not installed")
    return ",".join(kind for kind in kinds.split(",") if kind not in absent)
