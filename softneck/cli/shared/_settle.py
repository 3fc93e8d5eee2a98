"""Questions in a terminal about what a guess is not sure of."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import DataError

if TYPE_CHECKING:
    from softneck.signals import Guess


def is_terminal() -> bool:
    """Return whether someone can answer."""
    return bool(sys.stdin and sys.stdin.isatty() and sys.stderr.isatty())


def settle(guess: Guess, log: Path, proposal: Path) -> Guess:
    """Return the guess with all doubts answered, the least sure first, and the sample time of a log without a clock.

    Raises:
        DataError: columns were said to be wrong; the line says where to mend them.
    """
    for doubt in guess.doubts:
        if doubt.choices:
            click.echo(str(doubt), err=True)
            kind = click.Choice([doubt.taken, *doubt.choices])
            said = click.prompt(doubt.about, default=doubt.taken, type=kind, err=True)
            guess = guess.settled(doubt, None if said == doubt.taken else said)
        elif click.confirm(f"{doubt}. Is that right?", default=True, err=True):
            guess = guess.settled(doubt)
        else:
            raise DataError(
                f"{log}: {doubt.about}: {doubt.taken} was said to be wrong. Write the right columns into a layout "
                f"(`softneck import {log} --guess --yes` proposes {proposal}) and use --layout."
            )
    if any(line.startswith("the sample time") for line in guess.missing):
        kind = click.FloatRange(min=0.0, max=1e4, min_open=True)
        guess = guess.with_sample_time(click.prompt("No column is a time. Sample time [s]", type=kind, err=True))
    return guess
