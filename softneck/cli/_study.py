"""softneck study: many runs of one loop, ranked, with a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import CheckFailedError

from .shared._console import note, print_json, print_table, progress
from .shared._options import common_options, trust_option

if TYPE_CHECKING:
    import pandas as pd

    from softneck.cosim.studies._study import Study

# Of the worst runs so many are written as loop files: who wants more reads the table.
_WORST = 3


@click.command("study", epilog="Example: softneck study study.toml -o build/study --workers 2")
@click.argument("study_file", metavar="STUDY.toml", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="DIR",
    help="Folder of runs, report and worst cases. [default: build/studies/NAME]",
)  # fmt: skip
@click.option("--workers", type=int, help="Number of local processes. [default: one for each core]")
@trust_option
@common_options("force")
def command(
    study_file: Path, output: Path | None, workers: int | None, trust: bool, force: bool, as_json: bool
) -> None:
    """Run the loop of STUDY.toml over all that its [vary] names; exit code 1 if every run failed.

    \b
    DIR gets  runs.csv       a row for each run: what varied, seed, metrics, limits, error
              report.html    ranking, Pareto front, distributions, influences
              worst/         the worst runs as loop files for softneck simulate
    Ctrl-C or a crash loses no finished run: the same command goes on where it was.
    """
    from softneck.cosim import load_study
    from softneck.cosim.loops._loop_file import require_trusted
    from softneck.cosim.studies._run_study import run_study
    from softneck.cosim.studies._store import read_description, write_worst
    from softneck.plots import write_page
    from softneck.report import study_page
    from softneck.report._study_page import failures, study_head, study_rows

    require_trusted(study_file, trust=trust)
    study = load_study(study_file)
    folder = output if output is not None else Path("build") / "studies" / study_file.stem
    with progress(f"study of {len(study.points)} runs", quiet=as_json) as report:
        runs = run_study(study, folder, workers=workers, force=_anew(study, folder, output, force), report=report)
    write_page(folder / "report.html", study_page(read_description(folder), runs), force=True)
    paths = write_worst(study, runs, folder / "worst", count=_WORST)
    if as_json:
        print_json(_summary(runs, folder, study.objectives, paths))
    else:
        keys = list(study.vary)
        print_table(str(folder), study_head(keys, study.objectives), study_rows(runs, keys, study.objectives))
        failed = sum(failures(runs))
        note(f"{len(runs)} runs, {failed} failed; report: {folder / 'report.html'}")
    if all(failures(runs)):
        raise CheckFailedError(f"{study_file}: every run failed; the first said: {runs['error'].iloc[0]}")


def _anew(study: Study, folder: Path, output: Path | None, force: bool) -> bool:
    """Return whether what is there is replaced: another study under build/, or what --force says."""
    from softneck.cosim.studies._store import DESCRIPTION, read_description

    there = output is None and (folder / DESCRIPTION).is_file()
    return force or (there and read_description(folder).get("digest") != study.digest)


def _summary(runs: pd.DataFrame, folder: Path, objectives: tuple[str, ...], worst: list[Path]) -> dict[str, Any]:
    from softneck.cosim import pareto_front, rank
    from softneck.report._study_page import failures

    held = runs["holds"].dropna().tolist()
    return {
        "folder": str(folder),
        "runs": len(runs),
        "failed": sum(failures(runs)),
        "holds_share": sum(held) / len(held) if held else None,
        "objectives": list(objectives),
        "best": [int(run) for run in rank(runs, objectives)["run"].head(10)],
        "pareto_front": [int(run) for run in pareto_front(runs, objectives)["run"]],
        "worst": [str(path) for path in worst],
    }
