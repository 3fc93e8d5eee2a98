"""softneck record: an experiment on the virtual neck, or on that of another robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck import drives, identification, plant, signals
from softneck.core import SettingsError, refuse_existing, require_between, require_finite, to_si
from softneck.robot import Robot, find_robot, load_for_robot
from softneck.signals import (
    Excitation,
    concatenate,
    multisine_experiments,
    prepare,
    read_recording,
    require_same_robot,
    signal,
    signal_names,
    write_recording,
)

from .shared._console import print_json, print_table, progress
from .shared._options import common_options, output_option

if TYPE_CHECKING:
    from softneck.robot import Robot


@click.command(
    "record",
    help="Record SIGNAL on the virtual neck, or on that of a robot.\n\nSignals: "
    + ", ".join(signal_names())
    + ", or a recording whose set-points are played. With a MODEL of kind guarded: the next experiment, with "
    "motions on which its members disagree or that were not recorded yet. REC holds its set-points and the outputs "
    "that the model expects. Play it with `softneck drives record REC`.",
    epilog="Example: softneck record eq22 -o eq22.csv --neck paper --seed 1",
)
@click.argument("signal_name", metavar="SIGNAL|MODEL")
@output_option("recording", "REC", required=True)
@click.option(
    "--neck",
    metavar="paper|lab|rough|NECK.toml",
    help="Which neck, or whose physics the robot has.  [default: what the robot says; paper]",
)
@click.option(
    "--duration", type=float, metavar="S", help="Length in seconds. [default: the signal's own; 60 of a MODEL]"
)
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 2), default=0, show_default=True, help="Seed of noise and signal."
)
@click.option("--amplitude", type=float, metavar="A", help="`multisine`: largest input. [default: 1]")
@click.option("--band", metavar="LOW,HIGH", help="`multisine`: from where to where [rad/s].")
@click.option(
    "--cocontraction", type=float, default=0.0, show_default=True, metavar="RAD",
    help="Played around this common position of all motors, which keeps tendons taut.",
)  # fmt: skip
@click.option("--payload", type=float, default=0.0, show_default=True, metavar="KG", help="Payload on the platform.")
@click.option("--max-position", type=float, metavar="RAD", help="Clip set-points to +-RAD. [default: the signal's own]")
@common_options("robot", "force")
def command(
    signal_name: str,
    output: Path,
    robot: str | None,
    neck: str | None,
    duration: float | None,
    seed: int,
    amplitude: float | None,
    band: str | None,
    cocontraction: float,
    payload: float,
    max_position: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Record SIGNAL on the virtual neck or robot."""
    signals.recording_suffix(output)
    refuse_existing(output, force=force)
    if Path(signal_name).suffix.lower() == ".npz":
        duration = 60.0 if duration is None else duration
        record_next(
            Path(signal_name), output, duration=duration, seed=seed, position=max_position, robot=robot, force=force,
            as_json=as_json,
        )  # fmt: skip
        return
    require_between("--payload", payload, 0.0, 1.0, "kg")
    whose = find_robot(robot, beside=output)
    virtual = plant.VirtualNeck.of(whose, None if neck is None else plant.NeckParameters.preset(neck))
    given = {} if max_position is None else {"position": max_position}
    limits = signals.SetPointLimits(**_robot_limits(whose) | given)
    experiment = {"amplitude": amplitude, "band": _band(band)}
    asked = {name: value for name, value in experiment.items() if value is not None}
    if asked and (signal_name != "multisine" or duration is not None):
        raise SettingsError(
            f"`--{next(iter(asked))}` asks for experiments of a frequency response: the signal is `multisine` "
            "then, and takes no `--duration`, which would end its periods."
        )
    if asked:
        played = multisine_experiments(seed=seed, robot=whose, **asked)
    else:
        played = _signals(signal_name, duration, seed, whose)
    require_finite("--cocontraction", cocontraction, "rad")
    common = to_si(whose.motors.unit)[0] * cocontraction
    played = [replace(item, set_points=item.set_points + common) for item in played]
    prepared = [prepare(item, limits) for item in played]
    changes = prepared[0][1]
    if asked and any(item != type(changes)() for _, item in prepared):
        raise SettingsError(
            "the experiments go beyond the motors' limits; lower `--amplitude`, the top of `--band` "
            "or `--cocontraction`."
        )
    with progress("record", quiet=as_json) as report:
        runs = []
        for number, (excitation, _) in enumerate(prepared):
            runs.append(plant.record(excitation, virtual, seed=seed + number, payload=payload))
            report((number + 1) / len(prepared), f"run {number + 1} of {len(prepared)}")
        recording = runs[0] if len(runs) == 1 else concatenate(runs)
    write_recording(output, recording, force=force)
    if as_json:
        facts = {"recording": str(output), "rows": len(recording), "sample_time_s": recording.sample_time}
        print_json({**facts, "signal": signal_name, "changes": changes.as_dict()})
        return
    click.echo(f"{output}: {len(recording)} rows of {signal_name} at {1e3 * recording.sample_time:g} ms")
    if given or changes != type(changes)():
        click.echo(f"set-points: {changes}")


