"""Files of ours, and what stands for them, as those of the robot that is asked for."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from softneck.core import DataError, SettingsError, load

from ._robot import Robot
from ._search import find_robot, robot_file_of

# What a thing of a role can do at least.
_CAN = {"model": "simulate", "observer": "block", "controller": "block"}


def opened(thing: Any, role: str | None = None, robot: str | Path | Robot | None = None) -> Any:
    """Return `thing`, or what its file holds where it is a path; limits and sensor are those of the robot asked for.

    Args:
        thing: a model, family, observer or controller, or its file.
        role: "model", "observer" or "controller" when only that will do.
        robot: as `find_robot` takes it; None: `robot.toml` beside the file or above it, else what the file says.

    Raises:
        DataError: the thing is of a robot with other channels, units or directions; the line names both.
        FileFormatError: no such file, or not one of that role.
        SettingsError: not a thing of that role.
    """
    path = thing if isinstance(thing, str | Path) else None
    found: Any = thing if path is None else load(path, role=role)
    if path is None and (isinstance(thing, type) or not hasattr(thing, _CAN.get(role or "", "__class__"))):
        raise SettingsError(f"{_a(role or 'thing')} or its file is needed; got a {type(thing).__name__}.")
    said = getattr(found, "robot", None)
    if said is None or (robot is None and (path is None or robot_file_of(path) is None)):
        return found
    asked = find_robot(robot, beside=path)
    if asked.hash != said.hash:
        raise DataError(f"{path or 'it'}: is of robot {said.label()}, not of {asked.label()}.")
    # Limits of a controller are its own: they were designed for.
    return replace(found, robot=asked) if "robot" in (field.name for field in fields(found)) else found


def _a(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"
