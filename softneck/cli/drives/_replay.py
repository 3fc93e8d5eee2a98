"""softneck drives replay: a recorded run through the same core gives the same decisions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import FileFormatError, SettingsError, SoftneckError

from ..shared._console import note, print_json, print_table
from ..shared._options import json_option

if TYPE_CHECKING:
    from softneck.drives.logs._log_file import LoggedRun
    from softneck.drives.master._measured import Pilot


@click.command("replay", epilog="Example: softneck drives replay run.mcap")
@click.argument("log", metavar="LOG", type=click.Path(path_type=Path))
@click.option("--loop", "loop_file", type=click.Path(path_type=Path), metavar="LOOP.toml",
              help="The run's loop file, if it is no longer where the log says.")  # fmt: skip
@click.option(
    "--controller",
    type=click.Path(path_type=Path),
    help="The run's controller, if it is no longer where the log says.",
)
@click.option("--core-only", is_flag=True, help="Use the logged answers of the controller instead of computing them.")
@json_option
def replay_command(log: Path, loop_file: Path | None, controller: Path | None, core_only: bool, as_json: bool) -> None:
    """Feed what a run saw to the same core and controller again, and compare every frame out, bit for bit.

    LOG is the .mcap of `run`, `jog` or `record` with --log; one that is cut is replayed up to the cut, and says so.
    Exit code 0 if all is equal, 1 with the first difference if not. Nothing is sent to any bus.
    """
    from softneck.drives import read_run_log, replay
    from softneck.drives.logs._log_file import changed_files

    run = read_run_log(log)
    notes = changed_files(run)
    pilot = None if core_only else _pilot(run, loop_file, controller)
    if pilot is None:
        notes.append("the controller was not computed again: its logged answers were used")
    result = replay(run, pilot, notes)
    for text in result.notes:
        note(text)
    if as_json:
        print_json({"log": str(log), **result.table()})
    else:
        rows = [["cycles", str(result.cycles)], ["frames out", str(result.frames)],
                ["controller's answers", str(result.answers)], ["phase", result.phase],
                ["fault", result.fault or "none"],
                ["equal", "yes" if result.difference is None else "no"]]  # fmt: skip
        print_table(str(log), ["what", "value"], rows)
    result.require()


def _pilot(run: LoggedRun, loop_file: Path | None, controller: Path | None) -> Pilot | None:
    """Return what led the run: controller and observer, a jog or an experiment.

    None where the log names none, or the files of the loop are gone.
    """
    from softneck.cosim import load_loop
    from softneck.drives import Experiment, prepare
    from softneck.drives.commissioning._jog import jog_pilot
    from softneck.drives.running._pilot import LoopPilot

    try:
        if "jog" in run.facts:
            return jog_pilot(**run.facts["jog"])
        if "record" in run.facts:
            channels = run.settings().channels
            robot, ranges = (None, ()) if channels is None else (run.robot, channels.ranges)
            return Experiment.of(run.facts["record"], robot, ranges).pilot()
    except (SoftneckError, TypeError) as error:
        raise FileFormatError(f"{run.path}: what it played does not fit this softneck ({error}).") from error
    files = {role: Path(str(entry.get("path"))) for role, entry in run.facts.get("files", {}).items()}
    loop = loop_file or files.get("loop")
    chosen = controller or files.get("controller")
    if loop is None or chosen is None:
        return None
    for path, given in ((loop, loop_file), (chosen, controller)):
        if not path.is_file():
            if given is not None:
                raise SettingsError(f"{path}: no such file.")
            return None
    return LoopPilot(prepare(load_loop(loop), chosen, run.robot).loop, run.robot)
