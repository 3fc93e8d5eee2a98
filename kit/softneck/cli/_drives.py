"""softneck drives: the CANopen drives, or simulated ones that speak the same frames."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from softneck.core import SettingsError, refuse_existing
from softneck.cosim import load_loop
from softneck.drives import (
    OVERRIDES,
    CanInclinometer,
    CanLink,
    DrivesFile,
    DrivesResult,
    Report,
    VirtualLink,
    default_drives,
    load_drives,
    open_bus,
    preflight,
    prepare,
    require_certified,
    reset,
    run_on_bus,
    run_simulated,
    scan,
    simulated_neck,
    stop,
    zero,
)
from softneck.drives.master import Tilt
from softneck.signals import recording_suffix, write_recording

from ._console import note, print_json, print_table, progress
from ._drives_view import live_view
from ._neck import load_neck
from ._options import force_option, json_option, output_option, target

_SAMPLE_TIME = 0.02


@dataclass(frozen=True, slots=True)
class _Target:
    """Which drives a command talks to."""

    file: DrivesFile
    bus: str | None
    simulated: bool
    arm: bool


def _drives_options(function: Callable) -> Callable:
    options = (
        click.option("--drives", "drives_file", type=click.Path(path_type=Path), metavar="DRIVES.toml",
                     help="Node ids, gear, encoder, signs, limits, sensor, guarding."),
        click.option("--bus", metavar="INTERFACE:CHANNEL", help="Such as socketcan:can0, virtual:x."),
        click.option("--simulated", is_flag=True, help="Simulated drives on the virtual neck, in this process."),
        click.option("--arm", is_flag=True, help="Let drives on a bus move."),
    )  # fmt: skip
    for option in reversed(options):
        function = option(function)
    return function


def _target(drives_file: Path | None, bus: str | None, simulated: bool, arm: bool) -> _Target:
    if (bus is None) == (not simulated):
        raise SettingsError("say which drives: --bus INTERFACE:CHANNEL, or --simulated.")
    if drives_file is None and not simulated:
        raise SettingsError("drives on a bus need --drives DRIVES.toml: their limits are not for us to guess.")
    file = default_drives() if drives_file is None else load_drives(drives_file)
    return _Target(file, bus, simulated, arm)


@contextlib.contextmanager
def _link(chosen: _Target, *, moves: bool, homed: bool = False, neck: str = "paper") -> Iterator[CanLink | VirtualLink]:
    if chosen.simulated:
        yield VirtualLink(simulated_neck(chosen.file, load_neck(neck), sample_time=_SAMPLE_TIME, homed=homed))
        return
    if moves and not chosen.arm:
        raise SettingsError(f"this moves the drives on {chosen.bus}; say --arm if they may. Nothing was sent.")
    with open_bus(str(chosen.bus), bit_rate=chosen.file.bit_rate) as link:
        yield link


def _checked_names(names: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in OVERRIDES:
            raise SettingsError(f"--override takes one of {', '.join(OVERRIDES)}; got `{name}`.")
    return tuple(names)


_override_option = click.option(
    "--override", "overrides", multiple=True, metavar="NAME",
    help=f"Let a check fail, by name: {', '.join(OVERRIDES)}.",
)  # fmt: skip
_neck_option = click.option("--neck", metavar="paper|lab|NECK.toml", help="The virtual neck of --simulated.")


@click.group(
    "drives",
    epilog="Example: softneck drives check --simulated. Every command takes --json, and --help tells its options.",
)
def command() -> None:
    """CANopen drives (CiA 301/402): scan, check, zero, run, stop, reset; on a bus or simulated.

    What these commands do was shown on simulated drives only; no hardware was at hand.
    """


@command.command("scan")
@_drives_options
@json_option
def scan_command(drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, as_json: bool) -> None:
    """List the nodes on the bus; sends reads only."""
    if bus is not None and drives_file is None:
        chosen = _Target(default_drives(), bus, False, arm)
    else:
        chosen = _target(drives_file, bus, simulated, arm)
    with _link(chosen, moves=False) as link:
        found = scan(link)
    if as_json:
        print_json({"nodes": found})
        return
    rows = [[str(item["node"]), str(item["name"] or "-"), str(item["firmware"] or "-"), str(item["serial"] or "-"),
             str(item["state"] or "-")] for item in found]  # fmt: skip
    print_table(f"{len(found)} node(s)", ["node", "name", "firmware", "serial", "state"], rows)


@command.command("check", epilog="Example: softneck drives check --simulated")
@_drives_options
@_override_option
@json_option
def check_command(
    drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, overrides: tuple[str, ...], as_json: bool
) -> None:
    """Pre-flight: identity, firmware, factors, modes, options, limits, guarding; each value written is read back.

    Writes the configuration, moves nothing. Exit code 1 if a check does not hold.
    """
    chosen = _target(drives_file, bus, simulated, arm)
    with _link(chosen, moves=False, homed=True) as link:
        report = preflight(link, chosen.file, override=_checked_names(overrides))
    _show(report, as_json=as_json)
    report.require()


def _show(report: Report, *, as_json: bool) -> None:
    if as_json:
        print_json(report.table())
        return
    rows = []
    for row in report.rows:
        verdict = "ok" if row.holds else "overridden" if row.name in report.overridden else "fails"
        rows.append([f"{row.node or 'bus'} {row.name}", row.found, verdict])
    print_table(f"Pre-flight, guarding by {report.guarding}", ["check", "found", "verdict"], rows)


@command.command("zero", epilog="Example: softneck drives zero --drives drives.toml --bus socketcan:can0 --arm")
@_drives_options
@_override_option
@_neck_option
@json_option
def zero_command(
    drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, overrides: tuple[str, ...],
    neck: str | None, as_json: bool,
) -> None:  # fmt: skip
    """Tension each tendon gently, set the encoders' zero there, and verify with the inclinometer."""
    chosen = _target(drives_file, bus, simulated, arm)
    with _link(chosen, moves=True, neck=neck or "paper") as link:
        look = _look(link, chosen.file)
        report = preflight(link, chosen.file, override=_checked_names(overrides))
        report.require()
        zeroed = zero(link, chosen.file, look, guarding=report.guarding)
    if as_json:
        print_json(zeroed.table())
        return
    rows = [[f"node {node}", f"{pulled:.3f}"] for node, pulled in zip(zeroed.nodes, zeroed.pulled, strict=True)]
    print_table("Zeroed", ["motor", "pulled [rad]"], rows)


