"""Shared by the subcommands of `softneck drives`: drives, bus, inclinometer and log.

Drives on a bus move only with --arm and a phrase typed by a person who watches the robot.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck import plant
from softneck.core import OutputFileError, SettingsError, SoftneckError, require_between
from softneck.drives import HARMLESS, OVERRIDES

from ..shared._console import note
from ..shared._options import COMMON
from ._closing import Closing, closing, new_path

if TYPE_CHECKING:
    from softneck.drives import CanLink, DrivesFile, RunLogger, Sensor, Session, VirtualLink
    from softneck.drives.master import Frame, Tilt
    from softneck.robot import Robot

# For a service, where nobody can type: the same words.
VARIABLE = "SOFTNECK_ARM"


def words(bus: str) -> str:
    """Return the phrase to type for `bus`."""
    return f"MOVE {bus.partition(':')[2]}"


def require_armed(bus: str, *, arm: bool) -> None:
    """Return if the drives on `bus` may move.

    A bus whose far end is a program needs --arm only. Any other needs the words typed at a terminal as well, or
    in SOFTNECK_ARM where there is none.
    Raises SettingsError: no --arm, nobody to ask, or other words; nothing was sent.
    """
    if not arm:
        raise SettingsError(f"this moves the drives on {bus}; say --arm if they may. Nothing was sent.")
    if bus.partition(":")[0] in HARMLESS:
        return
    wanted, given = words(bus), os.environ.get(VARIABLE)
    if given is not None:
        if given != wanted:
            raise SettingsError(f"{VARIABLE} is `{given}`; for {bus} it must be `{wanted}`. Nothing was sent.")
        note(f"armed by {VARIABLE}; nobody was asked.")
        return
    if not sys.stdin or not sys.stdin.isatty():
        raise SettingsError(
            f"--arm asks for `{wanted}` at a terminal, but stdin is not one; "
            f"a service sets {VARIABLE}. Nothing was sent."
        )
    click.echo(f"The drives on {bus} will move. Is the neck free, and a hand at the Enable switch?", err=True)
    typed = click.prompt(f"Type `{wanted}` to go on", default="", show_default=False, err=True)
    if typed.strip() != wanted:
        raise SettingsError(f"`{typed.strip()}` was typed, not `{wanted}`. Nothing was sent.")


SAMPLE_TIME = 0.02


@dataclass(frozen=True, slots=True)
class Target:
    """The drives of a command; `neck` is the virtual plant, `path` that of the drives file."""

    file: DrivesFile
    bus: str | None
    simulated: bool
    arm: bool
    neck: plant.NeckParameters | None = None
    path: Path | None = None


_OPTIONS = {
    "drives": click.option("--drives", type=click.Path(path_type=Path), metavar="DRIVES.toml",
                           help="Node ids, gear, encoder, signs, limits, sensor, guarding.  [default: the robot's]"),
    "bus": click.option("--bus", metavar="INTERFACE:CHANNEL", help="CAN bus, such as socketcan:can0 or virtual:x."),
    "simulated": click.option("--simulated", is_flag=True,
                              help="Simulated drives on the robot's virtual plant, in this process."),
    "robot": COMMON["robot"],
    "arm": click.option("--arm", is_flag=True, help="Allow drives on a bus to move."),
    "override": click.option("--override", multiple=True, type=click.Choice(OVERRIDES), metavar="NAME",
                             help=f"Ignore a check that fails, by name: {', '.join(OVERRIDES)}."),
    "pace": click.option("--pace", type=float, help="With --simulated: run at this multiple of real time."),
    "log": click.option("--log", metavar="FILE.mcap|none",
                        help="Log of all that happened (`softneck simulate` replays it, `import` reads it; Foxglove). "
                        "[default: on a bus that may move something a file under ~/.local/state/softneck/log, or in "
                        "$LOGS_DIRECTORY]"),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """The options of a command that choose the drives; each command has those that it needs."""

    drives: Path | None
    bus: str | None
    simulated: bool
    robot: str | None
    arm: bool
    override: tuple[str, ...] = ()
    pace: float | None = None
    log: str | None = None

    def __post_init__(self) -> None:
        if self.pace is not None:
            require_between("--pace", self.pace, 0.01, 1000.0)
            if not self.simulated:
                raise SettingsError("--pace is for --simulated; a bus runs in real time.")

    def target(self) -> Target:
        """Return which drives are meant; without a drives file the robot may be that of the working folder."""
        from softneck.robot import ROBOT_FILE, find_robot, robot_file_of

        robot: Any = self.robot
        if robot is None and self.drives is None and robot_file_of(ROBOT_FILE) is not None:
            robot = find_robot(beside=ROBOT_FILE)
        return target_of(self.drives, self.bus, self.simulated, self.arm, robot=robot)


def drives_options(*more: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds the options of the drives and `more`; the command gets one `Asked`."""
    names = ("drives", "bus", "simulated", "robot", "arm", *more)

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(**values: Any) -> None:
            function(Asked(**{name: values.pop(name) for name in names}), **values)

        for name in reversed(names):
            wrapper = _OPTIONS[name](wrapper)
        return wrapper

    return decorate


