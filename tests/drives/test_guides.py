"""What the guides tell an owner to type is what the command line takes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from softneck.cli._main import group

from ..data import ROOT

PAGES = [ROOT / "docs" / "howto" / name for name in ("bring_up.md", "drives.md")]
PAGES.append(ROOT / "docs" / "reference" / "drives.md")
TARGET = "--drives drives.toml --bus socketcan:can0"


def commands(page: Path) -> list[str]:
    """Commands of drives between backticks, which may lack their arguments; those of blocks are run (tests/docs)."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    # B is the list's own short form; a command that is only named takes its arguments from the text around it.
    return [line.replace(" B", f" {TARGET}") for line in re.findall(r"`(softneck drives [^`]+)`", text)]


ALL = [(page.name, line) for page in PAGES for line in dict.fromkeys(commands(page))]


@pytest.mark.parametrize(("page", "line"), ALL, ids=[f"{page}: {line}" for page, line in ALL])
def test_a_command_of_the_guides_is_one_that_the_program_takes(page: str, line: str) -> None:
    del page
    words = [word for word in shlex.split(line)[1:] if word != "..."]
    command: click.Command = group
    context = click.Context(group)
    while isinstance(command, click.Group) and words:
        found = command.get_command(context, words[0])
        assert found is not None, f"no command {words[0]}"
        command, words = found, words[1:]
    known = {name for parameter in command.params for name in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= known | {"--help"}
