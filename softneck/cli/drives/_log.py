"""The log of a command that moves drives: the one asked for, and on drives that may be real one in any case."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click
import platformdirs

from softneck.core import OutputFileError, SettingsError

from ..shared._console import note
from ._target import Target

if TYPE_CHECKING:
    from softneck.cosim.loops._loop_file import LoopSetup
    from softneck.drives.logs._run_log import RunLogger


def log_options(function: Callable) -> Callable:
    """Add the options that say what is logged."""
    options = (
        click.option(
            "--log", "log_file", type=click.Path(path_type=Path), metavar="FILE.mcap",
            help="Log of all that happened (`softneck drives replay`, `import`, Foxglove). [default: on a bus that may "
            "move something a file under ~/.local/state/softneck/log, or in $LOGS_DIRECTORY]",
        ),
        click.option("--no-log", is_flag=True, help="Write no log, not even on such a bus."),
    )  # fmt: skip
    for option in reversed(options):
        function = option(function)
    return function


def require_log(log_file: Path | None, *, no_log: bool, force: bool) -> None:
    """Raise where the options cannot be followed, before anybody is asked to arm anything."""
    from softneck.drives.logs._run_log import require_log_path

    if log_file is None:
        return
    if no_log:
        raise SettingsError("--log and --no-log contradict each other; give one of them.")
    require_log_path(log_file, force=force)


@contextlib.contextmanager
def opened_log(
    chosen: Target, command: str, log_file: Path | None, *, no_log: bool, force: bool
) -> Iterator[RunLogger | None]:
    """Yield a logger, None where nothing is logged; what it wrote has its names at the end.

    Args:
        chosen: the drives; where they may be real and no log is asked for, one is written to `log_folder`.
        command: what runs, for its name.
        log_file: the one asked for.
        no_log: write none that was not asked for.
        force: replace an existing file.

    Raises:
        OutputFileError: it cannot be written (before anything moves), or is not complete.
    """
    from softneck.drives.bus._link import HARMLESS
    from softneck.drives.logs._run_log import RunLogger

    own = log_file is None and not no_log and not chosen.simulated and str(chosen.bus).partition(":")[0] not in HARMLESS
    path = _new_path(command) if own else log_file
    if path is None:
        yield None
        return
    # In virtual time the clock begins at 0, and the same run gives the same log.
    epoch = 0.0 if chosen.simulated else time.time() - time.monotonic()
    try:
        log = RunLogger(path, force=force, wait=chosen.simulated, epoch=epoch)
    except OutputFileError as error:
        raise OutputFileError(f"{error} Or --no-log. Nothing was sent." if own else str(error)) from error
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
