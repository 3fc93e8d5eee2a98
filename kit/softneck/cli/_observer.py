"""softneck observer: a Kalman filter from a saved linear model and a sensor preset."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import find_kind, refuse_existing, resolve
from softneck.identification import load_model

from ._console import print_json
from ._options import apply_settings, force_option, json_option, output_option, set_option, target


@click.command("observer", epilog="Example: softneck observer rls.npz -o observer.npz --sensor paper")
@click.argument("model", type=click.Path(path_type=Path))
@output_option("observer", "OBSERVER")
@click.option("--sensor", help="Sensor preset: its noise is the measurement noise. [default: paper]")
@set_option
@force_option
@json_option
def command(
    model: Path, output: Path | None, sensor: str | None, settings: tuple[str, ...], force: bool, as_json: bool
) -> None:
    """Build a Kalman filter over the linear MODEL."""
    kind = find_kind("kalman", "observer")
    path, replace = target(output, "observers/kalman.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    observer = apply_settings(resolve(kind.settings), settings, sensor=sensor).design(load_model(model))
    observer.save(path, force=replace)
    if as_json:
        print_json({"observer": str(path), "kind": kind.name, "summary": observer.summary()})
        return
    click.echo(f"{path}\n{observer.summary()}")
