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


def commands(page: Path) -> list[tuple[str, bool]]:
    """Commands of `softneck` on a page: of console blocks, which are whole, and between backticks, which may not be."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    whole = [line.removeprefix("$ ") for block in blocks for line in block.splitlines() if "softneck " in line]
    inline = re.findall(r"`(softneck drives [^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = [(line, "..." not in line) for line in whole if line.lstrip("$ ").startswith("softneck ")]
    # B is the list's own short form; a command that is only named takes its arguments from the text around it.
    return found + [(line.replace(" B", f" {TARGET}"), False) for line in inline]


ALL = [(page.name, line, whole) for page in PAGES for line, whole in dict.fromkeys(commands(page))]


@pytest.mark.parametrize(("page", "line", "whole"), ALL, ids=[f"{page}: {line}" for page, line, _ in ALL])
def test_a_command_of_the_guides_is_one_that_the_program_takes(page: str, line: str, whole: bool) -> None:
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
    if whole:
        with command.make_context(line, words):
            pass
