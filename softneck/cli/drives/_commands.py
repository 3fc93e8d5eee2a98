"""softneck drives: the CANopen drives, or simulated ones that speak the same frames."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import click

from softneck import cosim, drives, signals
from softneck.core import SettingsError, refuse_existing, require_between
from softneck.signals import signal_names, write_recording

from ..shared._console import note, print_json, print_table, progress
from ..shared._groups import NearGroup
from ..shared._options import common_options, output_option, target, trust_option
from ._closing import closing
from ._commission import commission_command
from ._target import (
    Asked,
    drives_of,
    drives_options,
    moving,
    open_link,
    opened_log,
    require_log,
    sensor_of,
    sensor_or_reason,
    target_of,
)

# From rest and out to it [s]: Eq. 22 begins at up to 1.9 rad, which a winch turns in half a second at the least.
_RAMP_S = 2.0


@click.group(
    "drives",
    cls=NearGroup,
    epilog="Example: softneck drives check --simulated. Every command takes --json, and --help lists its options.",
)
def command() -> None:
    """CANopen drives (CiA 301/402): commission, check, record, run, stop, reset.

    While drives move on a bus, Escape and space stop them at once; Ctrl-C ramps to rest first.

    What these commands do was shown on simulated drives only; no hardware was at hand.
    """


@command.command("check", epilog="Example: softneck drives check --simulated")
@drives_options("override")
@common_options()
def check_command(asked: Asked, as_json: bool) -> None:
    """Pre-flight: identity, firmware, factors, modes, options, limits, guarding; each value written is read back.

    Writes the configuration, moves nothing. Exit code 1 if a check does not hold.
    """
    chosen = asked.target()
    with open_link(chosen, moves=False, homed=True) as link:
        sensor = None if chosen.simulated else sensor_or_reason(chosen.file)
        report = drives.preflight(link, chosen.file, override=asked.override, sensor=sensor)
    _show(report, as_json=as_json)
    report.require()


def _show(report: drives.Report, *, as_json: bool) -> None:
    if as_json:
        print_json(report.table())
        return
    rows = []
    for row in report.rows:
        verdict = "ok" if row.holds else "overridden" if row.name in report.overridden else "fails"
        rows.append([f"{row.node or 'bus'} {row.name}", row.found, verdict])
    print_table(f"Pre-flight, guarding by {report.guarding}", ["check", "found", "verdict"], rows)


@command.command("run", epilog="Example: softneck drives run pi.npz --loop loop.toml --simulated")
@click.argument("controller", metavar="CONTROLLER", type=click.Path(path_type=Path))
@click.option("--loop", "loop_file", required=True, type=click.Path(path_type=Path), metavar="LOOP.toml",
              help="Observer, reference and duration; its plant is the virtual neck of --simulated.")  # fmt: skip
@click.option("--certificate", "certificates", multiple=True, type=click.Path(path_type=Path),
              help="Certificate of `softneck verify`, or of `simulate`: both are needed. [default: CONTROLLER and LOOP "
              "with .certificate.json]")  # fmt: skip
@drives_options("override", "pace", "log")
@output_option("recording of the run", "REC")
@trust_option
@common_options("force")
def run_command(
    asked: Asked, controller: Path, loop_file: Path, certificates: tuple[Path, ...],
    output: Path | None, trust: bool, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Run CONTROLLER in the loop of LOOP.toml on the drives: enable, ramp in, control, ramp out, switch off.

    Refused unless a certificate of `softneck verify` shows what drives need of the controller, one of `softneck
    simulate` covers controller, observer, loop and drives file for the whole run, and the loop, run again on its own
    plant, does the same. Exit code 1 if anything stopped it, or a drive did not confirm that it is off; 143 if SIGTERM
    ended it (to rest, then off).
    """
    path, replace = target(output, f"results/drives_{loop_file.stem}.csv", force=force)
    signals.recording_suffix(path)
    refuse_existing(path, force=replace)
    require_log(asked.log, force=force)
    cosim.require_trusted(loop_file, trust=trust)
    setup = cosim.load_loop(loop_file)
    drives_file = asked.drives
    if drives_file is None and "drives" in setup.files:
        drives_file = Path(setup.files["drives"][0])
    virtual = drives.neck_of(setup.loop)
    moves: Any = asked.robot or (setup.loop.robot if setup.loop.robot.in_header() else None)
    chosen = target_of(drives_file, asked.bus, asked.simulated, asked.arm, neck=virtual, robot=moves)
    if not controller.is_file():
        raise SettingsError(f"{controller}: no such file.")
    moved = chosen.file.moves
    certified = drives.require_certified(
        setup, controller, certificates, asked.override, drives=chosen.path, robot=moved
    )
    deployed = drives.prepare(setup, controller, moved)
    for text in deployed.notes:
        note(text)
    if certified is not None:
        again = drives.require_same_again(deployed.loop, certified[1])
        note(f"{certified[1].path}: {again:g} of {deployed.loop.duration:g} s run again on the loop's plant: the same")
    files: dict[str, str | Path] = {role: path for role, (path, _) in setup.files.items()}
    files |= {"loop": loop_file, "controller": controller, **drives_of(chosen.path)}
    sensor: Any = None if chosen.simulated else sensor_of(chosen.file)
    with contextlib.ExitStack() as last, contextlib.ExitStack() as stack:
        link = None if chosen.simulated else cast("drives.CanLink", stack.enter_context(open_link(chosen, moves=True)))
        log = stack.enter_context(opened_log(chosen, "run", asked.log, force=force))
        end = stack.enter_context(closing(last, "run", log))
        with progress("drives", quiet=as_json) as tell:
            report = lambda done: tell(done, controller.name)  # noqa: E731
            if link is None:
                result = drives.run_simulated(
                    deployed, chosen.file, neck=virtual, override=asked.override, pace=asked.pace,
                    report=report, operator=end.keyboard, log=log, files=files,
                )  # fmt: skip
            else:
                result = drives.run_on_bus(
                    deployed, chosen.file, link, sensor, override=asked.override, report=report, operator=end.keyboard,
                    log=log, files=files,
                )  # fmt: skip
        for text in result.notes[len(deployed.notes) :]:
            note(text)
        where = None
        if len(result.signals.time) > 1:
            where = end.write(path, lambda to: signals.write_recording(to, result.recording(), force=replace))
        _print_run(where, result, as_json=as_json)
        end.conclude(result.fault, result.require)


