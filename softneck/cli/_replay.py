"""softneck simulate LOG.mcap: a recorded run through the same core gives the same decisions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import FileFormatError, SoftneckError

from .shared._console import note, print_json, print_table

if TYPE_CHECKING:
    from softneck.drives.logs._log_file import LoggedRun
    from softneck.drives.master._master import Pilot


def replay_log(log: Path, *, as_json: bool) -> None:
    """Feed what a run saw to the same core and controller again, and compare every frame out, bit for bit.

    A log that is cut is replayed up to the cut, which is said. Nothing is sent to any bus.

    Raises:
        CheckFailedError: a frame differs, with the first one.
    """
    from softneck.drives import read_run_log, replay
    from softneck.drives.logs._log_file import changed_files

    run = read_run_log(log)
    notes = changed_files(run)
    pilot = _pilot(run)
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


def _pilot(run: LoggedRun) -> Pilot | None:
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
    loop, controller = files.get("loop"), files.get("controller")
    if loop is None or controller is None or not (loop.is_file() and controller.is_file()):
        return None
    return LoopPilot(prepare(load_loop(loop), controller, run.robot).loop, run.robot)
