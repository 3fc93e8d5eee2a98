"""softneck new: a project to begin with, whose loop holds its limits at once."""

from __future__ import annotations

import re
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import click

from softneck.core import OutputFileError, atomic_write

from .shared._console import print_json
from .shared._options import common_options

# Of a folder that is not empty, in the line that refuses it.
_MOST_NAMES = 3


@click.command("new", epilog="Example: softneck new my_neck && cd my_neck && python identify.py")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--loop", "loop_file", type=click.Path(path_type=Path), metavar="LOOP.toml",
    help="Around this loop, as `softneck tune` writes it, over Plant, Observer and Controller.fmu in DIR/fmus.",
)  # fmt: skip
@common_options("force")
def command(folder: Path, loop_file: Path | None, force: bool, as_json: bool) -> None:
    """Write a project into DIR, new or empty: identification, design, loop, study, closed-loop test, drives.

    It is of the virtual neck; `softneck start LOG` makes the one of your own log.
    """
    project = _project_name(folder)
    texts = _texts(project) if loop_file is None else _of_loop(loop_file, folder, project)
    held = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    if held and not force:
        more = ", ..." if len(held) > _MOST_NAMES else ""
        raise OutputFileError(
            f"{folder}: is not empty (it holds {', '.join(held[:_MOST_NAMES])}{more}); take a new folder, or --force "
            "writes the project into this one and replaces files of the same names."
        )
    for name, text in texts.items():
        with atomic_write(folder / name, force=force) as temporary:
            temporary.write_text(text, encoding="utf-8")
    if as_json:
        print_json({"folder": str(folder), "files": list(texts)})
        return
    click.echo(f"{folder}: {', '.join(texts)}")
    if loop_file is None:
        click.echo(f"next: cd {folder} && python identify.py && python design.py && softneck simulate loop.toml")
        install = "" if find_spec("pytest") else "pip install pytest, then "
        click.echo(f"its test of the closed loop: {install}pytest")


def _of_loop(loop_file: Path, folder: Path, project: str) -> dict[str, str]:
    from .start._project_files import project_of_loop

    return {name: text.replace("NAME", project) for name, text in project_of_loop(loop_file, folder).items()}


def _texts(project: str) -> dict[str, str]:
    """Return file name -> text of the template."""
    from softneck.loop.default_limits import LOOP

    template = files("softneck.cli").joinpath("template")
    words = {"NAME": project, **{name.upper(): str(limit) for name, limit in LOOP.items()}}
    found = {}
    for entry in sorted(template.iterdir(), key=lambda item: item.name):
        name = entry.name.removesuffix(".txt")
        text = entry.read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace(word, value)
        found[".gitignore" if name == "gitignore" else name] = text
    return found


def _project_name(folder: Path) -> str:
    name = re.sub(r"[^A-Za-z0-9]+", "-", folder.resolve().name).strip("-").lower()
    return name or "neck"
