"""softneck observer: a Kalman filter from a saved linear model and a sensor preset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import SettingsError, find_kind, refuse_existing, resolve, to_si

from .shared._console import print_json
from .shared._options import apply_settings, force_option, json_option, output_option, set_option, target
from .shared._robot import load_of, robot_option

if TYPE_CHECKING:
    from softneck.estimation._noise import NoiseFit

# Part of each run to fit the levels to; the rest checks them.
_FITTED = 0.7


@click.command("observer", epilog="Example: softneck observer rls.npz -o observer.npz --sensor paper")
@click.argument("model", type=click.Path(path_type=Path))
@output_option("observer", "OBSERVER")
@click.option(
    "--sensor", help="Sensor preset: its noise is the measurement noise. [default: paper; of another robot its own]"
)
@click.option(
    "--data",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="REC",
    help="Estimate the noise levels from this recording (maximum likelihood); with --sensor all but that of the "
    "measurement. May be given several times.",
)
@click.option("--gyro", is_flag=True, help="Driven by the gyro's rates, with their bias as a state (form=gyro).")
@robot_option
@set_option
@force_option
@json_option
def command(
    model: Path,
    output: Path | None,
    sensor: str | None,
    data: tuple[Path, ...],
    gyro: bool,
    robot: str | None,
    settings: tuple[str, ...],
    force: bool,
    as_json: bool,
) -> None:
    """Build a Kalman filter over the linear MODEL.

    Three forms: the model with a disturbance on each axis (default), --gyro, and --set form=kinematic.
    """

    kind = find_kind("kalman", "observer")
    path, replace = target(output, "observers/kalman.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    if gyro and any(setting.replace(" ", "").startswith("form=") for setting in settings):
        raise SettingsError("--gyro is the same as --set form=gyro; give only one of them.")
    chosen = apply_settings(resolve(kind.settings), settings, sensor=sensor, form="gyro" if gyro else None)
    observer = chosen.design(load_of(model, robot, role="model"))
    told: dict[str, Any] = {}
    lines: list[str] = []
    if data:
        fit, kept, lines = _fitted(observer, data, robot, fixed=() if sensor is None else (observer.noise_names[0],))
        observer = fit.observer if kept else observer
        told = {"fit": {"rows": fit.rows, "outliers": fit.outliers, "log_likelihood": list(fit.log_likelihood),
                        "at_bound": list(fit.at_bound), "kept": kept}}  # fmt: skip
    observer.save(path, force=replace)
    if as_json:
        noise = dict(zip(observer.noise_names, observer.noise, strict=True))
        summary = {"observer": str(path), "kind": kind.name, "form": observer.form, "noise": noise}
        print_json({**summary, **told, "summary": observer.summary()})
        return
    click.echo("\n".join([str(path), observer.summary(), *lines]))


def _fitted(
    observer: Any, data: tuple[Path, ...], robot: str | None, *, fixed: tuple[str, ...]
) -> tuple[NoiseFit, bool, list[str]]:
    """Return noise levels fitted to the first part of each run, whether the rest speaks for them, and what to say."""
    # Imported here: `softneck --help` must not wait for scipy's optimisers.
    from softneck.estimation import consistency, fit_noise
    from softneck.estimation._consistency import bridging_error
    from softneck.signals import concatenate, read_recording

    recordings = [read_recording(path, robot=robot) for path in data]
    parts = [recording.split(_FITTED) for recording in recordings]
    fit = fit_noise(observer, [head for head, _ in parts], fixed=fixed)
    held_out = concatenate([tail for _, tail in parts])
    unit = observer.robot.outputs.display_unit
    default, fitted = (bridging_error(item, held_out) / to_si(unit)[0] for item in (observer, fit.observer))
    kept = fitted < default
    before, after = fit.log_likelihood
    lines = [
        f"  noise from {fit.rows} measurements, {fit.outliers} outliers left out; "
        f"log likelihood of each {before:.2f} -> {after:.2f}"
    ]
    if fit.at_bound:
        lines.append(f"  not determined by the data: {', '.join(fit.at_bound)}")
    verdict = "kept" if kept else "not better, so the default levels are kept"
    lines.append(f"  gaps of 5 samples over {len(held_out)} rows held out: {default:.3f} {unit} RMS by the default "
                 f"{fitted:.3f} by the fitted levels: {verdict}")  # fmt: skip
    for path, recording in zip(data, recordings, strict=True):
        taken = fit.observer if kept else observer
        lines += [f"  {path.name}: {line}" for line in consistency(taken, recording).summary().splitlines()]
    return fit, kept, lines
