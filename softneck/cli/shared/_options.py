"""Options and arguments that several subcommands share."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from softneck.core import KINDS, DataError, SettingsError, kinds_of, make_settings, resolve, to_si, toml_value

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
    type=click.FloatRange(min=0.0, min_open=True),
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


def requirements_option(default_text: str) -> Callable:
    """Return the option that prints the default requirements: the text of a function by its dotted path."""

    def show(context: click.Context, _: click.Parameter, value: bool) -> None:
        if value:
            click.echo(resolve(default_text)(), nl=False)
            context.exit()

    text = "Print the default requirements and exit."
    return click.option(
        "--print-requirements", is_flag=True, is_eager=True, expose_value=False, callback=show, help=text
    )


def columns_options(function: Callable) -> Callable:
    """Add the options that name the columns of a log."""
    for option, name, what in (
        ("--output", "outputs", "is the next output, such as an angle; pitch or roll: of a neck's log that one alone"),
        ("--position", "positions", "is the next motor's measured position"),
        ("--motor", "motors", "is the next motor's set-point"),
    ):
        function = click.option(
            option, name, multiple=True, metavar="COL", help=f"Column, by title or index (0-3: four), that {what}."
        )(function)
    return function


def output_option(what: str, metavar: str, *, required: bool = False) -> Callable:
    """Return the option `-o`; without it a command writes under build/."""
    help_text = f"Where to write the {what}." + ("" if required else " [default: under build/]")
    return click.option(
        "-o", "--output", type=click.Path(path_type=Path), metavar=metavar, required=required, help=help_text
    )


def target(output: Path | None, default: str, *, force: bool, ending: str | None = None) -> tuple[Path, bool]:
    """Return the output path and whether it may be replaced, which is always true under build/."""
    if output is not None and ending is not None and output.suffix.lower() != ending:
        raise SettingsError(f"{output}: must end in `{ending}`, by which softneck recognises the file.")
    return (output, force) if output is not None else (Path("build") / default, True)


def apply_settings(settings_class: type, assignments: Sequence[str], **more: Any) -> Any:
    """Return `settings_class` with `KEY=VALUE` assignments and `more`, both checked against its fields."""
    values: dict[str, Any] = {}
    fields = {field.name for field in dataclasses.fields(settings_class)}
    for assignment in assignments:
        key, separator, text = assignment.partition("=")
        if not separator:
            raise SettingsError(f"--set takes KEY=VALUE; got `{assignment}`.")
        name, value = in_si(key.strip(), toml_value(text.strip()), fields)
        values[name] = value
    values |= {key: value for key, value in more.items() if value is not None and key in fields}
    return make_settings(settings_class, values)


# Settings that are times, and those in the unit of the outputs; the others with a unit are angles.
_TIMES = {
    "delay",
    "max_delay",
    "sensor_delay",
    "gyro_delay",
    "window",
    "reference_time",
    "fade",
    "preview",
    "sample_time",
}
_OF_CHANNELS = {
    "epsilon",
    "measurement_noise_std",
    "disturbance_noise_std",
    "lead_limit",
    "least_cocontraction",
    "minimum_tautness",
}
_ANGLES = {"phase_margin", "angle_limit"}


def in_si(key: str, value: Any, fields: set[str]) -> tuple[str, Any]:
    """Return setting and value in SI of a key that ends in a unit: `delay_ms`, `phase_margin_deg`, `epsilon_mm`.

    Raises SettingsError: a unit of another quantity than the setting's.
    """
    name, _, unit = key.rpartition("_")
    if key in fields or name not in _TIMES | _OF_CHANNELS | _ANGLES or name not in fields:
        return key, value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"`{key}` takes a number; got {value!r}.")
    try:
        factor, quantity = to_si(unit)
    except DataError as error:
        raise SettingsError(f"`{key}`: {error}") from error
    wanted = quantity if name in _OF_CHANNELS else "s" if name in _TIMES else "rad"
    if quantity != wanted:
        raise SettingsError(f"`{key}`: `{name}` is in {wanted}, and {unit} is no unit of that.")
    return name, factor * value


def sample_time_of(text: str, option: str) -> float:
    """Return the sample time [s] of an option."""
    value = toml_value(text)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
        raise SettingsError(f"{option} takes a sample time in seconds, such as 0.02; got `{text}`.")
    return float(value)


# `name, other: text` at the indent of an attribute; what goes on is indented deeper.
_ATTRIBUTE = re.compile(r"(\w+(?:, \w+)*): (.*)")
_GOES_ON = "    "


def kind_command(role: str, kind: str | None = None) -> type[click.Command]:
    """Return a command whose help lists the settings of the given kind of `role`, by default of `kind`."""

    class KindCommand(click.Command):
        def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
            # Kept for the help, which click prints before it has read any argument.
            ctx.meta[__name__] = next((arg for arg in args if arg in kinds_of(role)), kind)
            return super().parse_args(ctx, args)

        def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
            super().format_options(ctx, formatter)
            asked = ctx.meta.get(__name__, kind)
            if asked is not None:
                head = f"Settings of {asked} (--set KEY=VALUE; angles in rad, or KEY_deg=VALUE; ... is None)"
                with formatter.section(head):
                    rows = settings_of(resolve(KINDS[asked].settings))
                    formatter.write_dl([(f"{name}={value}", text) for name, value, text in rows], col_max=36)

    return KindCommand


def settings_of(settings: type) -> list[tuple[str, str, str]]:
    """Return name, default and meaning of each setting, the kind's own first."""
    meanings: dict[str, str] = {}
    for owner in reversed(settings.__mro__):
        meanings |= meanings_in(owner.__dict__.get("__doc__") or "")
    fields = dataclasses.fields(settings)
    own = inspect.get_annotations(settings)
    ordered = [*(f for f in fields if f.name in own), *(f for f in fields if f.name not in own)]
    return [(field.name, _default(field), meanings.get(field.name, "")) for field in ordered]


def meanings_in(doc: str) -> dict[str, str]:
    """Return name -> meaning of the attributes that a docstring lists."""
    found: dict[str, str] = {}
    names: list[str] = []
    for line in inspect.cleandoc(doc).partition("Attributes:\n")[2].splitlines():
        if line.strip() and not line.startswith(_GOES_ON):
            break  # the next section
        begins = _ATTRIBUTE.fullmatch(line.removeprefix(_GOES_ON))
        if begins:
            names = begins[1].split(", ")
            found |= dict.fromkeys(names, begins[2])
        else:
            found |= {name: f"{found[name]} {line.strip()}".strip() for name in names}
    return found


def _default(field: dataclasses.Field[Any]) -> str:
    """Return the default as `--set` takes it; "" where the kind finds it."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is None or value is dataclasses.MISSING:
        return "..."
    return _text(value)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.4g}"
    return "[" + ", ".join(map(_text, value)) + "]" if isinstance(value, list | tuple) else str(value)
