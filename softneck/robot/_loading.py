"""Find the robot of a file, and load models, observers and controllers for a robot."""

from __future__ import annotations

import logging
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from softneck.core import DataError, SettingsError, as_path, load

from ._file import ROBOT_PRESETS, shortest_path
from ._robot import Robot

ROBOT_FILE = "robot.toml"
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
    return next((folder / ROBOT_FILE for folder in folders if (folder / ROBOT_FILE).is_file()), None)


def _read_named(given: str | Path) -> Robot:
    as_path(given)
    if str(given) in ROBOT_PRESETS:
        return Robot.preset(str(given))
    if not Path(given).is_file():
        raise SettingsError(f"`{given}` is neither a robot preset ({', '.join(ROBOT_PRESETS)}) nor a file.")
    return Robot.read(given)


# Role -> a method that its objects have.
_METHOD_OF_ROLE = {"model": "simulate", "observer": "block", "controller": "block"}


def load_for_robot(thing: Any, role: str | None = None, robot: str | Path | Robot | None = None) -> Any:
    """Return a model, family, observer or controller, or load it from its file, with the robot's limits and sensor.

    Args:
        thing: a model, family, observer or controller, or its file.
        role: "model", "observer" or "controller" if only that is accepted.
        robot: as for `find_robot`; None: `robot.toml` beside the file or above it, else the robot in the file.

    Raises:
        DataError: the thing is for a robot with other channels, units or directions; the message names both.
        FileFormatError: no such file, or a file of another role.
        SettingsError: a thing of another role.
    """
    path = thing if isinstance(thing, str | Path) else None
    found: Any = thing if path is None else load(path, role=role)
    if path is None and (isinstance(thing, type) or not hasattr(thing, _METHOD_OF_ROLE.get(role or "", "__class__"))):
        wanted = role or "thing"
        article = "an" if wanted[0] in "aeiou" else "a"
        raise SettingsError(f"{article} {wanted} or its file is needed; got a {type(thing).__name__}.")
    own = getattr(found, "robot", None)
    if own is None or (robot is None and (path is None or robot_file_of(path) is None)):
        return found
    given = find_robot(robot, beside=path)
    if given.hash != own.hash:
        raise DataError(f"{path or 'it'}: is of robot {own.label()}, not of {given.label()}.")
    given = given.with_rest(own.motors.rest, own.outputs.rest)
    # A controller keeps its limits, as it was designed for them.
    return replace(found, robot=given) if "robot" in (field.name for field in fields(found)) else found
