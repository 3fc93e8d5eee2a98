"""The SDO server of a simulated node: expedited transfers, and segmented uploads of texts (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from collections.abc import Callable

NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
WRONG_LENGTH = 0x06070010
WRONG_VALUE = 0x06090030
WRONG_STATE = 0x08000022
BAD_COMMAND = 0x05040001
BAD_TOGGLE = 0x05030000

Read = Callable[[int, int], "bytes | int"]
Write = Callable[[int, int, bytes], int]
Size = Callable[[int, int], int]


class SdoServer:
    """SDO server; `read` returns bytes or an abort code, `write` an abort code or 0.

    As in small drives, writable objects have four bytes at most, so there are no segmented or block downloads.
    """

    def __init__(self, read: Read, write: Write, size: Size) -> None:
        """Serve the objects of `read` and `write`; `size` returns the size of an object [bytes]."""
        self._read, self._write, self._size = read, write, size
        self._left: bytes | None = None
        self._toggle = 0

    def answers(self, data: bytes) -> list[bytes]:
        """Return the responses (8 bytes each) to request `data`; empty if none is due."""
        if len(data) != 8:
            return []
        command = data[0] >> 5
        index, subindex = struct.unpack_from("<HB", data, 1)
        if command == 4:
            self._left = None
            return []
        if command == 1 and data[0] & 0x02:
            return [self._download(data, index, subindex)]
        if command == 2:
            return [self._upload(index, subindex)]
        if command == 3:
            return [self._up_segment(data[0])]
        return [self._abort(index, subindex, BAD_COMMAND)]

    def _download(self, data: bytes, index: int, subindex: int) -> bytes:
        self._left = None
        # A request without a size has the size of the object.
        size = 4 - ((data[0] >> 2) & 3) if data[0] & 0x01 else self._size(index, subindex)
        code = self._write(index, subindex, data[4 : 4 + size])
        return self._abort(index, subindex, code) if code else struct.pack("<BHB4x", 0x60, index, subindex)

    def _upload(self, index: int, subindex: int) -> bytes:
        self._left = None
        value = self._read(index, subindex)
        if isinstance(value, int):
            return self._abort(index, subindex, value)
        if len(value) <= 4:
            command = 0x43 | ((4 - len(value)) << 2)
            return struct.pack("<BHB", command, index, subindex) + value.ljust(4, b"\0")
        self._left, self._toggle = value, 0
        return struct.pack("<BHBI", 0x41, index, subindex, len(value))

    def _up_segment(self, command: int) -> bytes:
        if self._left is None:
            return self._abort(0, 0, BAD_COMMAND)
        if (command >> 4) & 1 != self._toggle:
            return self._abort(0, 0, BAD_TOGGLE)
        part, left = self._left[:7], self._left[7:]
        head = (self._toggle << 4) | ((7 - len(part)) << 1) | int(not left)
        self._toggle ^= 1
        self._left = left or None
        return bytes([head]) + part.ljust(7, b"\0")

    def _abort(self, index: int, subindex: int, code: int) -> bytes:
        self._left = None
        return struct.pack("<BHBI", 0x80, index, subindex, code)