def _look(link: CanLink | VirtualLink, file: DrivesFile) -> Callable[[], Tilt | None]:
    if isinstance(link, VirtualLink):

        def sample() -> Tilt:
            taken = link.neck.newest
            return Tilt(taken.pitch, taken.roll, taken.pitch_rate, taken.roll_rate, taken.valid)

        return sample
    _require_can_sensor(file)
    sensor = CanInclinometer(file.sensor_node)
    return lambda: sensor.look(link)


def _require_can_sensor(file: DrivesFile) -> None:
    if file.sensor_kind != "can":
        raise SettingsError(
            f'[sensor] kind is "{file.sensor_kind}"; on a bus it must be "can", a CiA 410 inclinometer at `node`.'
        )


@command.command("run", epilog="Example: softneck drives run pi.npz --loop loop.toml --simulated")
@click.argument("controller", metavar="CONTROLLER", type=click.Path(path_type=Path))
@click.option("--loop", "loop_file", required=True, type=click.Path(path_type=Path), metavar="LOOP.toml",
              help="Observer, reference and duration; its plant gives the virtual neck of --simulated.")  # fmt: skip
@click.option("--certificate", "certificates", multiple=True, type=click.Path(path_type=Path),
              help="Of `softneck verify` or `softneck simulate`; several may cover the files together.")  # fmt: skip
