"""Files of ours that are of the robot that `--robot` names."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from softneck.core import DataError, load
from softneck.robot import find_robot
from softneck.robot._search import robot_file_of


def load_of(path: Path, robot: str | None, *, role: str | None = None) -> Any:
    """Open a file of ours; limits, rates and sensor of a model's robot are those of the one that is asked for.

    Args:
        path: of a model, family, observer or controller.
        robot: a preset or a robot file; None: `robot.toml` beside `path` or above it, else what the file says.
        role: as `softneck.core.load` takes it.

    Raises:
        DataError: the file is of a robot with other channels, units or directions; the line names both.
    """
    thing = load(path) if role is None else load(path, role=role)
    said = getattr(thing, "robot", None)
    if said is None or (robot is None and robot_file_of(path) is None):
        return thing
    asked = find_robot(robot, beside=path)
    if asked.hash != said.hash:
        raise DataError(f"{path}: is of robot {said.label()}, not of {asked.label()}.")
    # Limits of a controller are its own: they were designed for.
    return replace(thing, robot=asked) if "robot" in (field.name for field in fields(thing)) else thing
