"""A CAN frame inside the core; python-can's message exists at the edge only."""

from __future__ import annotations

from typing import NamedTuple


class Frame(NamedTuple):
    """One frame on the CAN bus.

    Attributes:
        identifier: COB-ID.
        data: at most 8 bytes.
        remote: a remote request (RTR).
        error: not from the bus but about it: the adapter reports an error; data is b"off" for bus-off.
    """

    identifier: int
    data: bytes = b""
    remote: bool = False
    error: bool = False


BUS_OFF = Frame(0, b"off", error=True)
"""What the edge puts in when the adapter went bus-off or is gone."""
