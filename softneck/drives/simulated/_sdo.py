"""The SDO server of a simulated node: expedited transfers, and segmented upload of texts (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from collections.abc import Callable

NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
READ_ONLY = 0x06010002
WRONG_LENGTH = 0x06070010
WRONG_VALUE = 0x06090030
WRONG_STATE = 0x08000022
BAD_COMMAND = 0x05040001
BAD_TOGGLE = 0x05030000

Read = Callable[[int, int], "bytes | int"]
Write = Callable[[int, int, bytes], int]


class SdoServer:
    """Answers requests; `read` returns bytes or an abort code, `write` an abort code or 0."""

    def __init__(self, read: Read, write: Write) -> None:
        """Serve the objects behind `read` and `write`."""
        self._read, self._write = read, write
        self._left = b""
        self._toggle = 0
        self._sending = False

    def answer(self, data: bytes) -> bytes | None:
        """Return the response (8 bytes) to request `data`; None where none is due."""
        if len(data) != 8:
            return None
        command = data[0] >> 5
        index, subindex = struct.unpack_from("<HB", data, 1)
        if command == 1:
            return self._download(data, index, subindex)
        if command == 2:
            return self._upload(index, subindex)
        if command == 3:
            return self._segment(data[0])
        if command == 4:
            self._sending = False
            return None
        return _abort(index, subindex, BAD_COMMAND)

    def _download(self, data: bytes, index: int, subindex: int) -> bytes:
        self._sending = False
        if not data[0] & 0x02:
            return _abort(index, subindex, BAD_COMMAND)
        size = 4 - ((data[0] >> 2) & 3) if data[0] & 0x01 else 4
        code = self._write(index, subindex, data[4 : 4 + size])
        return _abort(index, subindex, code) if code else struct.pack("<BHB4x", 0x60, index, subindex)

    def _upload(self, index: int, subindex: int) -> bytes:
        self._sending = False
        value = self._read(index, subindex)
        if isinstance(value, int):
            return _abort(index, subindex, value)
        if len(value) <= 4:
            command = 0x43 | ((4 - len(value)) << 2)
            return struct.pack("<BHB", command, index, subindex) + value.ljust(4, b"\0")
        self._left, self._toggle, self._sending = value, 0, True
        return struct.pack("<BHBI", 0x41, index, subindex, len(value))

    def _segment(self, command: int) -> bytes:
        if not self._sending:
            return _abort(0, 0, BAD_COMMAND)
        if (command >> 4) & 1 != self._toggle:
            self._sending = False
            return _abort(0, 0, BAD_TOGGLE)
        part, self._left = self._left[:7], self._left[7:]
        last = not self._left
        head = (self._toggle << 4) | ((7 - len(part)) << 1) | int(last)
        self._toggle ^= 1
        self._sending = not last
        return bytes([head]) + part.ljust(7, b"\0")


def _abort(index: int, subindex: int, code: int) -> bytes:
    return struct.pack("<BHBI", 0x80, index, subindex, code)
