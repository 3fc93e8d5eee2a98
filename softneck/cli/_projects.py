"""Whole projects: softneck new, report, demo and reproduce-paper."""

from __future__ import annotations

import re
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck import plots
from softneck.core import CheckFailedError, OutputFileError, refuse_existing, write_text

from .shared._console import note, print_json, print_table, progress, stages
from .shared._options import common_options, target

if TYPE_CHECKING:
    from softneck.report import Demo, Project

# Of a folder that is not empty, in the line that refuses it.
_MOST_NAMES = 3


@click.command("new", epilog="Example: softneck new my_neck && cd my_neck && python identify.py")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--loop", "loop_file", type=click.Path(path_type=Path), metavar="LOOP.toml",
    help="Around this loop, as `softneck tune` writes it, over Plant, Observer and Controller.fmu in DIR/fmus.",
)  # fmt: skip
@common_options("force")
def new(folder: Path, loop_file: Path | None, force: bool, as_json: bool) -> None:
    """Write a project into DIR, new or empty: identification, design, loop, study, closed-loop test, drives.

    The project is for the virtual neck; `softneck start LOG` makes one from your own log.
    """
    project = re.sub(r"[^A-Za-z0-9]+", "-", folder.resolve().name).strip("-").lower() or "neck"
    texts = _texts(project) if loop_file is None else _of_loop(loop_file, folder, project)
    if not force:
        _refuse_filled(folder)
    for name, text in texts.items():
        write_text(folder / name, text, force=force)
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


@click.command("report", epilog="Example: softneck report my_neck -o my_neck.html")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="The page. [default: build/report.html]"
)
@common_options("force")
def report(folder: Path, output: Path | None, force: bool, as_json: bool) -> None:
    """Write one self-contained page on all that DIR holds, to send to a colleague.

    Data quality, models and their fits on rows that they were not trained on, uncertain plants, observers and
    controllers, certificates, FMUs, loops (run anew) and studies, with interactive plots; it opens offline. Files that
    cannot be read are listed in it.
    """
    from softneck.report import decision_values, project_page, read_project

    path, replace = target(output, "report.html", force=force, ending=".html")
    refuse_existing(path, force=replace)
    with progress("report", quiet=as_json) as tell:
        project = read_project(folder, progress=lambda done, word: tell(0.4 * done, word))
        plots.write_page(
            path,
            project_page(project, place=path.parent, progress=lambda done, word: tell(0.4 + 0.5 * done, word)),
            force=replace,
        )
    if as_json:
        print_json({"report": str(path), **_counts(project), "problems": project.problems, **decision_values(project)})
        return
    click.echo(f"{path}: " + ", ".join(f"{count} {name}" for name, count in _counts(project).items() if count))
    for name, problem in project.problems.items():
        note(f"{name}: {' '.join(problem.split())}")


def _counts(project: Project) -> dict[str, int]:
    names = ("recordings", "models", "families", "observers", "controllers", "certificates", "fmus", "loops", "studies")
    return {name: len(getattr(project, name)) for name in names}


@click.command("demo", epilog="Example: softneck demo -o build/demo --quick")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder for all results. [default: build/demo]",
)
@click.option("--quick", is_flag=True, help="A shorter experiment and less training: under 30 s.")
@common_options("force")
def demo(output: Path | None, quick: bool, force: bool, as_json: bool) -> None:
    """Run the main job: experiment, models, FMUs, controller, closed loop, report.

    Records the paper's experiment on the virtual neck, identifies RLS, set membership and a network, judges them
    beside the paper's figures, packages all as FMUs, and closes the loop over FMUs against the virtual neck.
    """
    from softneck.report import DemoSettings, run_demo

    folder = output or Path("build/demo")
    if not force and not folder.resolve().is_relative_to(Path("build").resolve()):
        _refuse_filled(folder)
    settings = DemoSettings.quick(folder) if quick else DemoSettings(out=folder)
    if quick and not as_json:
        note(f"quick: the Eq. 22 experiment is {settings.duration:g} s long, not the paper's 200 s, and trained less")
    with stages(quiet=as_json) as begin:
        found = run_demo(settings, tell=begin)
    if as_json:
        print_json(found.as_dict() | {"seconds": found.seconds})
    else:
        _print(found)
    if not found.holds:
        raise CheckFailedError(f"a check of the demo did not hold; see {folder / 'report.html'}.")


def _refuse_filled(folder: Path) -> None:
    if held := sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []:
        more = ", ..." if len(held) > _MOST_NAMES else ""
        raise OutputFileError(
            f"{folder}: is not empty (it holds {', '.join(held[:_MOST_NAMES])}{more}); take a new folder, or --force "
            "writes into this one and replaces files of the same names."
        )


def _print(demo: Demo) -> None:
    from softneck.report import FIT_HEAD, FIT_NOTE, fit_rows, fmu_rows, loop_rows

    print_table("Models, ours beside the paper's (fit in %, pitch/roll)", FIT_HEAD, fit_rows(demo.judged))
    click.echo(FIT_NOTE + "\n")
    print_table("FMUs in fmpy against the Python models, in simulation", *fmu_rows(demo.packaged))
    print_table("Closed loops over FMUs against the virtual neck", *loop_rows(demo.loops))
    click.echo(f"{demo.seconds:.0f} s; everything is in {demo.settings.out}, start with report.html")


@click.command("reproduce-paper", epilog="Example: softneck reproduce-paper --html build/paper.html")
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with the tables and Figures 4 to 23.")
@click.option("--seed", default=0, show_default=True, help="Seed of the network's start.")
@click.option(
    "--necks",
    default=3,
    show_default=True,
    help="Number of other necks to identify on, to tell which differences come from the plant.",
)
@common_options("force")
def paper(html: Path | None, seed: int, necks: int, force: bool, as_json: bool) -> None:
    """Reproduce the paper on the virtual neck: Tables 3 and 4, section 7.4 and Figures 4 to 23.

    Records Eq. 22 and the three tests, identifies set membership, network and RLS, and prints our figures
    beside the paper's, like with like. Takes about a minute.
    """
    from softneck.report import (
        LINEAR_HEAD,
        PAPER_HEAD,
        PAPER_NOTE,
        ReproduceSettings,
        group_entries,
        linear_facts,
        linear_rows,
        paper_entries,
        paper_page,
        reproduce,
    )

    if html is not None:
        refuse_existing(html, force=force)
    with stages(quiet=as_json) as begin:
        found = reproduce(ReproduceSettings(seed=seed, other_necks=necks), tell=begin)
        if html is not None:
            begin("draw the figures")
            plots.write_page(html, paper_page(found), force=force)
    rows = paper_entries(found)
    if as_json:
        print_json(
            {
                "entries": [row.as_dict() for row in rows],
                "linear": linear_facts(found),
                "other_necks": list(found.others),
                "seconds": found.seconds,
                "html": None if html is None else str(html),
            }
        )
        return
    for title, part in group_entries(rows).items():
        print_table(title, PAPER_HEAD, [row.row() for row in part])
    print_table("Eq. 31, in deg", LINEAR_HEAD, linear_rows(found))
    click.echo(PAPER_NOTE)
    note(f"{found.seconds:.0f} s" + ("" if html is None else f"; the figures are in {html}"))
