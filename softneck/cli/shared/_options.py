"""Options and arguments that several subcommands share."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from softneck.core import SettingsError
from softneck.core._kinds import make_settings

COMMON = {
    "robot": click.option(
        "--robot",
        metavar="ROBOT",
        help="Preset or robot file.  [default: robot.toml beside the file or above it, else what the file says, else "
        "the neck]",
    ),
    "yes": click.option("--yes", is_flag=True, help="Ask nothing and take all guesses."),
    "force": click.option("--force", is_flag=True, help="Replace an existing file."),
    "json": click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout and nothing else."),
}


def common_options(*names: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds those of `--robot`, `--yes` and `--force` that are named, and `--json`."""

    def decorate(function: Callable) -> Callable:
        for name in reversed((*names, "json")):
            function = COMMON[name](function)
        return function

    return decorate


tolerance_option = click.option(
    "--tolerance",
    type=float,
    help="Error that the output `validity` allows, in the outputs' display unit; a neck's is 2 deg.",
)
trust_option = click.option(
    "--trust", is_flag=True, help="Run Python that the file names and that lies outside of the loop's folder."
)
set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="A setting of the kind, which `KIND --help` lists; angles in rad, or KEY_deg=VALUE.",
)


def columns_options(function: Callable) -> Callable:
    """Add the options that name the columns of a log."""
    for option, name, what in (
        ("--output", "outputs", "is the next output, such as an angle"),
        ("--position", "positions", "is the next motor's measured position"),
        ("--motor", "motors", "is the next motor's set-point"),
    ):
        function = click.option(
            option, name, multiple=True, metavar="COL", help=f"Column, by title or index, that {what}."
        )(function)
    return function


def output_option(what: str, metavar: str, *, required: bool = False) -> Callable:
    """Return the option `-o`; without it a command writes under build/."""
    help_text = f"Where to write the {what}." + ("" if required else " [default: under build/]")
    return click.option(
        "-o", "--output", type=click.Path(path_type=Path), metavar=metavar, required=required, help=help_text
    )


def target(output: Path | None, default: str, *, force: bool, ending: str | None = None) -> tuple[Path, bool]:
    """Return where to write and whether what stands there may be replaced: always under build/.

    Raises:
        SettingsError: another ending than `ending`, by which files are known.
    """
    if output is not None and ending is not None and output.suffix.lower() != ending:
        raise SettingsError(f"{output}: must end in `{ending}`, by which softneck recognises the file.")
    return (output, force) if output is not None else (Path("build") / default, True)


def apply_settings(settings_class: type, assignments: Sequence[str], **more: Any) -> Any:
    """Return `settings_class` with `KEY=VALUE` assignments and `more`, both checked against its fields.

    Raises:
        SettingsError: no `=`, an unknown key, or a value that does not fit.
    """
    values: dict[str, Any] = {}
    fields = {field.name for field in dataclasses.fields(settings_class)}
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator:
            raise SettingsError(f"--set takes KEY=VALUE; got `{assignment}`.")
        name, value = in_radians(key.strip(), value_of(text.strip()), fields)
        values[name] = value
    values |= {key: value for key, value in more.items() if value is not None and key in fields}
    return make_settings(settings_class, values)


def in_radians(key: str, value: Any, fields: set[str]) -> tuple[str, Any]:
    """Return `key` and `value`; an angle may be given as `key_deg` in degrees."""
    angle = key.removesuffix("_deg")
    if key in fields or angle not in fields or isinstance(value, bool) or not isinstance(value, int | float):
        return key, value
    return angle, math.radians(value)


def sample_time_of(text: str, option: str) -> float:
    """Return a sample time [s] as an option says it.

    Raises:
        SettingsError: no positive number.
    """
    value = value_of(text)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
        raise SettingsError(f"{option} takes a sample time in seconds, such as 0.02; got `{text}`.")
    return float(value)


def value_of(text: str) -> Any:
    """Read a value as TOML does (number, true, [list]); anything else is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
