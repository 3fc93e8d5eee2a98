"""softneck adapt: a model that follows a neck that changed."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import refuse_existing

from ..shared._console import percent, print_json
from ..shared._options import force_option, json_option, output_option, target
from ..shared._robot import load_of, robot_option


@click.command("adapt", epilog="Example: softneck adapt play.npz today.csv -o play_today.npz")
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("recording", metavar="REC", type=click.Path(path_type=Path))
@output_option("model", "MODEL2")
@click.option("--window", default=30.0, show_default=True, help="The latest seconds of REC to look at.")
@robot_option
@force_option
@json_option
def command(
    model: Path, recording: Path, output: Path | None, window: float, robot: str | None, force: bool, as_json: bool
) -> None:
    """Refit MODEL to the latest data in REC, starting from what it is.

    What these data do not excite stays as it was. Every third block of 2 s is held out: where an output would be worse
    there, or where the neck hardly moves, MODEL2 is MODEL, and that is said.
    """
    from softneck.signals import read_recording

    path, replace = target(output, f"models/{model.stem}_adapted.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    old = load_of(model, robot, role="model")
    new = old.adapted(read_recording(recording, robot=robot), window=window)
    new.save(path, force=replace)
    said = new.findings["adaptation"]
    if as_json:
        print_json({"model": str(path), "kind": new.kind, **said})
        return
    names = "/".join(new.robot.outputs.names)
    before, after = ("/".join(percent(fit) for fit in said[key]) for key in ("fit_before", "fit_after"))
    told = f"free run on {said['rows_held_out']} rows held out of {said['window_s']:.3g} s, fit [%] {names}:"
    if said["adapted"]:
        click.echo(f"{path}: adapted\n{told} {before} -> {after}")
    else:
        click.echo(f"{path}: the old model, kept: {said['why']}" + (f"\n{told} {before}" if before else ""))
