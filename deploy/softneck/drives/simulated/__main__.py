"""`python -m softneck.drives.simulated INTERFACE:CHANNEL`: simulated drives, neck and inclinometer on a bus."""

from __future__ import annotations

import click

from softneck.plant import NeckParameters

from ._neck import SimulatedNeck, SimulatedSettings
from ._profiles import PROFILES
from ._server import serve


@click.command()
@click.argument("bus", metavar="INTERFACE:CHANNEL")
@click.option("--neck", default="paper", show_default=True, help="paper, lab or a neck file (.toml).")
@click.option("--profile", type=click.Choice(list(PROFILES)), default="ipos2015", show_default=True)
@click.option("--homed", is_flag=True, help="As if `softneck drives zero` had been run.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the inclinometer's noise.")
def main(bus: str, neck: str, profile: str, homed: bool, seed: int) -> None:
    """Simulate three drives (nodes 1 to 3), the neck and an inclinometer (node 10) on a bus, until Ctrl-C."""
    import can

    interface, _, channel = bus.partition(":")
    settings = SimulatedSettings(profile=profile, homed=homed, seed=seed)
    virtual = SimulatedNeck(NeckParameters.preset(neck), settings)
    with can.Bus(interface=interface, channel=channel) as opened:
        click.echo(f"three {profile} drives on {bus}; Ctrl-C ends them", err=True)
        serve(opened, virtual)


if __name__ == "__main__":
    main()
