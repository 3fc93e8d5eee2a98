"""softneck drives commission: before anything else moves, what drives, tendons and sensor really are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import SettingsError, require_between

from ..shared._console import note, print_json, print_table, progress
from ..shared._neck import load_neck
from ..shared._options import force_option, json_option
from ._log import drives_of, log_options, opened_log, require_log
from ._target import (
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
    from softneck.drives.commissioning._commission import Commissioned


@click.command(
    "commission",
    epilog="Example: softneck drives commission --drives drives.toml --bus socketcan:can0 --arm -o commissioned",
)
@drives_options
@click.option("--motor", "motors", multiple=True, type=click.IntRange(1, 8), metavar="N",
              help="Move these only; may be given several times.  [default: all]")  # fmt: skip
@click.option("--travel", type=float, default=10.0, show_default=True, metavar="RAD",
              help="How far a winch may turn to either side in search of its tendon.")  # fmt: skip
@click.option("--pace", type=float, help="With --simulated: run at this multiple of real time.")
@override_option
@neck_option
@log_options
@click.option("-o", "--output", type=click.Path(path_type=Path), metavar="DIR",
              help="Folder of the proposed files.  [default: under build/]")  # fmt: skip
@force_option
@json_option
def commission_command(
    drives_file: Path | None, bus: str | None, simulated: bool, robot: str | None, arm: bool, motors: tuple[int, ...],
    travel: float, pace: float | None, overrides: tuple[str, ...], neck: str | None, log_file: Path | None,
    no_log: bool, output: Path | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Find out what drives, tendons and sensor really are, before anything else moves.

    Asks who is on the bus, then leads one motor after the other out of its slack until the neck tilts by a degree:
    signs, gears, encoder lines, current scales, which tendon it pulls, slack, friction; the sensor's axes, signs, noise
    and delay. Tighten the tendons by hand before. Writes what the drives and robot file should say, and a page.

    Exit code 1 if anything is not as the files say; Ctrl-C leads the motor back, switches off, and exits with 130.
    """
    from softneck.drives.commissioning._commission import commission
    from softneck.drives.commissioning._moves import Guards
    from softneck.drives.commissioning._proposal import require_folder, write_files
    from softneck.drives.running._bus_loop import Session
    from softneck.drives.running._keyboard import Keyboard

    folder, replace = (Path("build") / "commission", True) if output is None else (output, force)
    _require(simulated, pace)
    require_log(log_file, no_log=no_log, force=force)
    virtual = load_neck(neck) if neck else None
    chosen = target_of(drives_file, bus, simulated, arm, neck=virtual, robot=robot)
    guards = Guards.of(chosen.file.watch.gain, travel=travel)
    require_folder(folder, force=replace)
    with (
        open_link(chosen, moves=True) as link,
        opened_log(chosen, "commission", log_file, no_log=no_log, force=force) as log,
    ):
        link.tap = None if log is None else log.frame
        sensor = None if chosen.simulated else sensor_of(chosen.file, str(chosen.bus))
        with progress("commission", quiet=as_json) as tell, Keyboard() as keyboard:
            session = Session(
                file=chosen.file, link=link, sensor=sensor, override=checked_names(overrides), pace=pace,
                operator=keyboard, log=log, files=drives_of(chosen.path),
            )  # fmt: skip
            result = commission(
                session, guards=guards, neck=virtual, motors=motors, report=tell, where=bus or "the bus"
            )
        written = write_files(folder, result, force=replace)
        _print(result, written, as_json=as_json)
        leave_if_asked(keyboard, terminated=result.ended is not None and result.ended.terminated)
        result.require()


def _require(simulated: bool, pace: float | None) -> None:
    if pace is not None:
        require_between("--pace", pace, 0.01, 1000.0)
        if not simulated:
            raise SettingsError("--pace is for --simulated; a bus runs in real time.")


def _print(result: Commissioned, written: dict[str, str], *, as_json: bool) -> None:
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
        note(str(finding))
        for other in finding.instead:
            note(f"  or {other}: no move can tell")
    for what, path in written.items():
        click.echo(f"{what}: {path}")


def _cells(m: dict[str, Any]) -> list[str]:
    return [
        str(m["reversed"]).lower(), f"{m['gear']:.5g}", f"{m['encoder_counts']:.0f}", f"{m['peak_current_A']:g}",
        f"{m['slack_rad']:.2f}", f"{1e3 * m['friction_A']:.2f}",
    ]  # fmt: skip
