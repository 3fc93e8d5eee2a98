"""`python -m softneck.drives.simulated.inclinometer INTERFACE:CHANNEL SOCKET`: the inclinometer as its own process."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

import click


@click.command()
@click.argument("bus", metavar="INTERFACE:CHANNEL")
@click.argument("path", metavar="SOCKET", type=click.Path(path_type=Path))
def main(bus: str, path: Path) -> None:
    """Send on BUS what the drives' process (`--sensor-socket SOCKET`) says that the inclinometer measures."""
    import can

    interface, _, channel = bus.partition(":")
    path.unlink(missing_ok=True)
    with (
        can.Bus(interface=interface, channel=channel) as opened,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as source,
    ):
        source.bind(str(path))
        while True:
            sample = source.recv(64)
            message = can.Message(
                arbitration_id=int.from_bytes(sample[:2], "little"), data=sample[2:], is_extended_id=False
            )
            # A bus that is down loses samples.
            with contextlib.suppress(can.CanError, OSError):
                opened.send(message)


if __name__ == "__main__":
    main()
