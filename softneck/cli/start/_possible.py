"""What a sitting can ask of a robot: what its file has to say, and which default requirements can be kept."""

from __future__ import annotations

import re

import tomli_w

from softneck.core import SettingsError, atomic_write
from softneck.robot import Robot
from softneck.robot._file import KEYS

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
