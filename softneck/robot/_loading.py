"""Loading of models, families, observers and controllers for a given robot."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from softneck.core import DataError, SettingsError, load

from ._robot import Robot
from ._search import find_robot, robot_file_of

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
        raise SettingsError(f"{_a(role or 'thing')} or its file is needed; got a {type(thing).__name__}.")
    own = getattr(found, "robot", None)
    if own is None or (robot is None and (path is None or robot_file_of(path) is None)):
        return found
    given = find_robot(robot, beside=path)
    if given.hash != own.hash:
        raise DataError(f"{path or 'it'}: is of robot {own.label()}, not of {given.label()}.")
    # A controller keeps its limits, as it was designed for them.
    return replace(found, robot=given) if "robot" in (field.name for field in fields(found)) else found


def _a(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"
