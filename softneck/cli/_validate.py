"""softneck validate: fits of a model one step ahead, k steps ahead and in simulation (free run), beside persistence."""

from __future__ import annotations

from pathlib import Path

import click

from softneck import identification, plots, signals
from softneck.core import CheckFailedError, SettingsError, refuse_existing
from softneck.robot import load_for_robot

from .shared._console import print_json, print_table, progress, useless
from .shared._options import common_options, tolerance_option

_FIT_NOTE = (
    "Fit is 100 (1 - |y - yhat| / |y - mean y|) in %. Persistence repeats the last sample; a one-step fit that is not "
    "above it says nothing. The simulation (inf) is what an FMU of the plant does. Best linear is fitted on the judged "
    "rows: no linear model of the set-points has a better simulation on them."
)


@click.command(
    "validate", epilog="Example: softneck validate rls.npz nn.npz --data neck.csv --horizon 1,25,inf --html fit.html"
)
@click.argument("models", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--data", "data", multiple=True, required=True, type=click.Path(path_type=Path), help="Recordings.")
@click.option(
    "--horizon", default="1,5,25,inf", show_default=True, help="Samples ahead; inf is the simulation (free run)."
)
@click.option(
    "--motors",
    type=click.Choice(["simulated", "measured"]),
    default="simulated",
    show_default=True,
    help="Simulation from set-points alone, or with logged motor positions as the paper does.",
)
@click.option("--include-training", is_flag=True, help="Also score rows that the model was trained on.")
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with plots.")
@tolerance_option
@common_options("robot", "force")
def command(
    models: tuple[Path, ...],
    data: tuple[Path, ...],
    horizon: str,
    motors: str,
    include_training: bool,
    html: Path | None,
    tolerance: float | None,
    robot: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Validate MODELs on the rows of recordings that they were not trained on.

    Exit code 1 if a simulation diverges or a fit is below 0 %.
    """
    horizons = _horizons(horizon)
    if html is not None:
        refuse_existing(html, force=force)
    # `--data a.csv b.csv`: click gives what follows the first to MODELs.
    data += tuple(path for path in models if path.suffix.lower() in (".csv", ".parquet"))
    models = tuple(path for path in models if path not in data)
    if not models:
        raise SettingsError("recordings only; expected a model before them: softneck validate MODEL --data REC...")
    loaded = {str(path): load_for_robot(path, "model", robot) for path in models}
    recordings = {str(path): signals.read_recording(path, robot=robot) for path in data}
    rules = identification.Rules(horizons, motors, include_training, tolerance=tolerance)
    with progress("validate", quiet=as_json) as report:
        comparison = identification.compare(loaded, recordings, rules=rules, progress=report)
    results = list(comparison.validations)
    if html is not None:
        from softneck.report import validation_page  # it draws in all of the project, which the table does not need

        plots.write_page(html, validation_page(results), force=force)
    if as_json:
        from softneck.report import validation_decision

        values = comparison.as_dict()
        print_json({**values, "decision": validation_decision(values["models"])})
    else:
        _print(results)
    found = [f"{Path(r.model).name} on {Path(r.data).name}: {why}" for r in results if (why := useless(r))]
    if found:
        raise CheckFailedError(f"no model of this data: {'; '.join(found)}.")


def _print(results: list[identification.Validation]) -> None:
    from softneck.report import fit_table, remarks

    table = fit_table(results)
    print_table(table.caption, table.head, table.rows)
    for r in results:
        for line in remarks(r):
            click.echo(f"{Path(r.model).stem} on {Path(r.data).stem}: {line}")
    click.echo(_FIT_NOTE)


def _horizons(text: str) -> tuple[int | str, ...]:
    horizons: list[int | str] = []
    for word in text.split(","):
        if word.strip() == identification.INFINITE:
            horizons.append(identification.INFINITE)
        elif word.strip().isdecimal() and 1 <= int(word) <= 10_000:
            horizons.append(int(word))
        else:
            raise SettingsError(f"--horizon takes numbers of samples and `inf`, such as 1,5,25,inf; got `{word}`.")
    return tuple(dict.fromkeys(horizons))
