"""softneck calibrate: a virtual neck that follows recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from softneck.core import CheckFailedError, DataError, SettingsError, atomic_write, refuse_existing

from .shared._console import print_json, progress
from .shared._options import force_option, json_option, output_option, target

if TYPE_CHECKING:
    from softneck.identification import Model
    from softneck.signals import Recording

# By definition of issue 29: a neck that follows less is not the user's.
LEAST_FIT = 85.0
# What a model of the equations is asked to play [s].
_PLAYED = 60.0


@click.command(
    "calibrate",
    epilog="Example: softneck calibrate 0g.csv 1000g.csv --payload 0 --payload 1 -o my_neck.toml; then "
    "softneck verify pi.npz family.npz my_neck.toml",
)
@click.argument("sources", metavar="REC...|GREYBOX", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("neck file", "NECK.toml")
@click.option(
    "--payload", "payloads", multiple=True, type=float,
    help="Of each recording in turn [kg]. [default: what its column `payload` says, else 0]",
)  # fmt: skip
@click.option("--evaluations", default=30, show_default=True, help="Steps of the search.")
@force_option
@json_option
def command(
    sources: tuple[Path, ...],
    output: Path | None,
    payloads: tuple[float, ...],
    evaluations: int,
    force: bool,
    as_json: bool,
) -> None:
    """Fit the virtual neck to RECORDINGS, or to what a model of kind `greybox` answers.

    Payload and geometry that the robot file gives stay as they are. The neck is written only if its free run on the
    last 30 % of each run, which it was not fitted to, follows pitch and roll to 85 %; else the exit code is 1.
    """
    from softneck.plant._calibration import calibrate
    from softneck.signals.recording._conditions import conditions

    path, replace = target(output, "necks/neck.toml", force=force, ending=".toml")
    refuse_existing(path, force=replace)
    parts = [_recording(source) for source in sources]
    given = payloads or tuple(max(conditions(part)["payload_kg"]) for part in parts)
    if len(given) != len(parts):
        raise SettingsError(
            f"{len(given)} payloads were given for {len(parts)} recordings; give one for each, in turn."
        )
    robot = parts[0].robot
    known = {"winch_radius": robot.winch_radius_m} if robot.winch_radius_m is not None else {}
    with progress("calibrate", quiet=as_json) as report:
        found = calibrate(parts, given, known=known, evaluations=evaluations, progress=report)
    fits = ", ".join(f"{pitch:.1f}/{roll:.1f}" for pitch, roll in found.fits)
    if not found.worst >= LEAST_FIT:
        raise CheckFailedError(
            f"the best neck follows the runs to {fits} % (pitch/roll), less than {LEAST_FIT:g}: not written. Give the "
            "payloads (--payload), more --evaluations, or verify on a `greybox` or `nss` model instead."
        )
    with atomic_write(path, force=replace) as temporary:
        temporary.write_text(found.toml(), encoding="utf-8")
    if as_json:
        print_json({"neck": str(path), "fits": found.fits, "worst": found.worst, "start": found.start,
                    "fitted": found.fitted, "known": known})  # fmt: skip
        return
    click.echo(f"{path}: free run on what is held out, pitch/roll of each run: {fits} %; began at `{found.start}`")


def _recording(source: Path) -> Recording:
    from softneck.core import load
    from softneck.signals import read_recording

    return _played(load(source, role="model"), source) if source.suffix == ".npz" else read_recording(source)


def _played(model: Model, source: Path) -> Recording:
    """Return what a model answers to Eq. 22."""
    from softneck.signals import Recording, signal

    if model.kind != "greybox":
        raise DataError(f"{source}: is of kind {model.kind}; a neck is calibrated to recordings or to a `greybox`.")
    model.robot.require_neck("a calibrated neck")
    played = signal("eq22", duration=_PLAYED)
    if abs(model.sample_time - played.sample_time) > 1e-9:
        raise DataError(f"{source}: is at {model.sample_time:g} s; Eq. 22 is played at {played.sample_time:g} s.")
    block = model.block()
    names = [port.name for port in block.inputs]
    U = [[port.start for port in block.inputs]] * (len(played.time) - 1)
    inputs = block.checked_inputs(U)  # pyright: ignore[reportArgumentType]
    for j in (1, 2, 3):
        inputs[:, names.index(f"motor_setpoint_{j}")] = played.set_points[:-1, j - 1]
    start = block.initial_state()
    outputs = [port.name for port in block.outputs]
    rows = [outputs.index(axis) for axis in ("pitch", "roll")]
    Y = np.vstack([start.outputs[rows], block.run(start, inputs)[1][:, rows]])
    channels = {f"motor_setpoint_{j}": played.set_points[:, j - 1] for j in (1, 2, 3)}
    return Recording(played.time, played.sample_time, {**channels, "pitch": Y[:, 0], "roll": Y[:, 1]})
