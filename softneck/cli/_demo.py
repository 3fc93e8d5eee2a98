"""softneck demo: the main job in one command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import CheckFailedError, OutputFileError

from .shared._console import Stages, note, print_json, print_table
from .shared._options import common_options

if TYPE_CHECKING:
    from softneck.report._demo import Demo


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
def command(output: Path | None, quick: bool, force: bool, as_json: bool) -> None:
    """Run the main job: experiment, models, FMUs, controller, closed loop, report.

    Records the paper's experiment on the virtual neck, identifies RLS, set membership and a network, judges them
    beside the paper's figures, packages all as FMUs, and closes the loop over FMUs against the virtual neck.
    """
    from softneck.report import DemoSettings, run_demo

    folder = output or Path("build/demo")
    _refuse_foreign(folder, force=force)
    settings = DemoSettings.quick(folder) if quick else DemoSettings(out=folder)
    if quick and not as_json:
        note(f"quick: the Eq. 22 experiment is {settings.duration:g} s long, not the paper's 200 s, and trained less")
    with Stages(quiet=as_json) as stages:
        demo = run_demo(settings, tell=stages.begin)
    if as_json:
        print_json(demo.as_dict() | {"seconds": demo.seconds})
    else:
        _print(demo)
    if not demo.holds:
        raise CheckFailedError(f"a check of the demo did not hold; see {folder / 'report.html'}.")


def _refuse_foreign(folder: Path, *, force: bool) -> None:
    """Refuse a folder that holds something, unless it lies under build/ or `force` allows it."""
    inside = folder.resolve().is_relative_to(Path("build").resolve())
    if not inside and not force and folder.is_dir() and any(folder.iterdir()):
        raise OutputFileError(f"{folder}: is not empty; use --force to replace files in it or choose another folder.")


def _print(demo: Demo) -> None:
    from softneck.report._demo import FIT_HEAD, FIT_NOTE, fit_rows, fmu_rows, loop_rows

    print_table("Models, ours beside the paper's (fit in %, pitch/roll)", FIT_HEAD, fit_rows(demo.judged, demo.rough))
    click.echo(FIT_NOTE + "\n")
    print_table("FMUs in fmpy against the Python models, free run", *fmu_rows(demo.packaged))
    print_table("Closed loops over FMUs against the virtual neck", *loop_rows(demo.loops))
    click.echo(f"{demo.seconds:.0f} s; everything is in {demo.settings.out}, start with report.html")
