"""softneck drives commission: check drives, tendons and sensor before anything else moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from softneck import drives, plant
from softneck.core import CheckFailedError, SettingsError

from ..shared._console import note, print_json, print_table, progress
from ..shared._options import common_options
from ._target import SAMPLE_TIME, Asked, Target, drives_options, moving, open_link, require_log


def scan_step(asked: Asked, *, as_json: bool) -> None:
    """List the nodes on the bus; sends reads only. Fails if none answers, or several devices at one number."""
    nameless = asked.bus is not None and asked.drives is None
    chosen = Target(drives.default_drives(), asked.bus, False, asked.arm) if nameless else asked.target()
    with open_link(chosen, moves=False) as link:
        found = drives.scan(link, bit_rate=chosen.file.bit_rate)
    if as_json:
        print_json({"nodes": found})
    else:
        rows = [[str(item["node"]), str(item["name"] or "-"), str(item["firmware"] or "-"), _serials(item["serials"]),
                 str(item["state"] or "-")] for item in found]  # fmt: skip
        print_table(f"{len(found)} node(s)", ["node", "name", "firmware", "serial", "state"], rows)
    if not found:
        raise CheckFailedError(
            f"{asked.bus or 'the bus'}: no node answers. Are the drives on, is the bit rate right, is the line "
            "terminated (60 ohm between CAN_H and CAN_L)?"
        )
    shared = [(item["node"], drives.several_devices(item["serials"])) for item in found]
    listed = "; ".join(f"node {node}: {told}" for node, told in shared if told)
    if listed:
        raise CheckFailedError(f"{listed}. Give each device a node number of its own.")


def _serials(serials: list[int | None]) -> str:
    return ", ".join(str(serial or "-") for serial in serials) or "-"


def zero_step(asked: Asked, *, force: bool, as_json: bool) -> None:
    """Tension each tendon gently, set the encoders' zero there, and verify with the inclinometer."""
    chosen = asked.target()
    require_log(asked.log, force=force)
    with moving(asked, chosen, "zero", force=force) as (session, end):
        link, sensor = session.link, session.sensor
        report = drives.preflight(link, chosen.file, override=asked.override)
        report.require()
        if session.log is not None:
            # It has no cycles: what was set up, and the frames.
            settings = chosen.file.master_settings(SAMPLE_TIME, guarding=report.guarding)
            session.log.describe(drives.run_facts(settings, session.files, simulated=chosen.simulated))

        def look() -> drives.Reading | None:
            if isinstance(link, drives.VirtualLink):
                return link.newest
            return None if sensor is None else drives.look_at(sensor, link, drives.LOOK)

        try:
            zeroed = drives.zero(link, chosen.file, look, guarding=report.guarding, operator=end.keyboard)
        except CheckFailedError as error:
            if end.keyboard.interrupted or end.keyboard.terminated:
                note(str(error))
            end.leave_if_asked()
            raise
        if as_json:
            print_json(zeroed.table())
            return
        rows = [[f"node {node}", f"{pulled:.3f}"] for node, pulled in zip(zeroed.nodes, zeroed.pulled, strict=True)]
        print_table("Zeroed", ["motor", "pulled [rad]"], rows)


def jog_step(asked: Asked, motor: int, amplitude: float, *, force: bool, as_json: bool) -> None:
    """Pull a motor's tendon a little, let it out as much, and look where the neck goes; the drives must be zeroed.

    Fails if that is not where the tendon's angle says: nodes swapped, a sign reversed, a tendon that hangs.
    """
    require_log(asked.log, force=force)
    chosen = asked.target()
    if motor > len(chosen.file.nodes):
        raise click.BadParameter(f"{motor} is not in the range 1<=x<={len(chosen.file.nodes)}.", param_hint="'--motor'")
    # A neck's tendons stand where its own file says.
    physics = drives.physics_of(chosen.file.moves) if plant.has_own_tendons(chosen.file.moves) else None
    angles = physics and plant.tendons_of(chosen.file.moves, physics)
    with moving(asked, chosen, "jog", force=force, homed=True) as (session, end):
        with progress("jog", quiet=as_json) as tell:
            found = drives.jog(
                motor, session, tendon_angles=angles, amplitude=amplitude,
                report=lambda done: tell(done, f"motor {motor}"),
            )  # fmt: skip
        _print_jog(found, as_json=as_json)
        end.conclude(found.ended.master.supervisor.fault, found.require)


def _print_jog(found: drives.JogResult, *, as_json: bool) -> None:
    values = found.table()
    if as_json:
        print_json(values)
        return
    rows = []
    for name in values["expected"]:
        cells = [values[key][name] for key in ("expected", "seen")]
        rows.append([name, *("-" if cell is None or cell != cell else f"{cell:.2f}" for cell in cells)])
    print_table(f"Motor {found.motor} (node {found.node}): {found.verdict}", ["way up", "expected", "seen"], rows)


