"""softneck robot: the file that says what a robot is."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import SettingsError, atomic_write
from softneck.core._budget import settings_text

from .shared._console import print_json
from .shared._groups import NearGroup
from .shared._options import force_option, json_option

if TYPE_CHECKING:
    from softneck.robot import Robot


@click.group(
    "robot", cls=NearGroup, epilog="Example: softneck robot new --preset antagonist, then softneck robot check"
)
def command() -> None:
    """Say what the robot is: its motors, outputs, directions and limits (`robot.toml`).

    Presets: neck (the paper's), arm, antagonist, finger, trunk4. Without FILE: `robot.toml` in this folder or
    one above it, else the preset neck. Each takes `--json`.
    """


@command.command("show")
@click.argument("file", required=False, metavar="[FILE|PRESET]")
@json_option
def show(file: str | None, as_json: bool) -> None:
    """Show what is given and what is not."""
    robot = _robot(file)
    if as_json:
        print_json({**robot.as_dict(), "hash": robot.hash})
        return
    click.echo(f"{robot.summary()}\nhash: {robot.hash}")


@command.command("new")
@click.argument("file", required=False, default="robot.toml", type=click.Path(path_type=Path))
@click.option("--preset", default="neck", show_default=True, metavar="PRESET|FILE", help="Which robot to begin with.")
@force_option
@json_option
def new(file: Path, preset: str, force: bool, as_json: bool) -> None:
    """Write a preset, or another robot's file, into FILE (robot.toml), to edit."""
    from softneck.robot._file import PRESETS, preset_text

    if file.suffix.lower() != ".toml":
        raise SettingsError(f"{file}: must end in `.toml`, by which softneck recognises the file.")
    taken = preset not in PRESETS and Path(preset).is_file()
    text = _moved(Path(preset), file.parent) if taken else preset_text(preset)
    with atomic_write(file, force=force) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if as_json:
        print_json({"file": str(file), "preset": preset})
        return
    what = f"as {preset}" if taken else f"the preset {preset}"
    click.echo(f"{file}: {what}; edit it, then softneck robot check {file}")


def _moved(source: Path, folder: Path) -> str:
    """Return a robot file's text for another folder, from which the files that it names are found as well."""
    import tomli_w

    from softneck.plant._presets import PRESETS
    from softneck.robot import Robot

    Robot.read(source)  # which says what is wrong with it
    text = settings_text(source)
    table = tomllib.loads(text)
    there = source.parent.resolve() != folder.resolve()
    named = [(part, key) for part, key in (("plant", "neck"), ("drives", "file")) if key in table.get(part, {})]
    for part, key in named if there else []:
        name = table[part][key]
        if name not in PRESETS and not Path(name).is_absolute():
            table[part][key] = Path(os.path.relpath((source.parent / name).resolve(), folder.resolve())).as_posix()
    return text if table == tomllib.loads(text) else tomli_w.dumps(table)


@command.command("check")
@click.argument("file", required=False, metavar="[FILE]")
@json_option
def check(file: str | None, as_json: bool) -> None:
    """Check FILE and the files that it names, and that they fit; exit code 2 where something is wrong."""
    robot = _robot(file)
    _check_files(robot)
    if as_json:
        print_json({"robot": robot.name, "hash": robot.hash, "holds": True})
        return
    click.echo(f"{robot.label()}: nothing is wrong\n{robot.summary().splitlines()[-1]}")


def _robot(file: str | None) -> Robot:
    from softneck.robot import find_robot

    return find_robot(file, beside=Path("here"))


def _check_files(robot: Robot) -> None:
    from softneck.plant import VirtualNeck
    from softneck.plant._presets import PRESETS

    from .shared._neck import load_neck

    folder = robot.folder or Path()
    if robot.neck is not None:
        # The file is there and holds a neck, and the robot is one that tendons on winches bend.
        VirtualNeck.of(robot, load_neck(robot.neck if robot.neck in PRESETS else str(folder / robot.neck)))
    if robot.drives is not None:
        from softneck.drives import load_drives

        if not (folder / robot.drives).is_file():
            raise SettingsError(f"`drives.file`: {folder / robot.drives}: no such file.")
        load_drives(folder / robot.drives, robot)