def target_of(
    drives_file: Path | None, bus: str | None, simulated: bool, arm: bool, *, neck: plant.NeckParameters | None = None,
    robot: str | Path | Robot | None = None,
) -> Target:  # fmt: skip
    """Return which drives the options mean; simulated ones without a file are set up for the virtual `neck`.

    A robot that is given may name its drives file.
    """
    from softneck.drives import default_drives, load_drives, neck_drives, physics_of, robot_of, stand_in

    moved = None if robot is None else robot_of(robot, None)
    if drives_file is None and moved is not None and moved.drives is not None:
        drives_file = (moved.folder or Path()) / moved.drives
    if (bus is None) == (not simulated):
        raise SettingsError("say which drives: --bus INTERFACE:CHANNEL or --simulated.")
    if drives_file is None and not simulated:
        raise SettingsError("drives on a bus need --drives DRIVES.toml: softneck does not guess their limits.")
    if drives_file is not None:
        file = load_drives(drives_file, moved)
    else:
        physics = neck if moved is None else physics_of(moved, neck)
        file = default_drives(robot=moved) if physics is None else neck_drives(physics, moved)
    if simulated and (told := stand_in(file, neck)):
        note(told)
    return Target(file, bus, simulated, arm, neck, drives_file)


@contextlib.contextmanager
def open_link(chosen: Target, *, moves: bool, homed: bool = False, seed: int = 0) -> Iterator[CanLink | VirtualLink]:
    """Yield the bus, or simulated drives on a virtual neck; commands that move a bus must be armed."""
    from softneck.drives import VirtualLink, open_bus, simulated_plant

    if chosen.simulated:
        yield VirtualLink(simulated_plant(chosen.file, chosen.neck, sample_time=SAMPLE_TIME, homed=homed, seed=seed))
        return
    if moves:
        require_armed(str(chosen.bus), arm=chosen.arm)
    with open_bus(str(chosen.bus), bit_rate=chosen.file.bit_rate) as link:
        try:
            yield link
        finally:
            if link.problem:
                note(f"bus {chosen.bus}: {link.problem}")


@contextlib.contextmanager
def moving(
    asked: Asked, chosen: Target, command: str, *, force: bool, homed: bool = False, seed: int = 0, **files: Path | str
) -> Iterator[tuple[Session, Closing]]:
    """Yield the session of a master, and how its command ends; signals are taken until link and log are closed.

    `asked`, `chosen`: which drives. `command`: what runs, for its log. `force`: replace an existing log. `homed`,
    `seed`: of simulated drives. `files`: what acts beside the drives file, for the log.
    """
    from softneck.drives import Session, VirtualLink

    with (
        contextlib.ExitStack() as last,
        open_link(chosen, moves=True, homed=homed, seed=seed) as link,
        opened_log(chosen, command, asked.log, force=force) as log,
        closing(last, command, log) as end,
    ):
        link.tap = None if log is None else log.frame
        yield Session(
            file=chosen.file, link=link, sensor=None if isinstance(link, VirtualLink) else sensor_of(chosen.file),
            override=asked.override, pace=asked.pace, operator=end.keyboard, log=log,
            files={**drives_of(chosen.path), **files},
        ), end  # fmt: skip


def sensor_of(file: DrivesFile) -> Any:
    """Return the inclinometer that the drives file names, open until the command ends.

    Raises SoftneckError: see `open_sensor`; nothing was sent to the drives yet.
    """
    return click.get_current_context().with_resource(_open_sensor(file))


@contextlib.contextmanager
def _open_sensor(file: DrivesFile) -> Iterator[Any]:
    """Yield the inclinometer; print its problems at the end."""
    from softneck.drives import open_sensor

    with open_sensor(
        file.sensor_kind, file.sensor_node, file.sensor_source, file.moves, axes=file.sensor_axes
    ) as sensor:
        try:
            yield sensor
        finally:
            problem = getattr(sensor, "problem", "")
            if problem:
                note(f"inclinometer {sensor.name}: {problem}")


class _NoSensor:
    """A silent inclinometer that carries the reason why the real one cannot be opened."""

    def __init__(self, problem: str) -> None:
        self.problem = problem

    def take(self, frames: Sequence[Frame]) -> None:
        del frames

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        del now, frames
        return None


def sensor_or_reason(file: DrivesFile) -> Sensor:
    """Return the inclinometer, or a silent one with the reason why it cannot be opened."""
    try:
        return sensor_of(file)
    except SoftneckError as error:
        return _NoSensor(str(error))


# Value of `--log` for no log.
_NO_LOG = "none"


def require_log(log: str | None, *, force: bool) -> None:
    """Raise if a log cannot be written, before the user is asked to arm the drives."""
    from softneck.drives import require_log_path

    if log not in (None, _NO_LOG):
        require_log_path(Path(log), force=force)


@contextlib.contextmanager
def opened_log(chosen: Target, command: str, wanted: str | None, *, force: bool) -> Iterator[RunLogger | None]:
    """Yield a logger, or None without a log; the files get their names at the end.

    `chosen`: the drives; where they may be real and no log is asked for, one is written to `log_folder`. `command`:
    what runs, for its name. `wanted`: the one asked for; "none": write none that was not asked for. `force`: replace an
    existing file. Raises OutputFileError: it cannot be written (before anything moves), or is not complete.
    """
    from softneck.drives import RunLogger

    own = wanted is None and not chosen.simulated and str(chosen.bus).partition(":")[0] not in HARMLESS
    path = new_path(command, ".mcap") if own else None if wanted in (None, _NO_LOG) else Path(wanted)
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
        # The error itself comes last; an incomplete log is noted before it.
        try:
            log.close()
        except OutputFileError as error:
            note(str(error))
        _drop_empty(log, own=own)
        raise
    log.close()
    _drop_empty(log, own=own)


def _drop_empty(log: RunLogger, *, own: bool) -> None:
    """Remove an automatic log of a run that did not begin."""
    if own and not log.described and log.path.is_file():
        log.path.unlink()
        note(f"log: {log.path} is removed: nothing moved")


def drives_of(drives_file: Path | None) -> Mapping[str, str | Path]:
    """Return role -> path of the drives file where there is one, for a log."""
    return {} if drives_file is None else {"drives": drives_file}
