"""softneck robot: show, check and write robot files."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck import plant
from softneck.core import SettingsError, settings_text, write_text

from .shared._console import print_json
from .shared._groups import NearGroup, now
from .shared._options import common_options

if TYPE_CHECKING:
    from softneck.robot import Robot


class _RobotGroup(NearGroup):
    """A group whose argument is a file, unless it is a command."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Treat a word that names no command as the argument of `FILE`."""
        asked = args[0] if args else ""
        # A completing shell calls this without a word.
        if (
            not ctx.resilient_parsing
            and asked not in {*self.commands, *ctx.help_option_names}
            and now(ctx, asked) is None
        ):
            args = ["FILE", *args]
        return super().parse_args(ctx, args)


@click.group(
    "robot", cls=_RobotGroup, epilog="Example: softneck robot new --preset antagonist, then softneck robot robot.toml"
)
def command() -> None:
    """Show and check a robot with `softneck robot FILE`, or write a new file with `softneck robot new`.

    Presets: neck (the paper's), arm, antagonist, finger, trunk4. Without FILE: `robot.toml` in this folder or
    one above it, else the preset neck. Each takes `--json`.
    """


@command.command("FILE")
@click.argument("file", required=False, metavar="[FILE|PRESET]")
@common_options()
def show(file: str | None, as_json: bool) -> None:
    """Show motors, outputs, directions, limits and missing keys; check the files that the robot names.

    Exit code 2 if something is wrong.
    """
    from softneck.robot import find_robot

    robot = find_robot(file, beside=Path("here"))
    if not as_json:
        click.echo(f"{robot.summary()}\nhash: {robot.hash}")
    _check_files(robot)
    if as_json:
        print_json({**robot.as_dict(), "hash": robot.hash, "holds": True})


@command.command("new")
@click.argument("file", required=False, default="robot.toml", type=click.Path(path_type=Path))
@click.option("--preset", default="neck", show_default=True, metavar="PRESET|FILE", help="Which robot to begin with.")
@common_options("force")
def new(file: Path, preset: str, force: bool, as_json: bool) -> None:
    """Write a preset, or another robot's file, into FILE (robot.toml), to edit."""
    from softneck.robot import ROBOT_PRESETS, preset_text

    if file.suffix.lower() != ".toml":
        raise SettingsError(f"{file}: must end in `.toml`, by which softneck recognises the file.")
    taken = preset not in ROBOT_PRESETS and Path(preset).is_file()
    text = _text_for_folder(Path(preset), file.parent) if taken else preset_text(preset)
    write_text(file, text, force=force)
    if as_json:
        print_json({"file": str(file), "preset": preset})
        return
    what = f"as {preset}" if taken else f"the preset {preset}"
    click.echo(f"{file}: {what}; edit it, then softneck robot {file}")


def _text_for_folder(source: Path, folder: Path) -> str:
    """Return a robot file's text for another folder, from which the files that it names are found as well."""
    import tomli_w

    from softneck.robot import Robot

    Robot.read(source)  # reports errors
    text = settings_text(source)
    table = tomllib.loads(text)
    there = source.parent.resolve() != folder.resolve()
    named = [(part, key) for part, key in (("plant", "neck"), ("drives", "file")) if key in table.get(part, {})]
    for part, key in named if there else []:
        name = table[part][key]
        if name not in plant.PRESETS and not Path(name).is_absolute():
            table[part][key] = Path(os.path.relpath((source.parent / name).resolve(), folder.resolve())).as_posix()
    return text if table == tomllib.loads(text) else tomli_w.dumps(table)


def _check_files(robot: Robot) -> None:
    folder = robot.folder or Path()
    if robot.neck is not None:
        # The file is there and holds a neck, and the robot is one that tendons on winches bend.
        plant.VirtualNeck.of(
            robot, plant.NeckParameters.preset(robot.neck if robot.neck in plant.PRESETS else str(folder / robot.neck))
        )
    if robot.drives is not None:
        from softneck.drives import load_drives

        if not (folder / robot.drives).is_file():
            raise SettingsError(f"`drives.file`: {folder / robot.drives}: no such file.")
        load_drives(folder / robot.drives, robot)
