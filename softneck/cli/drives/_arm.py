"""What lets drives on a bus move: --arm, and the words typed by somebody who looks at the neck."""

from __future__ import annotations

import os
import sys

import click

from softneck.core import SettingsError
from softneck.drives.bus._link import HARMLESS

from ..shared._console import note

# For a service, where nobody can type: the same words.
VARIABLE = "SOFTNECK_ARM"


def words(bus: str) -> str:
    """Return what is to be typed for `bus`."""
    return f"MOVE {bus.partition(':')[2]}"


def require_armed(bus: str, *, arm: bool) -> None:
    """Return if the drives on `bus` may move.

    A bus whose far end is a program needs --arm only. Any other needs the words typed at a terminal as well, or
    in SOFTNECK_ARM where there is none.

    Raises:
        SettingsError: no --arm, nobody to ask, or other words; nothing was sent.
    """
    if not arm:
        raise SettingsError(f"this moves the drives on {bus}; say --arm if they may. Nothing was sent.")
    if bus.partition(":")[0] in HARMLESS:
        return
    wanted, given = words(bus), os.environ.get(VARIABLE)
    if given is not None:
        if given != wanted:
            raise SettingsError(f"{VARIABLE} is `{given}`; for {bus} it must be `{wanted}`. Nothing was sent.")
        note(f"armed by {VARIABLE}; nobody was asked.")
        return
    if not sys.stdin or not sys.stdin.isatty():
        raise SettingsError(
            f"--arm asks for `{wanted}` at a terminal, but stdin is not one; "
            f"a service sets {VARIABLE}. Nothing was sent."
        )
    click.echo(f"The drives on {bus} will move. Is the neck free, and a hand at the Enable switch?", err=True)
    typed = click.prompt(f"Type `{wanted}` to go on", default="", show_default=False, err=True)
    if typed.strip() != wanted:
        raise SettingsError(f"`{typed.strip()}` was typed, not `{wanted}`. Nothing was sent.")
