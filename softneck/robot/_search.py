"""Which robot a file belongs to: the one that is named, the one beside the file or above it, else the neck."""

from __future__ import annotations

import logging
from pathlib import Path

from softneck.core import SettingsError
from softneck.core._files import as_path

from ._file import PRESETS, shown
from ._robot import Robot

FILE = "robot.toml"
_LOG = logging.getLogger(__name__)


def find_robot(given: str | Path | Robot | None = None, *, beside: str | Path | None = None) -> Robot:
    """Return the robot that is `given`, else that of `robot.toml` beside or above `beside`, else the neck.

    A file that was found and not given is named in the log `softneck.robot`, at level INFO; the commands print it.

    Args:
        given: a robot, a preset's name or a robot file; None: look for it.
        beside: the file that is worked on; None: do not look.

    Raises:
        SettingsError: neither a preset nor a robot file, or one with a fault; the line says which.
    """
    if isinstance(given, Robot):
        return given
    if given is not None:
        return _named(given)
    found = robot_file_of(beside) if beside is not None else None
    if found is None:
        return Robot.preset("neck")
    robot = Robot.read(found)
    _LOG.info("robot: %s, from %s", robot.name, shown(found))
    return robot


def robot_file_of(beside: str | Path) -> Path | None:
    """Return the `robot.toml` in the folder of the file `beside` or in one above it; None where there is none."""
    folders = Path(beside).resolve().parents
    return next((folder / FILE for folder in folders if (folder / FILE).is_file()), None)


def _named(given: str | Path) -> Robot:
    as_path(given)
    if str(given) in PRESETS:
        return Robot.preset(str(given))
    if not Path(given).is_file():
        raise SettingsError(f"`{given}` is neither a robot preset ({', '.join(PRESETS)}) nor a file.")
    return Robot.read(given)
