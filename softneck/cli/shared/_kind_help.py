"""Help of a command that takes a kind: what `--set` takes, read from the docstring of the kind's settings."""

from __future__ import annotations

import dataclasses
import inspect
import re
from typing import Any

import click

from softneck.core import KINDS, resolve
from softneck.core._kinds import kinds_of

# `name, other: text` at the indent of an attribute; what goes on is indented deeper.
_ATTRIBUTE = re.compile(r"(\w+(?:, \w+)*): (.*)")
_GOES_ON = "    "


def kind_command(role: str, kind: str | None = None) -> type[click.Command]:
    """Return a command whose help lists the settings of the kind of `role` that it is asked with, else of `kind`."""

    class KindCommand(click.Command):
        def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
            # Kept for the help, which click prints before it has read any argument.
            ctx.meta[__name__] = next((arg for arg in args if arg in kinds_of(role)), kind)
            return super().parse_args(ctx, args)

        def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
            super().format_options(ctx, formatter)
            asked = ctx.meta.get(__name__, kind)
            if asked is not None:
                _write_settings(asked, formatter)

    return KindCommand


def _write_settings(kind: str, formatter: click.HelpFormatter) -> None:
    with formatter.section(f"Settings of {kind} (--set KEY=VALUE; angles in rad, or KEY_deg=VALUE; ... is None)"):
        rows = settings_of(resolve(KINDS[kind].settings))
        formatter.write_dl([(f"{name}={value}", text) for name, value, text in rows], col_max=36)


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