def _print_run(path: Path | None, result: drives.DrivesResult, *, as_json: bool) -> None:
    if as_json:
        print_json({"recording": path and str(path), **result.table()})
        return
    rows = [["phase", result.phase], ["bus cycles", str(result.cycles)]]
    rows += [[name, str(count)] for name, count in result.counts.items()]
    if not result.simulated:
        times = result.times
        rows.append(["cycle", f"{times} ms"])
        rows.append(["missed cycles", f"{times.missed} of {times.count + times.missed}"])
    rows.append(["real-time factor", f"{result.real_time_factor:.1f}"])
    print_table("no recording" if path is None else str(path), ["what", "value"], rows)


@command.command("stop")
@drives_options()
@common_options()
def stop_command(asked: Asked, as_json: bool) -> None:
    """Quick stop, then no voltage, for every drive; always allowed. Exit code 1 if one may still have power."""
    chosen = asked.target()
    with open_link(chosen, moves=False) as link:
        states = drives.stop(link, chosen.file)
    _states(states, "stopped", as_json=as_json)
    drives.require_stopped(states)


@command.command("reset")
@drives_options()
@common_options()
def reset_command(asked: Asked, as_json: bool) -> None:
    """Acknowledge latched faults; no drive moves. Exit code 1 if a fault stays."""
    chosen = asked.target()
    with open_link(chosen, moves=False) as link:
        states = drives.reset(link, chosen.file)
    _states(states, "reset", as_json=as_json)
    drives.require_reset(states)


def _states(states: dict[int, str], what: str, *, as_json: bool) -> None:
    if as_json:
        print_json({what: [{"node": node, "state": state} for node, state in states.items()]})
    else:
        print_table(what, ["node", "state"], [[str(node), state] for node, state in states.items()])


@command.command(
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


command.add_command(commission_command)
