"""Search for the robot of a file: the given one, that of `robot.toml` beside or above the file, else the neck."""

from __future__ import annotations

import logging
from pathlib import Path

from softneck.core import SettingsError, as_path

from ._file import PRESETS, shortest_path
from ._robot import Robot

FILE = "robot.toml"
_LOG = logging.getLogger(__name__)


def find_robot(given: str | Path | Robot | None = None, *, beside: str | Path | None = None) -> Robot:
    """Return the robot that is `given`, else that of `robot.toml` beside or above `beside`, else the neck.

    A file that was found by search is logged by `softneck.robot` at level INFO; the commands print it.

    Args:
        given: a robot, a preset's name or a robot file; None: look for it.
        beside: the file in use; None: do not look.

    Raises:
        SettingsError: neither a preset nor a robot file, or a file with an error; the message names it.
    """
    if isinstance(given, Robot):
        return given
    if given is not None:
        return _read_named(given)
    found = robot_file_of(beside) if beside is not None else None
    if found is None:
        return Robot.preset("neck")
    robot = Robot.read(found)
    _LOG.info("robot: %s, from %s", robot.name, shortest_path(found))
    return robot


def robot_file_of(beside: str | Path) -> Path | None:
    """Return the `robot.toml` in the folder of the file `beside` or in one above it; None if there is none."""
    folders = Path(beside).resolve().parents
    return next((folder / FILE for folder in folders if (folder / FILE).is_file()), None)


def _read_named(given: str | Path) -> Robot:
    as_path(given)
    if str(given) in PRESETS:
        return Robot.preset(str(given))
    if not Path(given).is_file():
        raise SettingsError(f"`{given}` is neither a robot preset ({', '.join(PRESETS)}) nor a file.")
    return Robot.read(given)
