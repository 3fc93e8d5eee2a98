"""What the subcommands of `softneck drives` share: which drives, over which bus, with which inclinometer."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from softneck.core import SettingsError
from softneck.drives import (
    HARMLESS,
    OVERRIDES,
    CanLink,
    DrivesFile,
    VirtualLink,
    default_drives,
    load_drives,
    open_bus,
    open_sensor,
    simulated_neck,
)
from softneck.drives.master import Tilt

from ._arm import require_armed
from ._neck import load_neck

SAMPLE_TIME = 0.02
# How long a command waits for a sample of the inclinometer [s].
_LOOK = 0.5


@dataclass(frozen=True, slots=True)
class Target:
    """Which drives a command talks to."""

    file: DrivesFile
    bus: str | None
    simulated: bool
    arm: bool


def drives_options(function: Callable) -> Callable:
    """Add the options that say which drives."""
    options = (
        click.option("--drives", "drives_file", type=click.Path(path_type=Path), metavar="DRIVES.toml",
                     help="Node ids, gear, encoder, signs, limits, sensor, guarding."),
        click.option("--bus", metavar="INTERFACE:CHANNEL", help="Such as socketcan:can0, virtual:x."),
        click.option("--simulated", is_flag=True, help="Simulated drives on the virtual neck, in this process."),
        click.option("--arm", is_flag=True, help="Let drives on a bus move."),
    )  # fmt: skip
    for option in reversed(options):
        function = option(function)
    return function


def target_of(drives_file: Path | None, bus: str | None, simulated: bool, arm: bool) -> Target:
    """Return which drives the options mean."""
    if (bus is None) == (not simulated):
        raise SettingsError("say which drives: --bus INTERFACE:CHANNEL, or --simulated.")
    if drives_file is None and not simulated:
        raise SettingsError("drives on a bus need --drives DRIVES.toml: their limits are not for us to guess.")
    file = default_drives() if drives_file is None else load_drives(drives_file)
    return Target(file, bus, simulated, arm)


@contextlib.contextmanager
def open_link(
    chosen: Target, *, moves: bool, homed: bool = False, neck: str = "paper", seed: int = 0
) -> Iterator[CanLink | VirtualLink]:
    """Yield the bus, or simulated drives on a virtual neck; what moves a bus must be armed."""
    if chosen.simulated:
        yield VirtualLink(simulated_neck(chosen.file, load_neck(neck), sample_time=SAMPLE_TIME, homed=homed, seed=seed))
        return
    if moves:
        require_armed(str(chosen.bus), arm=chosen.arm)
    with open_bus(str(chosen.bus), bit_rate=chosen.file.bit_rate) as link:
        yield link


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return `names` if each may be overridden."""
    for name in names:
        if name not in OVERRIDES:
            raise SettingsError(f"--override takes one of {', '.join(OVERRIDES)}; got `{name}`.")
    return tuple(names)


override_option = click.option(
    "--override", "overrides", multiple=True, metavar="NAME",
    help=f"Let a check fail, by name: {', '.join(OVERRIDES)}.",
)  # fmt: skip
neck_option = click.option("--neck", metavar="paper|lab|NECK.toml", help="The virtual neck of --simulated.")


def look_of(link: CanLink | VirtualLink, file: DrivesFile) -> Callable[[], Tilt | None]:
    """Return what gives the newest sample of the inclinometer."""
    if isinstance(link, VirtualLink):

        def sample() -> Tilt:
            taken = link.neck.newest
            return Tilt(taken.pitch, taken.roll, taken.pitch_rate, taken.roll_rate, taken.valid)

        return sample
    sensor = sensor_of(file, link.name)

    def look() -> Tilt | None:
        until = link.now + _LOOK
        while link.now < until:
            tilt = sensor.read(link.now, link.receive(0.02))
            if tilt is not None:
                return tilt
        return None

    return look


def sensor_of(file: DrivesFile, bus: str) -> Any:
    """Return the inclinometer that the drives file names, open until the command ends.

    Raises:
        SettingsError: a recording as sensor where the drives may be real.
        SoftneckError: see `open_sensor`; nothing was sent to the drives yet.
    """
    if file.sensor_kind == "replay" and bus.partition(":")[0] not in HARMLESS:
        raise SettingsError(
            f'[sensor] kind "replay" is for simulated drives; on {bus} the loop would not see the neck it moves.'
        )
    return click.get_current_context().with_resource(
        open_sensor(file.sensor_kind, file.sensor_node, file.sensor_source)
    )
