"""softneck drives jog and record: what an owner does before any controller runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import SettingsError, refuse_existing, require_between
from softneck.signals import signal_names, write_recording

from ..shared._console import note, print_json, print_table, progress
from ..shared._neck import load_neck
from ..shared._options import force_option, json_option, output_option
from ._log import drives_of, log_options, opened_log, require_log
from ._target import (
    Target,
    checked_names,
    drives_options,
    leave_if_asked,
    neck_option,
    open_link,
    override_option,
    sensor_of,
    target_of,
)

if TYPE_CHECKING:
    from softneck.drives import CanLink
    from softneck.drives.bus._link import VirtualLink
    from softneck.drives.commissioning._jog import JogResult
    from softneck.drives.commissioning._record import ExperimentResult
    from softneck.drives.logs._run_log import RunLogger
    from softneck.drives.running._bus_loop import Session
    from softneck.drives.running._keyboard import Keyboard


_pace_option = click.option("--pace", type=float, help="With --simulated: run at this multiple of real time.")


def _session(
    chosen: Target, link: CanLink | VirtualLink, keyboard: Keyboard, overrides: tuple[str, ...], pace: float | None,
    log: RunLogger | None, files: Mapping[str, str | Path],
) -> Session:  # fmt: skip
    from softneck.drives.bus._link import VirtualLink
    from softneck.drives.running._bus_loop import Session

    sensor = None if isinstance(link, VirtualLink) else sensor_of(chosen.file, str(chosen.bus))
    return Session(
        file=chosen.file, link=link, sensor=sensor, override=checked_names(overrides), pace=pace, operator=keyboard,
        log=log, files=files,
    )  # fmt: skip


def _checked(chosen: Target, pace: float | None) -> None:
    if pace is not None:
        require_between("--pace", pace, 0.01, 1000.0)
        if not chosen.simulated:
            raise SettingsError("--pace is for --simulated; a bus runs in real time.")


@click.command("jog", epilog="Example: softneck drives jog 1 --drives drives.toml --bus socketcan:can0 --arm")
@click.argument("motor", metavar="N", type=click.IntRange(1, 8))
@click.option(
    "--amplitude", type=float, default=0.5, show_default=True, metavar="RAD", help="Amplitude of the motor's move."
)
@drives_options
@override_option
@neck_option
@_pace_option
@log_options
@force_option
@json_option
def jog_command(
    motor: int, amplitude: float, drives_file: Path | None, bus: str | None, simulated: bool, robot: str | None,
    arm: bool, overrides: tuple[str, ...], neck: str | None, pace: float | None, log_file: Path | None, no_log: bool,
    force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Pull the tendon of motor N a little, let it out as much, and look where the neck goes.

    Says whether a positive move tilts the neck the way that the neck's tendon angle says; the drives must be zeroed.
    Exit code 1 if it does not: nodes swapped, a sign reversed, a tendon that hangs.
    """
    from softneck.drives import jog
    from softneck.drives.running._keyboard import Keyboard
    from softneck.drives.running._virtual import physics_of

    require_log(log_file, no_log=no_log, force=force)
    virtual = load_neck(neck) if neck else None
    chosen = target_of(drives_file, bus, simulated, arm, neck=virtual, robot=robot)
    _checked(chosen, pace)
    if motor > len(chosen.file.nodes):
        raise click.BadParameter(f"{motor} is not in the range 1<=x<={len(chosen.file.nodes)}.", param_hint="'N'")
    # A neck's tendons stand where its own file says.
    physics = physics_of(chosen.file.moves, virtual) if chosen.is_neck else None
    angles = physics and (physics.tendon_angle_1, physics.tendon_angle_2, physics.tendon_angle_3)
    with (
        open_link(chosen, moves=True, homed=True) as link,
        opened_log(chosen, "jog", log_file, no_log=no_log, force=force) as log,
    ):
        with progress("jog", quiet=as_json) as tell, Keyboard() as keyboard:
            found = jog(
                motor,
                _session(chosen, link, keyboard, overrides, pace, log, drives_of(chosen.path)),
                tendon_angles=angles,
                amplitude=amplitude,
                report=lambda done: tell(done, f"motor {motor}"),
            )
        _print_jog(found, as_json=as_json)
        leave_if_asked(keyboard, terminated=found.ended.terminated)
        found.require()


