"""What the plausibility supervisor compares with, out of the logs of undisturbed motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from softneck.core import SettingsError

from ..supervision._baseline import Baseline
from ..supervision._calibrate import calibrate, require_loops
from ._log_file import read_run_log
from ._replay import logged_motion


def baseline(logs: Sequence[str | Path]) -> Baseline:
    """Return what plausibility is judged by; `save` it and name it in the drives file: [supervision] baseline.

    Args:
        logs: `.mcap` of `softneck drives record`, such as one without and one with a payload, together at least 40 s;
            those of `run` let a loop's tracking be compared as well.

    Raises:
        SettingsError: no log.
        DataError: of different drives, disturbed, too short, or motors that did not move.
        CheckFailedError: a log that does not replay.
    """
    if not logs:
        raise SettingsError("no log was given.")
    runs = [read_run_log(Path(path)) for path in logs]
    like = runs[0].settings()
    motions = [logged_motion(run, like) for run in runs]
    if loops := [len(motion.due) * like.bus.cycle for motion in motions if motion.references is not None]:
        require_loops(sum(loops))
    return calibrate(motions, cycle=like.bus.cycle, sample_cycles=like.sample_cycles, slack=like.limits.slack)
