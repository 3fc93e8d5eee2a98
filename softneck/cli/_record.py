"""softneck record: an experiment on the virtual neck."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import refuse_existing, require_between
from softneck.signals import SetPointLimits, prepare, signal, signal_names, write_recording

from .shared._console import print_json, progress
from .shared._neck import load_neck
from .shared._options import force_option, json_option, output_option


@click.command(
    "record",
    help="Record SIGNAL on the virtual neck.\n\nSignals: " + ", ".join(signal_names()) + ".",
    epilog="Example: softneck record eq22 -o eq22.csv --neck paper --seed 1",
)
@click.argument("signal_name", metavar="SIGNAL")
@output_option("recording", "REC", required=True)
@click.option("--neck", default="paper", show_default=True, metavar="paper|lab|rough|NECK.toml", help="Which neck.")
@click.option("--duration", type=float, metavar="S", help="Length in seconds. [default: the signal's own]")
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 2), default=0, show_default=True, help="Seed of noise and signal."
)
@click.option("--payload", type=float, default=0.0, show_default=True, metavar="KG", help="Payload on the platform.")
@click.option("--no-noise", is_flag=True, help="Simulate a perfect inclinometer.")
@click.option("--ramp", type=float, default=0.0, metavar="S", help="Ramp in from rest and out to it. [default: none]")
@click.option("--max-position", type=float, metavar="RAD", help="Clip set-points to +-RAD. [default: the signal's own]")
@click.option("--max-speed", type=float, metavar="RAD/S", help="Slow set-points down to this speed. [default: none]")
@click.option("--max-slack", type=float, metavar="RAD", help="Pay out no more than RAD below rest. [default: none]")
@force_option
@json_option
def command(
    signal_name: str,
    output: Path,
    neck: str,
    duration: float | None,
    seed: int,
    payload: float,
    no_noise: bool,
    ramp: float,
    max_position: float | None,
    max_speed: float | None,
    max_slack: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Record SIGNAL on the virtual neck."""
    from softneck.plant import VirtualNeck, record
    from softneck.signals.recording._files import recording_suffix

    recording_suffix(output)
    refuse_existing(output, force=force)
    require_between("--payload", payload, 0.0, 1.0, "kg")
    bounds = {"position": max_position, "speed": max_speed, "slack": max_slack}
    limits = SetPointLimits(**{name: value for name, value in bounds.items() if value is not None})
    excitation, changes = prepare(signal(signal_name, duration=duration, seed=seed), limits, ramp_s=ramp)
    with progress("record", quiet=as_json):
        recording = record(excitation, VirtualNeck(load_neck(neck)), seed=seed, payload=payload, noise=not no_noise)
    write_recording(output, recording, force=force)
    if as_json:
        facts = {"recording": str(output), "rows": len(recording), "sample_time_s": recording.sample_time}
        print_json({**facts, "signal": signal_name, "changes": changes.as_dict()})
        return
    click.echo(f"{output}: {len(recording)} rows of {signal_name} at {1e3 * recording.sample_time:g} ms")
    if ramp > 0 or limits != SetPointLimits():
        click.echo(f"set-points: {changes}")
