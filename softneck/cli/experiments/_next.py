"""softneck record MODEL: what to record next, so that members of a model stop disagreeing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import SettingsError
from softneck.robot._opened import opened

from ..shared._console import print_json, print_table, progress

if TYPE_CHECKING:
    from softneck.identification.selection._experiment_design import Known
    from softneck.robot import Robot
    from softneck.signals import SetPointLimits


def record_next(
    source: Path, output: Path, *, duration: float, seed: int, limits: Mapping[str, float | None], robot: str | None,
    force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Write the set-points of the next recording, and as outputs what the members of the model expect."""
    from softneck.identification.selection._candidate_motions import Bounds
    from softneck.identification.selection._experiment_design import next_experiment
    from softneck.signals import write_recording

    known = _known(source, robot)
    with progress("next experiment", quiet=as_json) as report:
        bounds = Bounds.of(known.robot, _limits(known.robot, limits))
        found = next_experiment(known, duration=duration, seed=seed, bounds=bounds, progress=report)
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


def _known(source: Path, robot: str | None) -> Known:
    from softneck.identification import Model
    from softneck.identification.selection._experiment_design import Known

    model = opened(source, robot=robot)
    if not isinstance(model, Model):
        raise SettingsError(f"{source}: is no model; give one of kind `guarded`.")
    return Known.of_model(model)


def _limits(robot: Robot, given: Mapping[str, float | None]) -> SetPointLimits:
    """Return what is asked for, and what the drives of a robot allow where it names them."""
    from softneck.drives import load_drives
    from softneck.drives.commissioning._record import drive_limits
    from softneck.signals import SetPointLimits

    if robot.drives is not None and robot.folder is not None:
        return drive_limits(load_drives(robot.folder / robot.drives), **given)
    asked = {name: value for name, value in given.items() if value is not None}
    return SetPointLimits(**{"position": float("inf"), **asked})