def _print_jog(found: JogResult, *, as_json: bool) -> None:
    values = found.table()
    if as_json:
        print_json(values)
        return
    rows = []
    for name in values["expected"]:
        cells = [values[key][name] for key in ("expected", "seen")]
        rows.append([name, *("-" if cell is None or cell != cell else f"{cell:.2f}" for cell in cells)])
    print_table(f"Motor {found.motor} (node {found.node}): {found.verdict}", ["way up", "expected", "seen"], rows)


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
@click.option(
    "--runs", type=click.IntRange(1, 100), default=1, show_default=True, help="Repeat it, each time with the next seed."
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 200), default=0, show_default=True, help="Seed of the signal.")
@click.option(
    "--ramp", type=float, default=2.0, show_default=True, metavar="S", help="Ramp in from rest and out to it."
)
@click.option("--max-position", type=float, metavar="RAD", help="Clip set-points to +-RAD. [default: drives file]")
@click.option(
    "--max-speed",
    type=float,
    metavar="RAD/S",
    help="Slow set-points down to this speed. [default: a quarter of the drives file's]",
)
@click.option(
    "--max-slack", type=float, metavar="RAD", help="Pay out no more than this. [default: slack_unwind_rad, at most 3]"
)
@click.option("--payload", type=float, default=0.0, metavar="KG", help="Payload on the platform of --simulated.")
@click.option(
    "--supervision",
    type=click.Path(path_type=Path),
    metavar="JSON",
    help="Also write what the plausibility supervisor compares with: `baseline` of [supervision] in the drives file.",
)
@click.option(
    "--beside",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="LOG.mcap",
    help="With --supervision: compare with this earlier `record` too, such as one with another payload; or a loop's "
    "tracking with this `run`.",
)
@drives_options
@override_option
@neck_option
@_pace_option
@log_options
@force_option
@json_option
def record_command(
    signal_name: str, output: Path, duration: float | None, runs: int, seed: int, ramp: float,
    max_position: float | None, max_speed: float | None, max_slack: float | None, payload: float,
    supervision: Path | None, beside: tuple[Path, ...],
    drives_file: Path | None, bus: str | None, simulated: bool, robot: str | None, arm: bool,
    overrides: tuple[str, ...],
    neck: str | None, pace: float | None, log_file: Path | None, no_log: bool, force: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Record SIGNAL on the drives."""
    from softneck.drives import Experiment, read_run_log, record_signal
    from softneck.drives.bus._link import VirtualLink
    from softneck.drives.commissioning._record import drive_limits
    from softneck.drives.logs._replay import logged_motion
    from softneck.drives.running._keyboard import Keyboard
    from softneck.drives.supervision._calibrate import calibrate, require_loops
    from softneck.drives.supervision._log import MotionLog
    from softneck.signals.recording._files import recording_suffix

    recording_suffix(output)
    refuse_existing(output, force=force)
    if supervision is not None:
        refuse_existing(supervision, force=force)
    elif beside:
        raise SettingsError("--beside needs --supervision: it is what the supervisor compares with that it adds to.")
    require_log(log_file, no_log=no_log, force=force)
    require_between("--payload", payload, 0.0, 1.0, "kg")
    virtual = load_neck(neck) if neck else None
    chosen = target_of(drives_file, bus, simulated, arm, neck=virtual, robot=robot)
    if supervision is not None:
        # What is to be compared with is not judged by what was compared with before.
        chosen = replace(chosen, file=replace(chosen.file, baseline=None))
    _checked(chosen, pace)
    limits = drive_limits(chosen.file, position=max_position, speed=max_speed, slack=max_slack)
    moved = chosen.file.robot
    experiment = Experiment(
        signal=signal_name, limits=limits, duration=duration, seed=seed, runs=runs, ramp=ramp, robot=moved,
        ranges=() if moved is None else chosen.file.ranges,
    )  # fmt: skip
    prepared = experiment.prepared()
    # Before anything moves: what is read back may be damaged.
    like = chosen.file.master_settings(prepared[0][0].sample_time)
    motions = [logged_motion(read_run_log(path), like) for path in beside]
    if loops := [len(motion.due) * like.bus.cycle for motion in motions if motion.references is not None]:
        require_loops(sum(loops))
    with (
        open_link(chosen, moves=True, homed=True, seed=seed) as link,
        opened_log(chosen, "record", log_file, no_log=no_log, force=force) as log,
    ):
        if isinstance(link, VirtualLink):
            link.neck.set(payload=payload)
        with progress("record", quiet=as_json) as tell, Keyboard() as keyboard:
            files = {**drives_of(chosen.path), **({"signal": signal_name} if Path(signal_name).is_file() else {})}
            session = _session(chosen, link, keyboard, overrides, pace, log, files)
            motion = MotionLog()
            session = replace(session, watches=(*session.watches, motion))
            recorded = record_signal(
                [excitation for excitation, _ in prepared],
                replace(session, facts={"record": experiment.facts()}),
                report=lambda done: tell(done, signal_name),
            )
        # Before the log is closed: a full disk must not cost the recording as well.
        if recorded.recording is not None:
            write_recording(output, recorded.recording, force=force)
        facts: dict[str, Any] = {"signal": signal_name, "runs": runs, "changes": prepared[0][1].as_dict()}
        _print_record(output, recorded, facts, str(prepared[0][1]), as_json=as_json)
        leave_if_asked(keyboard, terminated=recorded.ended.terminated)
        recorded.require()
        if supervision is not None:
            settings = recorded.ended.master.settings
            calibrate(
                [*motions, motion.motion()], cycle=settings.bus.cycle, sample_cycles=settings.sample_cycles,
                slack=settings.limits.slack,
            ).save(supervision, force=force)  # fmt: skip
            note(f"{supervision}: what plausibility is judged by; name it in the drives file: [supervision] baseline")


def _print_record(
    output: Path, recorded: ExperimentResult, facts: dict[str, Any], changes: str, *, as_json: bool
) -> None:  # fmt: skip
    if as_json:
        where = None if recorded.recording is None else str(output)
        print_json({"recording": where, **facts, **recorded.table()})
        return
    if recorded.recording is None:
        note(f"{output}: nothing was recorded")
        return
    click.echo(f"{output}: {recorded.rows} of {recorded.planned} rows of {facts['signal']}; set-points: {changes}")
    for name, count in recorded.ended.master.counts.items():
        click.echo(f"{name}: {count}")
