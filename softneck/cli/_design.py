"""softneck design: a controller from an identified linear model."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import KINDS, SettingsError, find_kind, refuse_existing, resolve
from softneck.core._kinds import kinds_of
from softneck.robot._loading import load_for_robot

from .shared._console import note, print_json, progress
from .shared._groups import kinds_complete
from .shared._options import apply_settings, common_options, kind_command, output_option, set_option, target

_KINDS = "\n".join(f"  {name:9} {KINDS[name].summary}" for name in kinds_of("controller"))


@click.command(
    "design",
    cls=kind_command("controller"),
    help="Design a controller of KIND on an identified linear MODEL or a FAMILY; of several files the first is the "
    "nominal plant and all are samples that the controller must hold on."
    f"\n\n\b\nKinds:\n{_KINDS}",
    epilog="Example: softneck design pi rls.npz -o pi.npz --set phase_margin_deg=60",
)
@click.argument("kind", shell_complete=kinds_complete("controller"))
@click.argument("models", nargs=-1, required=True, metavar="MODEL|FAMILY...", type=click.Path(path_type=Path))
@output_option("controller", "CONTROLLER")
@click.option("--any-fit", is_flag=True, help="Also on a model whose free run has a fit below 30 %.")
@click.option(
    "--observer", type=click.Path(path_type=Path), metavar="OBSERVER",
    help="Of the loop: `mpc` and `nmpc` plan without the delay that it makes up for, and `mpc` with tendons as taut as "
    "the payload that it tells wants them.",
)  # fmt: skip
@set_option
@common_options("robot", "force")
def command(
    kind: str,
    models: tuple[Path, ...],
    output: Path | None,
    any_fit: bool,
    observer: Path | None,
    robot: str | None,
    settings: tuple[str, ...],
    force: bool,
    as_json: bool,
) -> None:
    """Design a controller of KIND on identified linear models or a family."""
    from softneck.design._design import linear_plant

    entry = find_kind(kind, "controller")
    path, replace = target(output, f"controllers/{kind}.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    plants = [linear_plant(model, any_fit=any_fit, robot=robot) for model in models]
    asked = apply_settings(resolve(entry.settings), settings)
    if observer is not None:
        if not hasattr(asked, "over"):
            raise SettingsError(f"`--observer` is for mpc and nmpc, and {kind} does not ask for it; leave it out.")
        asked = asked.over(load_for_robot(observer, "observer", robot))
    with progress(f"design {kind}", quiet=as_json):
        controller = asked.design(plants[0] if len(plants) == 1 else plants)
    controller.save(path, force=replace)
    for model, plant in zip(models, plants, strict=True):
        if "hold_out" not in getattr(plant, "findings", {"hold_out": None}):
            note(f"warning: {model}: nothing was held out when it was identified: its fit is not known")
    if as_json:
        print_json({"controller": str(path), "kind": kind, "summary": controller.summary()})
        return
    click.echo(f"{path}\n{controller.summary()}")
