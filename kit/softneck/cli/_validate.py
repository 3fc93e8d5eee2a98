"""softneck validate: what a model is worth, beside persistence, one step and k steps ahead and in free run."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import SettingsError, refuse_existing
from softneck.identification import INFINITE, Validation, load_model, validate
from softneck.plots import write_page
from softneck.signals import read_recording

from ._console import percent, print_json, print_table, progress
from ._options import force_option, json_option

_NOTE = (
    "Fit is 100 (1 - |y - yhat| / |y - mean y|) in %. Persistence repeats the last sample; a one-step fit that is not "
    "above it says nothing. The free run (inf) is what an FMU of the plant does."
)


@click.command(
    "validate",
    epilog="Example: softneck validate rls.npz nn.npz --data neck.csv --horizon 1,25,inf --html fit.html",
)
@click.argument("models", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--data", "data", multiple=True, required=True, type=click.Path(path_type=Path), help="A recording.")
@click.option("--horizon", default="1,5,25,inf", show_default=True, help="Samples ahead; inf is the free run.")
@click.option(
    "--motors",
    type=click.Choice(["simulated", "measured"]),
    default="simulated",
    show_default=True,
    help="Free run from set-points alone, or with logged motor positions as the paper does.",
)
@click.option("--include-training", is_flag=True, help="Score rows that the model was trained on as well.")
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with plots.")
@force_option
@json_option
def command(
    models: tuple[Path, ...],
    data: tuple[Path, ...],
    horizon: str,
    motors: str,
    include_training: bool,
    html: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Judge MODELs on the rows of recordings that they were not trained on."""
    horizons = _horizons(horizon)
    if html is not None:
        refuse_existing(html, force=force)
    loaded = [(path, load_model(path)) for path in models]
    recordings = [(path, read_recording(path)) for path in data]
    results: list[Validation] = []
    with progress("validate", quiet=as_json) as report:
        for model_path, model in loaded:
            for data_path, recording in recordings:
                report(len(results) / (len(loaded) * len(recordings)), f"{model_path.name} on {data_path.name}")
                results.append(
                    validate(
                        model,
                        recording,
                        names=(str(model_path), str(data_path)),
                        horizons=horizons,
                        motors=motors,
                        include_training=include_training,
                    )
                )
    if html is not None:
        write_page(html, _page(results), force=force)
    if as_json:
        print_json({"models": [result.as_dict() for result in results]})
        return
    print_table("Fit [%], pitch/roll", *_table(results, horizons))
    for result in results:
        if result.diverged is not None:
            click.echo(f"the free run of {result.model} on {result.data} diverged at {result.diverged:.2f} s")
    click.echo(_NOTE)


def _horizons(text: str) -> tuple[int | str, ...]:
    horizons: list[int | str] = []
    for word in text.split(","):
        if word.strip() == INFINITE:
            horizons.append(INFINITE)
        elif word.strip().isdecimal() and 1 <= int(word) <= 10_000:
            horizons.append(int(word))
        else:
            raise SettingsError(f"--horizon takes numbers of samples and `inf`, such as 1,5,25,inf; got `{word}`.")
    return tuple(dict.fromkeys(horizons))


def _table(results: list[Validation], horizons: tuple[int | str, ...]) -> tuple[list[str], list[list[str]]]:
    finite = [str(h) for h in horizons if h != INFINITE]
    head = [
        "model on data",
        "rows",
        "left out",
        *(f"persistence {h}" for h in finite),
        *(f"model {h}" for h in horizons),
    ]
    rows = []
    for r in results:
        row = [f"{Path(r.model).stem} on {Path(r.data).stem}", str(r.rows_scored), str(r.rows_left_out)]
        row += [f"{percent(r.persistence[h]['pitch'])}/{percent(r.persistence[h]['roll'])}" for h in finite]
        row += [f"{percent(r.fits[str(h)]['pitch'])}/{percent(r.fits[str(h)]['roll'])}" for h in horizons]
        rows.append(row)
    return head, rows


def _page(results: list[Validation]) -> str:
    from softneck.report import validation_page  # it draws in all of the project, which the table does not need

    return validation_page(results)
