"""Which nodes are on the bus, and whether one number belongs to several devices; sends reads only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..bus._link import BusError, Link
from ..bus._sdo import Objects, SdoError
from ..master import Frame
from ..master._cia402 import state_of

# All nodes answer within this time [s] after the last request, and so do two devices with one node number.
_SCAN_TIME = 0.2
# Bits of a CAN frame with 8 bytes, stuffed: what a request needs on the wire. An adapter's queue may hold 10 frames
# (txqueuelen of can0), so a request waits for an answer to the one before, or as long as that took some times over.
_FRAME_BITS, _PAUSE_FRAMES, _SHORTEST_PAUSE = 135, 3, 2e-3
DRIVE = 0x192  # device profile in 1000h


def require_bus(link: Link) -> None:
    """Raise BusError if the bus refused a frame: whoever sends nothing hears nothing, which is no drive's fault."""
    if link.problem:
        raise BusError(f"the bus takes no frames: {link.problem} Nothing was moved.")


def scan(link: Link, *, bit_rate: int = 1_000_000) -> list[dict[str, Any]]:
    """Ask every node number for its device type; return what answers, with identity where it tells.

    Args:
        link: to the bus.
        bit_rate: of the bus [bit/s], by which requests are paced.

    Raises:
        BusError: the bus takes no frames.
    """
    link.receive(0.0)
    pause = max(_SHORTEST_PAUSE, _PAUSE_FRAMES * _FRAME_BITS / bit_rate)
    answers: dict[int, int] = {}

    def take(until: float, wanted: int = 0) -> None:
        while link.now < until and wanted not in answers:
            for frame in link.receive(until - link.now):
                node = frame.identifier - 0x580
                if 1 <= node <= 126 and _answers(frame, node, 0x1000):
                    answers[node] = int.from_bytes(frame.data[4:8], "little")

    for node in range(1, 127):
        link.send([_question(node, 0x1000)])
        require_bus(link)
        take(link.now + pause, node)
    take(link.now + _SCAN_TIME)
    require_bus(link)
    return [_identity(link, Objects(link, node), kind) for node, kind in sorted(answers.items())]


def _question(node: int, index: int, subindex: int = 0) -> Frame:
    """Return the request to read an object (CiA 301, 7.2.4.3.5)."""
    return Frame(0x600 + node, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))


def _answers(frame: Frame, node: int, index: int, subindex: int = 0) -> bool:
    """Return whether `frame` answers that request, by a value or an abort."""
    about = bytes([index & 0xFF, index >> 8, subindex])
    return frame.identifier == 0x580 + node and len(frame.data) == 8 and not frame.error and frame.data[1:4] == about


def devices_at(link: Link, nodes: Sequence[int]) -> dict[int, list[int | None]]:
    """Return node -> serial number of each device that answers there, None of one that tells none.

    Two devices with one number both answer each request, and an SDO client believes the first.
    """
    link.receive(0.0)
    found: dict[int, list[int | None]] = {node: [] for node in nodes}
    for node in nodes:
        link.send([_question(node, 0x1018, 4)])
    until = link.now + _SCAN_TIME
    while link.now < until:
        for frame in link.receive(until - link.now):
            node = frame.identifier - 0x580
            if node in found and _answers(frame, node, 0x1018, 4):
                refused = frame.data[0] == 0x80
                found[node].append(None if refused else int.from_bytes(frame.data[4:8], "little"))
    return found


def several_devices(serials: Sequence[int | None]) -> str:
    """Return what to say of a node number with several devices, "" of one with one."""
    if len(serials) < 2:
        return ""
    told = ", ".join("not told" if serial is None else str(serial) for serial in serials)
    return f"{len(serials)} devices answer (serial numbers {told})"


def _identity(link: Link, objects: Objects, kind: int) -> dict[str, Any]:
    serials = devices_at(link, [objects.node])[objects.node]
    found: dict[str, Any] = {
        "node": objects.node,
        "device_type": kind,
        "drive": kind & 0xFFFF == DRIVE,
        "serials": serials,
    }
    for name, subindex in (("vendor", 1), ("product", 2), ("revision", 3), ("serial", 4)):
        found[name] = or_none(lambda sub=subindex: objects.read(0x1018, sub))
    found["name"] = or_none(lambda: objects.read_text(0x1008))
    found["firmware"] = or_none(lambda: objects.read_text(0x100A))
    word = or_none(lambda: objects.read(0x6041))
    found["state"] = None if word is None else state_of(int(word)).name
    return found


def or_none(read: Any) -> Any:
    try:
        return read()
    except SdoError:
        return None
