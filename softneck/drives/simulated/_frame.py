"""A CAN frame as the simulated drives see it; theirs alone, the master has its own."""

from __future__ import annotations

from typing import NamedTuple


class CanFrame(NamedTuple):
    """One frame with an 11-bit identifier.

    Attributes:
        identifier: COB-ID.
        data: at most 8 bytes.
        remote: a request (RTR).
    """

    identifier: int
    data: bytes
    remote: bool = False