_STEP_NAMES = ("scan", "tendons", "zero", "jog")


@click.command(
    "commission",
    epilog="Example: softneck drives commission --drives drives.toml --bus socketcan:can0 --arm -o commissioned",
)
@click.option("--only", type=click.Choice(_STEP_NAMES), help="Do this alone.  [default: scan and tendons]")
@click.option("--motor", "motors", multiple=True, type=click.IntRange(1, 8), metavar="N",
              help="Move these only; may be given several times.  [default: all]")  # fmt: skip
@click.option("--travel", type=float, metavar="RAD",
              help="How far a winch may turn to either side in search of its tendon, or turns in `jog`.  [default: 10; "
              "0.5 of jog]")  # fmt: skip
@drives_options("override", "pace", "log")
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR",
              help="Folder of the proposed files.  [default: under build/]")  # fmt: skip
@common_options("force")
def commission_command(
    asked: Asked, only: str | None, motors: tuple[int, ...], travel: float | None, output: Path | None, force: bool,
    as_json: bool,
) -> None:  # fmt: skip
    """Check drives, tendons and sensor before anything else moves.

    \b
    scan     lists the nodes on the bus; sends reads only
    tendons  leads one motor after the other out of its slack until the neck tilts by a degree: signs, gears, encoder
             lines, current scales, which tendon it pulls, slack, friction; the sensor's axes, signs, noise and delay.
             Tighten the tendons by hand before. Writes what drives and robot file should say
    zero     tensions each tendon gently, sets the encoders' zero there, and verifies with the inclinometer
    jog      pulls the tendon of --motor N a little, lets it out as much, and looks where the neck goes

    Zero and jog need the drives file that is right. Exit code 1 if anything is not as the files say; Ctrl-C leads the
    motor back, switches off, and exits with 130.
    """
    if only in ("scan", "zero") and (motors or travel is not None):
        raise SettingsError(f"--only {only} takes no --motor and no --travel.")
    if only == "scan":
        scan_step(asked, as_json=as_json)
    elif only == "zero":
        zero_step(asked, force=force, as_json=as_json)
    elif only == "jog":
        if len(motors) != 1:
            raise SettingsError("--only jog moves one motor: say --motor N.")
        jog_step(asked, motors[0], 0.5 if travel is None else travel, force=force, as_json=as_json)
    else:
        _tendons(asked, motors, 10.0 if travel is None else travel, output, force=force, as_json=as_json)


def _tendons(
    asked: Asked, motors: tuple[int, ...], travel: float, output: Path | None, *, force: bool, as_json: bool
) -> None:
    """Scan the nodes, move the motors, and propose files."""
    folder, replace = (Path("build") / "commission", True) if output is None else (output, force)
    require_log(asked.log, force=force)
    chosen = asked.target()
    guards = drives.Guards.of(chosen.file.watch.gain, travel=travel)
    drives.require_folder(folder, force=replace)
    with moving(asked, chosen, "commission", force=force) as (session, end):
        with progress("commission", quiet=as_json) as tell:
            result = drives.commission(session, guards=guards, motors=motors, report=tell, where=asked.bus or "the bus")
        written = end.attempt(lambda: drives.write_files(folder, result, force=replace)) or {}
        _print(result, written, as_json=as_json)
        end.conclude(None if result.ended is None else result.ended.master.supervisor.fault, result.require)


def _print(result: drives.Commissioned, written: dict[str, str], *, as_json: bool) -> None:
    values: dict[str, Any] = {**result.table(), "files": written}
    if as_json:
        print_json(values)
        return
    rows = []
    for m in values["motors"]:
        seen = "tendon" in m
        rows.append([
            f"{m['motor']} (node {m['node']})", f"tendon {m['tendon']}" if seen else m["outcome"],
            *(_cells(m) if seen else ["-"] * 6),
        ])  # fmt: skip
    head = ["motor", "pulls", "reversed", "gear", "counts", "peak [A]", "slack [rad]", "friction [mA]"]
    if rows:
        print_table("Motors, as they were found", head, rows)
    for finding in result.findings:
        note(f"{finding}. {finding.advice}")
        for other in finding.instead:
            note(f"  or {other}: no move can tell")
    for what, path in written.items():
        click.echo(f"{what}: {path}")


def _cells(m: dict[str, Any]) -> list[str]:
    return [
        str(m["reversed"]).lower(), f"{m['gear']:.5g}", f"{m['encoder_counts']:.0f}", f"{m['peak_current_A']:g}",
        f"{m['slack_rad']:.2f}", f"{1e3 * m['friction_A']:.2f}",
    ]  # fmt: skip
