"""softneck excite: what to record next, so that members of a model stop disagreeing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import refuse_existing

from ..shared._console import print_json, print_table, progress
from ..shared._options import force_option, json_option, output_option
from ..shared._robot import load_of, robot_option

if TYPE_CHECKING:
    from softneck.identification.selection._experiment_design import Known
    from softneck.robot import Robot
    from softneck.signals import SetPointLimits


@click.command(
    "excite",
    help="Design the next recording: motions on which the members of MODEL (guarded, ensemble) disagree, or lead where "
    "nothing was seen. Of a recording REC, members are trained first.\n\nNEXT.csv holds the set-points, and as outputs "
    "what the members expect; `softneck drives record NEXT.csv` and `softneck record NEXT.csv` play it.",
    epilog="Example: softneck excite guarded.npz -o next.csv --duration 70",
)
@click.argument("source", metavar="REC|MODEL", type=click.Path(path_type=Path))
@output_option("set-points", "NEXT.csv", required=True)
@click.option("--duration", type=float, default=60.0, show_default=True, metavar="S", help="Length in seconds.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 2), default=0, show_default=True, help="Of levels and phases.")
@click.option("--max-position", type=float, metavar="RAD", help="Keep set-points within +-RAD. [default: the robot's]")
@click.option("--max-speed", type=float, metavar="RAD/S", help="Keep them this slow. [default: the robot's]")
@click.option(
    "--max-slack", type=float, metavar="RAD", help="Pay out no more than RAD below rest. [default: the robot's drives']"
)
@robot_option
@force_option
@json_option
def command(
    source: Path,
    output: Path,
    duration: float,
    seed: int,
    max_position: float | None,
    max_speed: float | None,
    max_slack: float | None,
    robot: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Design the next recording."""
    from softneck.identification.selection._candidate_motions import Bounds
    from softneck.identification.selection._experiment_design import next_experiment
    from softneck.signals import write_recording
    from softneck.signals.recording._files import recording_suffix

    recording_suffix(output)
    refuse_existing(output, force=force)
    with progress("excite", quiet=as_json) as report:
        known = _known(source, robot, seed, lambda done, what: report(0.8 * done, what))
        bounds = Bounds.of(known.robot, _limits(known.robot, max_position, max_speed, max_slack))
        found = next_experiment(
            known, duration=duration, seed=seed, bounds=bounds,
            progress=lambda done, what: report(0.8 + 0.2 * done, what),
        )  # fmt: skip
    write_recording(output, found.recording, force=force)
    facts = {
        "next": str(output),
        "rows": len(found.recording),
        "sample_time_s": found.recording.sample_time,
        **found.as_dict(),
    }
    if as_json:
        print_json(facts)
        return
    rows = [
        [f"{part['start_s']:.1f}", part["signal"], f"{part['size']:g}", f"{part['speed']:g}", part["why"]]
        for part in facts["parts"]
    ]
    unit = known.robot.outputs.display_unit
    doubt = facts[f"disagreement_{unit}"]
    print_table(f"{output}: {len(found.recording)} rows", ["at [s]", "signal", "size", "speed", "why"], rows)
    click.echo(
        f"{facts['members']}: {doubt['before']:.2g} {unit} rms over all that could be played, "
        f"{doubt['expected_after']:.2g} {unit} expected once this is recorded"
    )


def _known(source: Path, robot: str | None, seed: int, report) -> Known:
    from softneck.core import SettingsError
    from softneck.identification import Model
    from softneck.identification.selection._experiment_design import Known
    from softneck.signals import read_recording

    if source.suffix.lower() != ".npz":
        return Known.of_recording(read_recording(source, robot=robot), seed=seed, progress=report)
    model = load_of(source, robot)
    if not isinstance(model, Model):
        raise SettingsError(f"{source}: is no model; give one of kind `guarded` or `ensemble`, or a recording.")
    return Known.of_model(model)


def _limits(robot: Robot, position: float | None, speed: float | None, slack: float | None) -> SetPointLimits:
    """Return what is asked for, and what the drives of a robot allow where it names them."""
    from softneck.drives import load_drives
    from softneck.drives.commissioning._record import drive_limits
    from softneck.signals import SetPointLimits

    given = {"position": position, "speed": speed, "slack": slack}
    if robot.drives is not None and robot.folder is not None:
        return drive_limits(load_drives(robot.folder / robot.drives), **given)
    asked = {name: value for name, value in given.items() if value is not None}
    return SetPointLimits(**{"position": float("inf"), **asked})
