"""softneck drives commission: before anything else moves, what drives, tendons and sensor really are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import SettingsError

from ..shared._console import note, print_json, print_table, progress
from ..shared._options import common_options
from ._log import drives_of, opened_log, require_log
from ._steps import jog_step, scan_step, session_of, zero_step
from ._target import Asked, drives_options, leave_if_asked, open_link

if TYPE_CHECKING:
    from softneck.drives.commissioning._commission import Commissioned


_PARTS = ("scan", "tendons", "zero", "jog")


@click.command(
    "commission",
    epilog="Example: softneck drives commission --drives drives.toml --bus socketcan:can0 --arm -o commissioned",
)
@click.option("--only", type=click.Choice(_PARTS), help="Do this alone.  [default: scan and tendons]")
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
    """Find out what drives, tendons and sensor really are, before anything else moves.

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
    """Ask who is there, move what is to be moved, and propose files."""
    from softneck.drives.commissioning._commission import commission, require_folder, write_files
    from softneck.drives.commissioning._moves import Guards
    from softneck.drives.running._keyboard import Keyboard

    folder, replace = (Path("build") / "commission", True) if output is None else (output, force)
    require_log(asked.log, force=force)
    chosen = asked.target()
    guards = Guards.of(chosen.file.watch.gain, travel=travel)
    require_folder(folder, force=replace)
    with (
        open_link(chosen, moves=True) as link,
        opened_log(chosen, "commission", asked.log, force=force) as log,
    ):
        link.tap = None if log is None else log.frame
        with progress("commission", quiet=as_json) as tell, Keyboard() as keyboard:
            session = session_of(asked, chosen, link, keyboard, log, drives_of(chosen.path))
            result = commission(session, guards=guards, motors=motors, report=tell, where=asked.bus or "the bus")
        written = write_files(folder, result, force=replace)
        _print(result, written, as_json=as_json)
        leave_if_asked(keyboard, terminated=result.ended is not None and result.ended.terminated)
        result.require()


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
