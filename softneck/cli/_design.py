"""softneck design and observer: a controller, and a filter, from an identified model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from softneck import design, estimation, signals
from softneck.core import KINDS, SettingsError, find_kind, kinds_of, refuse_existing, resolve, to_si
from softneck.robot import load_for_robot

from .shared._console import note, print_json, progress
from .shared._groups import kinds_complete
from .shared._options import apply_settings, common_options, kind_command, output_option, set_option, target

_KINDS = "\n".join(f"  {name:9} {KINDS[name].summary}" for name in kinds_of("controller"))


@click.command(
    "design",
    cls=kind_command("controller"),
    help="Design a controller of KIND on an identified linear MODEL or a FAMILY; the first of several files is the "
    "nominal plant, and the controller must hold on all of them."
    f"\n\n\b\nKinds:\n{_KINDS}",
    epilog="Example: softneck design pi rls.npz -o pi.npz --set phase_margin_deg=60",
)
@click.argument("kind", shell_complete=kinds_complete("controller"))
@click.argument("models", nargs=-1, required=True, metavar="MODEL|FAMILY...", type=click.Path(path_type=Path))
@output_option("controller", "CONTROLLER")
@click.option("--any-fit", is_flag=True, help="Also on a model whose simulation has a fit below 30 %.")
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
    entry = find_kind(kind, "controller")
    path, overwrite = target(output, f"controllers/{kind}.npz", force=force, ending=".npz")
    refuse_existing(path, force=overwrite)
    plants = [design.linear_plant(model, any_fit=any_fit, robot=robot) for model in models]
    asked = apply_settings(resolve(entry.settings), settings)
    if observer is not None:
        if not hasattr(asked, "over"):
            raise SettingsError(f"`--observer` is for mpc and nmpc, and {kind} does not ask for it; leave it out.")
        asked = asked.over(load_for_robot(observer, "observer", robot))
    with progress(f"design {kind}", quiet=as_json):
        controller = asked.design(plants[0] if len(plants) == 1 else plants)
    controller.save(path, force=overwrite)
    for model, plant in zip(models, plants, strict=True):
        if "hold_out" not in getattr(plant, "findings", {"hold_out": None}):
            note(f"warning: {model}: nothing was held out when it was identified: its fit is not known")
    if as_json:
        print_json({"controller": str(path), "kind": kind, "summary": controller.summary()})
        return
    click.echo(f"{path}\n{controller.summary()}")


@click.command(
    "observer",
    cls=kind_command("observer", "kalman"),
    epilog="Example: softneck observer rls.npz -o observer.npz --set sensor=paper",
)
@click.argument("model", type=click.Path(path_type=Path))
@output_option("observer", "OBSERVER")
@click.option(
    "--data",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="REC",
    help="Estimate the noise levels from this recording (maximum likelihood); with --set sensor=NAME all but that of "
    "the measurement. May be given several times.",
)
@set_option
@common_options("robot", "force")
def observer_command(
    model: Path,
    output: Path | None,
    data: tuple[Path, ...],
    robot: str | None,
    settings: tuple[str, ...],
    force: bool,
    as_json: bool,
) -> None:
    """Build a filter over the identified MODEL.

    The form follows from the model: a Kalman filter over a linear one, with a disturbance on each axis; over a
    nonlinear one its simulation, with a disturbance. `--set form=gyro` makes a filter that the gyro's rates drive, with
    their bias as a state.
    """
    kind = find_kind("kalman", "observer")
    path, overwrite = target(output, "observers/kalman.npz", force=force, ending=".npz")
    refuse_existing(path, force=overwrite)
    chosen = apply_settings(resolve(kind.settings), settings)
    recordings = [signals.read_recording(path, robot=robot) for path in data]
    chosen, lines = _with_recorded_noise(chosen, model, robot, recordings)
    observer = estimation.design_observer(chosen, model, robot)
    told: dict[str, Any] = {}
    if data:
        named = {setting.partition("=")[0].strip() for setting in settings}
        found, more = _fit(observer, data, recordings, named)
        observer, fit, lines = found.observer, found.fit, [*lines, *more]
        told = {
            "fit": {
                "rows": fit.rows,
                "outliers": fit.outliers,
                "log_likelihood": list(fit.log_likelihood),
                "at_bound": list(fit.at_bound),
                "not_told": list(found.not_identifiable),
                "held_out": found.checks,
                "kept": found.kept != "default",
                "what": found.kept,
            }
        }
    observer.save(path, force=overwrite)
    if as_json:
        noise = dict(zip(observer.noise_names, observer.noise, strict=True))
        summary = {"observer": str(path), "kind": observer.block().kind, "form": observer.form, "noise": noise}
        print_json({**summary, **told, "summary": observer.summary()})
        return
    click.echo("\n".join([str(path), observer.summary(), *lines]))


def _with_recorded_noise(
    chosen: Any, model: Path, robot: str | None, recordings: list[signals.Recording]
) -> tuple[Any, list[str]]:
    """Return the settings with the white noise of the recordings where neither they nor the robot's file give one.

    It is the level to start the fit from; the second value holds the line that says so.
    """
    whose = estimation.robot_of(load_for_robot(model, "model", robot))
    given = chosen.measurement_noise_std is not None or chosen.sensor != "paper" or whose.noise_std is not None
    if given or not recordings:
        return chosen, []
    level, (factor, si) = signals.recorded_noise(recordings), to_si(whose.outputs.unit)
    shown = f"{level / factor:.3g} {whose.outputs.unit}"
    told = f"  the fit starts from a sensor noise of {shown}, white noise of the recordings"
    return replace(chosen, measurement_noise_std=level if si == "rad" else level / factor), [told]


def _fit(
    observer: Any, data: tuple[Path, ...], recordings: list[signals.Recording], named: set[str]
) -> tuple[estimation.FittedObserver, list[str]]:
    """Fit the observer to the recordings; return it and the lines to print."""
    found = estimation.fit_observer(observer, recordings, named)
    unit = observer.robot.outputs.display_unit
    before, after = found.fit.log_likelihood
    lines = [
        f"  noise from {found.fit.rows} measurements, {found.fit.outliers} outliers left out; "
        f"log likelihood of each {before:.2f} -> {after:.2f}"
    ]
    if found.not_identifiable:
        lines.append(f"  not told by the data: {', '.join(found.not_identifiable)}")
    errors = ", ".join(f"{name} {error / to_si(unit)[0]:.4g}" for name, error in found.checks.items())
    verdict = "no better, so the defaults are kept" if found.kept == "default" else f"{found.kept} kept"
    lines.append(f"  error [{unit}] of the look ahead on {found.rows} rows held out: {errors}: {verdict}")
    for path, recording in zip(data, recordings, strict=True):
        lines += [
            f"  {path.name}: {line}"
            for line in estimation.consistency(found.observer, recording).summary().splitlines()
        ]
    return found, lines