@_drives_options
@_override_option
@_neck_option
@click.option("--pace", type=float, help="With --simulated: this multiple of real time instead of as fast as possible.")
@output_option("recording of the run", "REC")
@force_option
@json_option
def run_command(
    controller: Path, loop_file: Path, certificates: tuple[Path, ...], drives_file: Path | None, bus: str | None,
    simulated: bool, arm: bool, overrides: tuple[str, ...], neck: str | None, pace: float | None,
    output: Path | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Run CONTROLLER in the loop of LOOP.toml on the drives: enable, ramp in, control, ramp out, switch off.

    Refused unless certificates cover controller, observer and loop file and hold. Exit code 1 if anything stopped it.
    On a terminal (stderr) a live view shows the run, on a bus and with --pace; not with --json.
    """
    path, replace = target(output, f"results/drives_{loop_file.stem}.csv", force=force)
    recording_suffix(path)
    refuse_existing(path, force=replace)
    chosen, names = _target(drives_file, bus, simulated, arm), _checked_names(overrides)
    setup = load_loop(loop_file)
    if not controller.is_file():
        raise SettingsError(f"{controller}: no such file.")
    require_certified(setup, controller, certificates, names)
    deployed = prepare(setup, controller)
    for text in deployed.notes:
        note(text)
    live = not as_json and (not chosen.simulated or pace is not None)
    with (
        live_view(controller.name, deployed.loop.duration, wanted=live) as watch,
        # Two things that draw in place would draw over each other; the view tells the time as well.
        progress("drives", quiet=as_json or watch is not None) as tell,
    ):
        report = lambda done: tell(done, controller.name)  # noqa: E731
        if chosen.simulated:
            virtual = load_neck(neck) if neck else None
            result = run_simulated(
                deployed, chosen.file, neck=virtual, override=names, pace=pace, report=report, watch=watch
            )
        else:
            _require_can_sensor(chosen.file)
            with _link(chosen, moves=True) as link:
                sensor = CanInclinometer(chosen.file.sensor_node)
                if isinstance(link, VirtualLink):
                    raise SettingsError("drives on a bus are asked.")
                result = run_on_bus(deployed, chosen.file, link, sensor, override=names, report=report, watch=watch)
    if len(result.signals.time) > 1:
        write_recording(path, result.recording(), force=replace)
    _print_run(path, result, as_json=as_json)
    result.require()


def _print_run(path: Path, result: DrivesResult, *, as_json: bool) -> None:
    values: dict[str, Any] = result.table()
    if as_json:
        print_json(values)
        return
    rows = [["phase", result.phase], ["bus cycles", str(result.cycles)]]
    rows += [[name, str(count)] for name, count in result.counts.items()]
    rows.append(["real-time factor", f"{result.real_time_factor:.1f}"])
    print_table(str(path), ["what", "value"], rows)


@command.command("stop")
@_drives_options
@json_option
def stop_command(drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, as_json: bool) -> None:
    """Quick stop, then no voltage, for every drive; always allowed."""
    chosen = _target(drives_file, bus, simulated, arm)
    with _link(chosen, moves=False) as link:
        _states(stop(link, chosen.file), "stopped", as_json=as_json)


@command.command("reset")
@_drives_options
@json_option
def reset_command(drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, as_json: bool) -> None:
    """Acknowledge latched faults; nothing else ever does, and nothing moves by it."""
    chosen = _target(drives_file, bus, simulated, arm)
    with _link(chosen, moves=False) as link:
        _states(reset(link, chosen.file), "reset", as_json=as_json)


def _states(states: dict[int, str], what: str, *, as_json: bool) -> None:
    if as_json:
        print_json({what: [{"node": node, "state": state} for node, state in states.items()]})
    else:
        print_table(what, ["node", "state"], [[str(node), state] for node, state in states.items()])
