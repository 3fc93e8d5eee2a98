"""What a frame of CANopen says, in words (CiA 301, CiA 402)."""

from __future__ import annotations

import struct

from ..master import Frame
from ..master._cia301 import node_state
from ..master._cia402 import state_of

_NMT = {1: "start", 2: "stop", 128: "pre-operational", 129: "reset", 130: "reset communication"}


def meaning(frame: Frame) -> str:
    """Return one frame in words, its bytes behind; for our own PDO mapping."""
    text = _words(frame)
    bytes_ = "remote request" if frame.remote else frame.data.hex(" ") or "no data"
    return f"{text} [{bytes_}]"


def _words(frame: Frame) -> str:
    base, node, data = frame.identifier & 0x780, frame.identifier & 0x7F, frame.data
    if frame.error:
        return "bus-off" if data == b"off" else "error on the bus"
    if frame.identifier == 0 and len(data) == 2:
        return f"NMT {_NMT.get(data[0], data[0])} to {'all' if data[1] == 0 else f'node {data[1]}'}"
    if frame.identifier == 0x80:
        return "SYNC"
    if base == 0x80 and len(data) >= 3:
        return f"emergency {int.from_bytes(data[:2], 'little'):04X}h of node {node}"
    if base == 0x200 and len(data) == 6:
        word, target = struct.unpack("<Hi", data)
        return f"to node {node}: control word {word:04X}h, target {target} counts"
    if base == 0x180 and len(data) == 8:
        word, counts, current = struct.unpack("<Hih", data)
        return f"from node {node}: {state_of(word).name}, {counts} counts, current {current}"
    if base in (0x580, 0x600) and len(data) == 8:
        index, subindex = struct.unpack_from("<HB", data, 1)
        return f"SDO {'to' if base == 0x600 else 'from'} node {node}: {index:04X}h:{subindex}"
    if base == 0x700:
        if frame.remote:
            return f"guarding of node {node}"
        return f"node {node} is {node_state(data[0]).name}" if len(data) == 1 else f"guarding of node {node}"
    return f"{frame.identifier:03X}h"
