"""The option --log of commands that move drives."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import click

from softneck.cosim import LoopSetup
from softneck.drives import RunLogger

log_option = click.option(
    "--log", "logs", multiple=True, type=click.Path(path_type=Path), metavar="FILE",
    help="Log of the run: .mcap holds all (`softneck drives replay`, `import`, Foxglove), .blf and .log (candump) the "
    "frames. May be given several times.",
)  # fmt: skip


@contextlib.contextmanager
def opened_log(paths: Sequence[Path], simulated: bool, *, force: bool) -> Iterator[RunLogger | None]:
    """Yield a logger to `paths`, None where there are none; what it wrote has its names at the end."""
    if not paths:
        yield None
        return
    # In virtual time the clock begins at 0, and the same run gives the same log.
    epoch = 0.0 if simulated else time.time() - time.monotonic()
    with RunLogger(paths, force=force, wait=simulated, epoch=epoch) as log:
        yield log


def acting_files(
    setup: LoopSetup, loop_file: Path, controller: Path, drives_file: Path | None
) -> Mapping[str, str | Path]:
    """Return role -> path of all files that act in a run, for its log."""
    files: dict[str, str | Path] = {role: path for role, (path, _) in setup.files.items()}
    files |= {"loop": loop_file, "controller": controller}
    return files if drives_file is None else {**files, "drives": drives_file}
