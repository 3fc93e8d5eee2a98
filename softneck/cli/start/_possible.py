"""What a sitting can ask of a robot: what its file has to say, and which default requirements can be kept."""

from __future__ import annotations

import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import tomli_w

from softneck.core import OutputFileError, SettingsError, atomic_write
from softneck.robot import Robot
from softneck.robot._file import KEYS

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


#: In the folder: what `tune` is asked where some of its defaults cannot be.
FILE = "requirements.toml"
_METRIC = re.compile(r"`([\w.]+)`.* cannot be: ")


def lacking(robot: Robot) -> list[str]:
    """Return what a robot's file does not say and controller and observer ask for: of motors and sensor all."""
    told = robot.as_dict()
    asked = [(table, key) for table in ("motors", "sensor") for key in KEYS[table] if key != "sign"]  # 1 where not said
    return [f"{table}.{key}" for table, key in asked if key not in told.get(table, {})]


def require_known(robot: Robot) -> None:
    """Raise SettingsError with all that a robot's file lacks at once."""
    if absent := lacking(robot):
        raise SettingsError(f"robot.toml: add {', '.join(absent)}; controller and observer need them.")


def possible(plants: tuple[str, ...]) -> str:
    """Write `FILE` without the defaults of `tune` that cannot be, and return why they cannot; empty where all can.

    Args:
        plants: files of the models that `tune` is given.

    Raises:
        SettingsError: what is asked cannot be, and no requirement is to blame.
    """
    refused = impossible(plants)
    if refused:
        said = "".join(f"# {why}\n" for why in refused.values())
        table = {"version": 1, "require": dict.fromkeys(refused, False)}
        with atomic_write(FILE, force=True) as temporary:
            head = f"# The defaults of `softneck tune` that cannot be are left out:\n{said}"
            temporary.write_text(head + tomli_w.dumps(table), encoding="utf-8")
    return " ".join(refused.values())


def impossible(plants: tuple[str, ...]) -> dict[str, str]:
    """Return metric -> why no controller keeps what the defaults of `tune` ask of it."""
    from softneck.tuning._beforehand import refuse_impossible
    from softneck.tuning._tune import task_of
    from softneck.verification._neck_loops import named_plants

    things, refused = named_plants(list(plants)), dict[str, str]()
    while True:
        task = task_of(things, {"require": dict.fromkeys(refused, False)}, 0)
        try:
            refuse_impossible(task.asked, task.plant)
        except SettingsError as error:
            metric = _METRIC.match(str(error))
            if metric is None or metric[1] in refused:
                raise
            refused[metric[1]] = str(error)
        else:
            return refused
