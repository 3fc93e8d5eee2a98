"""The SDO server of a simulated node: expedited, segmented and block transfers both ways (CiA 301, 7.2.4)."""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass

NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
WRONG_LENGTH = 0x06070010
WRONG_VALUE = 0x06090030
WRONG_STATE = 0x08000022
BAD_COMMAND = 0x05040001
BAD_TOGGLE = 0x05030000
BAD_BLOCK_SIZE = 0x05040002
BAD_SUM = 0x05040004
NO_MEMORY = 0x05040005
GENERAL = 0x08000000

Read = Callable[[int, int], "bytes | int"]
Write = Callable[[int, int, bytes], int]
Size = Callable[[int, int], int]
# No object of a drive is larger; and of frames in a block, what a small controller can buffer.
_MOST_BYTES, _BLOCK = 1024, 16


@dataclass(slots=True)
class _Transfer:
    """One that takes more than a frame: `kind` is "up", "down", "block up" or "block down"."""

    kind: str
    index: int
    subindex: int
    content: bytes = b""
    toggle: int = 0
    place: int = 0
    block: int = _BLOCK
    ended: bool = False


class SdoServer:
    """Answers requests; `read` returns bytes or an abort code, `write` an abort code or 0.

    With `plain` it knows expedited downloads and segmented uploads alone, as small drives do; with `one_abort` it does
    not say why it refuses something.
    """

    def __init__(
        self, read: Read, write: Write, *, plain: bool = False, one_abort: bool = False, size: Size | None = None
    ) -> None:
        """Serve the objects behind `read` and `write`; `size` tells that of one [bytes], else what can be read does."""
        self._read, self._write, self._plain, self._one_abort = read, write, plain, one_abort
        self._size = size or (lambda *key: len(there) if isinstance(there := read(*key), bytes) else 4)
        self._running: _Transfer | None = None

    def answers(self, data: bytes) -> list[bytes]:
        """Return the responses (8 bytes each) to request `data`; none where none is due."""
        if len(data) != 8:
            return []
        t = self._running
        if t is not None and t.kind == "block down" and not t.ended and data[0] != 0x80:
            return self._block_segment(t, data)
        command = data[0] >> 5
        index, subindex = struct.unpack_from("<HB", data, 1)
        if command == 4:
            self._running = None
            return []
        if command == 0 and not self._plain:
            return [self._down_segment(data)]
        if command == 1:
            return [self._download(data, index, subindex)]
        if command == 2:
            return [self._upload(index, subindex)]
        if command == 3:
            return [self._up_segment(data[0])]
        if command == 5 and not self._plain:
            return self._block_upload(data, index, subindex)
        if command == 6 and not self._plain:
            return [self._block_download(data, index, subindex)]
        return [self._abort(index, subindex, BAD_COMMAND)]

    # -- to the drive -------------------------------------------------------------------------------------------

    def _download(self, data: bytes, index: int, subindex: int) -> bytes:
        self._running = None
        if not data[0] & 0x02:
            if self._plain:
                return self._abort(index, subindex, BAD_COMMAND)
            self._running = _Transfer("down", index, subindex)
            return struct.pack("<BHB4x", 0x60, index, subindex)
        # Where the size is not said it is that of the object.
        size = 4 - ((data[0] >> 2) & 3) if data[0] & 0x01 else self._size(index, subindex)
        return self._stored(index, subindex, data[4 : 4 + size], 0x60)

    def _down_segment(self, data: bytes) -> bytes:
        t = self._running
        if t is None or t.kind != "down":
            return self._abort(0, 0, BAD_COMMAND)
        if (data[0] >> 4) & 1 != t.toggle:
            return self._abort(t.index, t.subindex, BAD_TOGGLE)
        t.content += data[1 : 8 - ((data[0] >> 1) & 7)]
        if len(t.content) > _MOST_BYTES:
            return self._abort(t.index, t.subindex, NO_MEMORY)
        if data[0] & 1 and (code := self._write(t.index, t.subindex, t.content)):
            return self._abort(t.index, t.subindex, code)
        head = 0x20 | t.toggle << 4
        t.toggle ^= 1
        if data[0] & 1:
            self._running = None
        return bytes([head]) + bytes(7)

    def _block_download(self, data: bytes, index: int, subindex: int) -> bytes:
        t = self._running
        if not data[0] & 1:
            self._running = _Transfer("block down", index, subindex)
            return struct.pack("<BHBB3x", 0xA4, index, subindex, _BLOCK)
        if t is None or t.kind != "block down":
            return self._abort(index, subindex, BAD_COMMAND)
        content = t.content[: len(t.content) - ((data[0] >> 2) & 7)]
        if binascii.crc_hqx(content, 0) != int.from_bytes(data[1:3], "little"):
            return self._abort(t.index, t.subindex, BAD_SUM)
        self._running = None
        answer = self._stored(t.index, t.subindex, content, 0xA1)
        return answer if answer[0] == 0x80 else bytes([0xA1]) + bytes(7)

    def _block_segment(self, t: _Transfer, data: bytes) -> list[bytes]:
        number = data[0] & 0x7F
        if number == t.place + 1:
            t.place, t.ended = number, bool(data[0] & 0x80)
            t.content += data[1:]
        if len(t.content) > _MOST_BYTES:
            return [self._abort(t.index, t.subindex, NO_MEMORY)]
        if number < _BLOCK and not data[0] & 0x80:
            return []
        # What was missed is asked for again: the client goes on behind the last one in order.
        answer = bytes([0xA2, t.place, _BLOCK]) + bytes(5)
        t.place = 0
        return [answer]

    def _stored(self, index: int, subindex: int, content: bytes, head: int) -> bytes:
        code = self._write(index, subindex, content)
        return self._abort(index, subindex, code) if code else struct.pack("<BHB4x", head, index, subindex)

    # -- from the drive -----------------------------------------------------------------------------------------

    def _upload(self, index: int, subindex: int) -> bytes:
        self._running = None
        value = self._read(index, subindex)
        if isinstance(value, int):
            return self._abort(index, subindex, value)
        if len(value) <= 4:
            command = 0x43 | ((4 - len(value)) << 2)
            return struct.pack("<BHB", command, index, subindex) + value.ljust(4, b"\0")
        self._running = _Transfer("up", index, subindex, value)
        return struct.pack("<BHBI", 0x41, index, subindex, len(value))

    def _up_segment(self, command: int) -> bytes:
        t = self._running
        if t is None or t.kind != "up":
            return self._abort(0, 0, BAD_COMMAND)
        if (command >> 4) & 1 != t.toggle:
            return self._abort(0, 0, BAD_TOGGLE)
        part, t.content = t.content[:7], t.content[7:]
        head = (t.toggle << 4) | ((7 - len(part)) << 1) | int(not t.content)
        t.toggle ^= 1
        if not t.content:
            self._running = None
        return bytes([head]) + part.ljust(7, b"\0")

    def _block_upload(self, data: bytes, index: int, subindex: int) -> list[bytes]:
        t, step = self._running, data[0] & 3
        if step == 0:
            return [self._begin_block(index, subindex, data[4])]
        if t is None or t.kind != "block up":
            return [self._abort(index, subindex, BAD_COMMAND)]
        if step == 1:
            self._running = None
            return []
        if step == 2:  # so many of the block arrived, and so many may come next
            t.place += 7 * data[1]
            if not 0 < data[2] < 128:
                return [self._abort(t.index, t.subindex, BAD_BLOCK_SIZE)]
            t.block = data[2]
            if t.place >= len(t.content):
                empty = -len(t.content) % 7
                return [struct.pack("<BH5x", 0xC1 | empty << 2, binascii.crc_hqx(t.content, 0))]
        parts = [t.content[at : at + 7] for at in range(t.place, len(t.content), 7)][: t.block]
        last = t.place + 7 * len(parts) >= len(t.content)
        return [
            bytes([number | 0x80 * (last and number == len(parts))]) + part.ljust(7, b"\0")
            for number, part in enumerate(parts, start=1)
        ]

    def _begin_block(self, index: int, subindex: int, block: int) -> bytes:
        self._running = None
        if not 0 < block < 128:
            return self._abort(index, subindex, BAD_BLOCK_SIZE)
        value = self._read(index, subindex)
        if isinstance(value, int):
            return self._abort(index, subindex, value)
        self._running = _Transfer("block up", index, subindex, value, block=block)
        return struct.pack("<BHBI", 0xC6, index, subindex, len(value))

    def _abort(self, index: int, subindex: int, code: int) -> bytes:
        self._running = None
        return struct.pack("<BHBI", 0x80, index, subindex, GENERAL if self._one_abort else code)
