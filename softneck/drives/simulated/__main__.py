"""`python -m softneck.drives.simulated INTERFACE:CHANNEL`: simulated drives, neck and inclinometer on a bus."""

from __future__ import annotations

import contextlib
import gc
import json
import signal
import sys
from collections.abc import Iterator
from typing import Any

import click

from softneck.core import SettingsError
from softneck.plant import NeckParameters

from ._axis import STATES
from ._drives import SimulatedDrives, SimulatedSettings
from ._neck import SimulatedNeck
from ._profiles import PROFILES
from ._quirks import quirks_of
from ._server import serve


@click.command()
@click.argument("bus", metavar="INTERFACE:CHANNEL")
@click.option("--neck", default="paper", show_default=True, help="paper, lab, rough or a neck file (.toml).")
@click.option("--profile", type=click.Choice(list(PROFILES)), default="ipos2015", show_default=True)
@click.option("--homed", is_flag=True, help="As if `softneck drives commission --only zero` had been run.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the inclinometer's noise.")
@click.option("--report", is_flag=True, help="Print one JSON line for each change of a drive's power state.")
@click.option("--cycle", type=float, default=0.01, show_default=True, help="Bus period the drives expect [s].")
@click.option(
    "--quirk",
    "quirks",
    multiple=True,
    metavar="NAME=VALUE",
    help="How strict the drives are, such as sdo_latency=0.05; again for more (docs/reference/drives.md).",
)
def main(
    bus: str, neck: str, profile: str, homed: bool, seed: int, report: bool, cycle: float,
    quirks: tuple[str, ...],
) -> None:  # fmt: skip
    """Simulate three drives (nodes 1 to 3), the neck and an inclinometer (node 10) on a bus, until Ctrl-C.

    SIGUSR1 presses the hardware stop at the drives' Enable inputs, SIGUSR2 unplugs the inclinometer; sent again they
    release it and plug it in.
    """
    import can

    interface, _, channel = bus.partition(":")
    common: dict[str, Any] = {"profile": profile, "homed": homed, "seed": seed, "cycle": cycle}
    try:
        common["quirks"] = quirks_of(quirks)
    except SettingsError as error:
        raise click.BadParameter(str(error), param_hint="--quirk") from error
    virtual = SimulatedNeck(NeckParameters.preset(neck), SimulatedSettings(**common))
    # Compile everything before the drives answer.
    virtual.move()
    virtual.sample(0.0)
    gc.freeze()
    with can.Bus(interface=interface, channel=channel) as opened, signals(virtual):
        click.echo(f"three {profile} drives on {bus}; Ctrl-C ends them", err=True)
        serve(opened, virtual, report=_print if report else None)


def _print(now: float, neck: SimulatedDrives, row: int) -> None:
    axis = neck.drives[row].axis
    line = {"time_s": now, "node": axis.node, "state": STATES[axis.state], "fault": f"{axis.fault:04X}h",
            "counts": axis.getters[(0x6064, 0)]()}  # fmt: skip
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


@contextlib.contextmanager
def signals(neck: SimulatedDrives) -> Iterator[None]:
    """Handle SIGUSR1 (toggles the Enable inputs of all drives) and SIGUSR2 (toggles the inclinometer)."""
    if not hasattr(signal, "SIGUSR1"):
        yield
        return

    def push(*_: object) -> None:
        for drive in neck.drives:
            drive.axis.enable_input = not drive.axis.enable_input

    def unplug(*_: object) -> None:
        neck.sensor = "works" if neck.sensor == "silent" else "silent"

    before = [(number, signal.signal(number, act)) for number, act in
              ((signal.SIGUSR1, push), (signal.SIGUSR2, unplug))]  # fmt: skip
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


if __name__ == "__main__":
    main()