def _signals(name: str, duration: float | None, seed: int, robot: Robot) -> list[Excitation]:
    """Return a signal by its name, or the set-points of each run of a recording."""
    if Path(name).suffix.lower() not in (".csv", ".parquet"):
        return [signal(name, duration=duration, seed=seed, robot=robot)]
    recording = read_recording(name)
    require_same_robot(robot, recording.robot, f"{name} and the virtual plant: set-points")
    rows = None if duration is None else max(2, round(duration / recording.sample_time))
    return [
        Excitation(name, run.time[:rows] - run.time[0], run.set_points[:rows], recording.sample_time)
        for run in recording.runs()
    ]


def _band(text: str | None) -> tuple[float, float] | None:
    """Return the ends [rad/s] that `--band` names, None where it is not given."""
    if text is None:
        return None
    words = text.split(",")
    try:
        low, high = map(float, words)
    except ValueError:
        raise SettingsError(f"`--band` is two frequencies in rad/s, such as 0.5,25; got `{text}`.") from None
    return low, high


def _robot_limits(robot: Robot) -> dict[str, float]:
    """Return the bounds on set-points that a robot gives [rad], [rad/s]; the preset plays its signals as they are."""
    motors, scale = robot.motors, to_si(robot.motors.unit)[0]
    if not robot.in_header():
        return {}
    ends = [*(motors.setpoint_min or ()), *(motors.setpoint_max or ())]
    given = {"position": [abs(end) for end in ends], "speed": motors.rate_limit and [min(motors.rate_limit)]}
    return {name: scale * max(values) for name, values in given.items() if values}


def record_next(
    source: Path, output: Path, *, duration: float, seed: int, position: float | None, robot: str | None,
    force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Write the set-points of the next recording, with the outputs that the model expects."""
    known = _load_known(source, robot)
    with progress("next experiment", quiet=as_json) as report:
        bounds = identification.Bounds.of(known.robot, _limits(known.robot, position))
        found = identification.next_experiment(known, duration=duration, seed=seed, bounds=bounds, progress=report)
    signals.write_recording(output, found.recording, force=force)
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
        f"{facts['members']}: {doubt['before']:.2g} {unit} rms over all candidate signals, "
        f"{doubt['expected_after']:.2g} {unit} expected after this recording"
    )


def _load_known(source: Path, robot: str | None) -> identification.Known:
    model = load_for_robot(source, robot=robot)
    if not isinstance(model, identification.Model):
        raise SettingsError(f"{source}: is no model; give one of kind `guarded`.")
    return identification.Known.of_model(model)


def _limits(robot: Robot, position: float | None) -> signals.SetPointLimits:
    """Return the required limits, within those of the robot's drives if it names any."""
    if robot.drives is not None and robot.folder is not None:
        return drives.drive_limits(drives.load_drives(robot.folder / robot.drives), position=position)
    return signals.SetPointLimits(position=float("inf") if position is None else position)
