"""softneck resample: a recording at another sample time."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import refuse_existing

from ..shared._console import print_json
from ..shared._options import force_option, json_option, output_option, sample_time_of, target
from ..shared._robot import robot_option


@click.command("resample", epilog="Example: softneck resample fast.csv --sample-time 0.02 -o neck.csv")
@click.argument("recording", metavar="REC", type=click.Path(path_type=Path))
@click.option("--sample-time", "asked", metavar="S|robot", required=True, help="New sample time [s], or the robot's.")
@output_option("recording", "REC")
@robot_option
@force_option
@json_option
def command(recording: Path, asked: str, output: Path | None, robot: str | None, force: bool, as_json: bool) -> None:
    """Bring recording REC to another sample time.

    Measured channels are low-passed first where the new sample time is slower, without a delay; set-points and flags
    hold their last value. At its own sample time a recording stays as it is, to the bit.
    """
    from softneck.signals import read_recording, resampled, write_recording
    from softneck.signals.recording._files import recording_suffix

    path, replace = target(output, f"recordings/{recording.stem}.csv", force=force)
    recording_suffix(path)
    refuse_existing(path, force=replace)
    before = read_recording(recording, robot=robot)
    if asked == "robot":
        sample_time = before.robot.require("sample_time_s", "--sample-time robot")
    else:
        sample_time = sample_time_of(asked, "--sample-time")
    after = resampled(before, sample_time)
    write_recording(path, after, force=replace)
    if as_json:
        print_json({
            "recording": str(path), "rows": len(after), "runs": len(after.runs()), "sample_time_s": after.sample_time,
            "sample_time_before_s": before.sample_time,
        })  # fmt: skip
        return
    click.echo(
        f"{path}: {len(after)} rows at {1e3 * after.sample_time:.6g} ms, from {len(before)} at "
        f"{1e3 * before.sample_time:.6g} ms"
    )
