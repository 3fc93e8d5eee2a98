"""softneck report: one page on a whole project."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import refuse_existing

from .shared._console import note, print_json, progress
from .shared._options import common_options, target

if TYPE_CHECKING:
    from softneck.report._project import Project


@click.command("report", epilog="Example: softneck report my_neck -o my_neck.html")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="The page. [default: build/report.html]"
)
@common_options("force")
def command(folder: Path, output: Path | None, force: bool, as_json: bool) -> None:
    """Write one self-contained page on all that DIR holds, to send to a colleague.

    Data quality, models and their fits on rows that they were not trained on, uncertain plants, observers and
    controllers, certificates, FMUs, loops (run anew) and studies, with interactive plots; it opens offline. Files that
    cannot be read are listed in it.
    """
    from softneck.plots import write_page
    from softneck.report import project_page, read_project

    path, replace = target(output, "report.html", force=force, ending=".html")
    refuse_existing(path, force=replace)
    with progress("report", quiet=as_json) as report:
        project = read_project(folder, progress=lambda done, word: report(0.4 * done, word))
        write_page(
            path, project_page(project, progress=lambda done, word: report(0.4 + 0.5 * done, word)), force=replace
        )
    if as_json:
        print_json({"report": str(path), **_counts(project), "problems": project.problems})
        return
    click.echo(f"{path}: " + ", ".join(f"{count} {name}" for name, count in _counts(project).items() if count))
    for name, problem in project.problems.items():
        note(f"{name}: {' '.join(problem.split())}")


def _counts(project: Project) -> dict[str, int]:
    names = ("recordings", "models", "families", "observers", "controllers", "certificates", "fmus", "loops", "studies")
    return {name: len(getattr(project, name)) for name in names}
