"""softneck new: a project to begin with, whose closed-loop test passes at once."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import click

from softneck.core import OutputFileError, atomic_write

from .shared._console import print_json
from .shared._options import force_option, json_option


@click.command("new", epilog="Example: softneck new my_neck && cd my_neck && pytest")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@force_option
@json_option
def command(folder: Path, force: bool, as_json: bool) -> None:
    """Write a project into DIR: identification, design, loop, study and a closed-loop test."""
    texts = _texts(_project_name(folder))
    taken = [name for name in texts if (folder / name).exists()]
    if taken and not force:
        raise OutputFileError(
            f"{folder}: holds {', '.join(taken)} already; take an empty folder, or --force replaces them."
        )
    for name, text in texts.items():
        with atomic_write(folder / name, force=force) as temporary:
            temporary.write_text(text, encoding="utf-8")
    if as_json:
        print_json({"folder": str(folder), "files": list(texts)})
        return
    click.echo(f"{folder}: {', '.join(texts)}")
    click.echo(f"next: cd {folder} && pytest")


def _texts(project: str) -> dict[str, str]:
    """Return file name -> text of the template."""
    template = files("softneck.cli").joinpath("template")
    found = {}
    for entry in sorted(template.iterdir(), key=lambda item: item.name):
        name = entry.name.removesuffix(".txt")
        found[".gitignore" if name == "gitignore" else name] = entry.read_text(encoding="utf-8").replace(
            "NAME", project
        )
    return found


def _project_name(folder: Path) -> str:
    name = re.sub(r"[^A-Za-z0-9]+", "-", folder.resolve().name).strip("-").lower()
    return name or "neck"
