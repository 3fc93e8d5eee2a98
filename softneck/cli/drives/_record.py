"""softneck drives record: an identification experiment on the drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from softneck import drives, signals
from softneck.core import refuse_existing, require_between
from softneck.signals import signal_names, write_recording

from ..shared._console import note, print_json, progress
from ..shared._options import common_options, output_option
from ._target import Asked, drives_options, moving, require_log

# From rest and out to it [s]: Eq. 22 begins at up to 1.9 rad, which a winch turns in half a second at the least.
_RAMP_S = 2.0


@click.command(
    "record",
    help="Record SIGNAL on the drives: an identification experiment, ramped in and out.\n\n"
    "Signals: "
    + ", ".join(signal_names())
    + ", or a recording whose set-points are played. The drives must be zeroed. If a fault ends it early, what was "
    "recorded until then is written, and the exit code is 1; Ctrl-C ramps to rest, keeps the data, and exits with 130.",
    epilog="Example: softneck drives record eq22 -o eq22.csv --drives drives.toml --bus socketcan:can0 --arm",
)
@click.argument("signal_name", metavar="SIGNAL")
@output_option("recording", "REC", required=True)
@click.option("--duration", type=float, metavar="S", help="Length in seconds. [default: the signal's own]")
@click.option("--seed", type=click.IntRange(0, 2**31 - 200), default=0, show_default=True, help="Seed of the signal.")
@click.option("--max-position", type=float, metavar="RAD", help="Clip set-points to +-RAD. [default: drives file]")
@click.option(
    "--cocontraction", type=float, default=0.0, show_default=True, metavar="RAD",
    help="Played around this common position of all motors, which keeps tendons taut.",
)  # fmt: skip
@click.option("--payload", type=float, default=0.0, metavar="KG", help="Payload on the platform of --simulated.")
@drives_options("override", "pace", "log")
@common_options("force")
def record_command(
    asked: Asked, signal_name: str, output: Path, duration: float | None, seed: int, max_position: float | None,
    cocontraction: float, payload: float,
    force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Record SIGNAL on the drives."""
    signals.recording_suffix(output)
    refuse_existing(output, force=force)
    require_log(asked.log, force=force)
    require_between("--payload", payload, 0.0, 1.0, "kg")
    chosen = asked.target()
    moved, limits = chosen.file.robot, drives.drive_limits(chosen.file, position=max_position)
    experiment = drives.Experiment(
        signal=signal_name, limits=limits, duration=duration, seed=seed, ramp=_RAMP_S,
        cocontraction=cocontraction, robot=moved,
        ranges=() if moved is None else chosen.file.ranges,
    )  # fmt: skip
    prepared = experiment.prepare_runs()
    files = {"signal": signal_name} if Path(signal_name).is_file() else {}
    with moving(asked, chosen, "record", force=force, homed=True, seed=seed, **files) as (session, end):
        if isinstance(session.link, drives.VirtualLink):
            session.link.neck.set(payload=payload)
        with progress("record", quiet=as_json) as tell:
            recorded = drives.record_signal(
                [excitation for excitation, _ in prepared],
                replace(session, facts={"record": experiment.facts()}),
                report=lambda done: tell(done, signal_name),
            )
        for text in recorded.notes:
            note(text)
        recording, where = recorded.recording, None
        if recording is not None:
            where = end.write(output, lambda path: write_recording(path, recording, force=force))
        facts: dict[str, Any] = {"signal": signal_name, "runs": len(prepared), "changes": prepared[0][1].as_dict()}
        _print_record(where, recorded, facts, str(prepared[0][1]), as_json=as_json)
        end.conclude(recorded.ended.master.supervisor.fault, recorded.require)


def _print_record(
    path: Path | None, recorded: drives.ExperimentResult, facts: dict[str, Any], changes: str, *, as_json: bool
) -> None:
    if as_json:
        print_json({"recording": path and str(path), **facts, **recorded.table()})
        return
    if recorded.recording is None:
        note("nothing was recorded")
        return
    rows = f"{recorded.rows} of {recorded.planned} rows of {facts['signal']}"
    click.echo(f"{path or 'no recording'}: {rows}; set-points: {changes}")
    for name, count in recorded.ended.master.counts.items():
        click.echo(f"{name}: {count}")
