"""The log of a command that moves drives: the one asked for, and on drives that may be real one in any case."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from softneck.core import OutputFileError

from ..shared._console import note
from ._target import Target

if TYPE_CHECKING:
    from softneck.cosim.loops._loop_file import LoopSetup
    from softneck.drives.logs._run_log import RunLogger


# What `--log` takes for no log at all.
_NONE = "none"


def require_log(log: str | None, *, force: bool) -> None:
    """Raise where a log cannot be written, before anybody is asked to arm anything."""
    from softneck.drives.logs._run_log import require_log_path

    if log not in (None, _NONE):
        require_log_path(Path(log), force=force)


@contextlib.contextmanager
def opened_log(chosen: Target, command: str, wanted: str | None, *, force: bool) -> Iterator[RunLogger | None]:
    """Yield a logger, None where nothing is logged; what it wrote has its names at the end.

    Args:
        chosen: the drives; where they may be real and no log is asked for, one is written to `log_folder`.
        command: what runs, for its name.
        wanted: the one asked for; "none": write none that was not asked for.
        force: replace an existing file.

    Raises:
        OutputFileError: it cannot be written (before anything moves), or is not complete.
    """
    from softneck.drives.bus._link import HARMLESS
    from softneck.drives.logs._run_log import RunLogger

    own = wanted is None and not chosen.simulated and str(chosen.bus).partition(":")[0] not in HARMLESS
    path = _new_path(command) if own else None if wanted in (None, _NONE) else Path(wanted)
    if path is None:
        yield None
        return
    # In virtual time the clock begins at 0, and the same run gives the same log.
    epoch = 0.0 if chosen.simulated else time.time() - time.monotonic()
    try:
        log = RunLogger(path, force=force, wait=chosen.simulated, epoch=epoch)
    except OutputFileError as error:
        raise OutputFileError(f"{error} Or --log none. Nothing was sent." if own else str(error)) from error
    if own:
        note(f"log: {path}")
    try:
        yield log
    except BaseException:
        # What went wrong is what is to be told; that its log is not complete comes before it.
        try:
            log.close()
        except OutputFileError as error:
            note(str(error))
        _drop_empty(log, own=own)
        raise
    log.close()
    _drop_empty(log, own=own)


def _drop_empty(log: RunLogger, *, own: bool) -> None:
    """Remove a log that nobody asked for of a run that did not begin."""
    if own and not log.described and log.path.is_file():
        log.path.unlink()
        note(f"log: {log.path} is removed: nothing moved")


def log_folder() -> Path:
    """Return where logs go that nobody named: what systemd gives by LogsDirectory=, else the user's own."""
    given = os.environ.get("LOGS_DIRECTORY", "").partition(":")[0]
    return Path(given) if given else platformdirs.user_log_path("softneck", appauthor=False)


def _new_path(command: str) -> Path:
    """Return a path that is free; names sort by time."""
    from softneck.drives.logs._run_log import partial

    stem = f"{command}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    folder, number = log_folder(), 1
    path = folder / f"{stem}.mcap"
    while path.exists() or partial(path).exists():
        number += 1
        path = folder / f"{stem}_{number}.mcap"
    return path


def acting_files(
    setup: LoopSetup, loop_file: Path, controller: Path, drives_file: Path | None
) -> Mapping[str, str | Path]:
    """Return role -> path of all files that act in a run, for its log."""
    files: dict[str, str | Path] = {role: path for role, (path, _) in setup.files.items()}
    return {**files, "loop": loop_file, "controller": controller, **drives_of(drives_file)}


def drives_of(drives_file: Path | None) -> Mapping[str, str | Path]:
    """Return role -> path of the drives file where there is one, for a log."""
    return {} if drives_file is None else {"drives": drives_file}
