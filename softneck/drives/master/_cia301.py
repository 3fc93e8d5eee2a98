"""CAN frames inside the core, and network management (CiA 301, 7.3.2): node states, commands, and their frames.

python-can's message exists at the edge only.
"""

from __future__ import annotations

from enum import IntEnum
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


class NodeState(IntEnum):
    """NMT states as heartbeat and guarding code them."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
    UNKNOWN = 0xFF


class Command(IntEnum):
    """NMT commands."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


def nmt_frame(command: Command, node: int) -> Frame:
    """Return the frame that commands `node` (0: all)."""
    return Frame(0x000, bytes([command, node]))


def node_state(code: int) -> NodeState:
    """Return the state that a heartbeat or guarding byte says, without its toggle bit."""
    try:
        return NodeState(code & 0x7F)
    except ValueError:
        return NodeState.UNKNOWN
