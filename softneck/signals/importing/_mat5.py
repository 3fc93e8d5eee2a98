"""MATLAB's version 5 files (also those of -v6 and -v7), numbers and structures of them.

Read here rather than by scipy.io.loadmat, which ends the whole process (a segmentation fault, scipy 1.17) on some
damaged files. The format: MathWorks, "MAT-File Format", 2004 and later, chapter 1, level 5.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# Table 1-1: types of data.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
# Table 1-3: classes of arrays.
_STRUCT, _NUMBERS = 2, range(6, 16)
_COMPLEX = 0x0800
_HEADER = 128
# Structures of logs are one or two deep; deeper ones are loops or hostile.
_MAX_DEPTH = 4
# [bytes]; a small hostile file may unpack to any size.
_MAX_BYTES = 2**30


@dataclass(slots=True)
class _Elements:
    """Elements one behind the other in `data`, numbers in byte `order`."""

    data: memoryview
    order: str
    place: int = 0

    def next(self) -> tuple[int, memoryview]:
        """Return the type and the content of the next element."""
        word, size = struct.unpack_from(self.order + "II", self.data, self.place)
        start = self.place + 8
        # A small element has its size in the upper half of its type and up to 4 bytes in place of the size.
        if word >> 16:
            kind, size, start, self.place = word & 0xFFFF, word >> 16, self.place + 4, start
            if size > 4:
                raise ValueError("a small element holds more than 4 bytes")
        else:
            kind = word
            # All but compressed elements fill up to 8 bytes.
            self.place = start + size + (0 if kind == _COMPRESSED else -size % 8)
        if start + size > len(self.data):
            raise ValueError("it ends in the middle of a variable")
        return kind, self.data[start : start + size]

    def numbers(self) -> np.ndarray:
        """Return the next element as numbers."""
        kind, content = self.next()
        if kind not in _TYPES:
            raise ValueError(f"an element of numbers has the type {kind}")
        return np.frombuffer(content, dtype=self.order + _TYPES[kind])

    def text(self) -> str:
        """Return the next element as a name."""
        return bytes(self.next()[1]).decode("utf-8", errors="replace")


def is_mat5(data: bytes) -> bool:
    """Return whether a file begins as one of version 5."""
    return len(data) >= _HEADER and data[124:128] in (b"\x00\x01IM", b"\x01\x00MI")


def read_mat5(data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the real numeric arrays of a file by their names; a structure of one element is opened.

    Raises:
        ValueError, struct.error, zlib.error: the file is damaged.
    """
    if not is_mat5(data):
        raise ValueError("neither version 5 nor 7.3; save it with -v7")
    file = _Elements(memoryview(data), "<" if data[126:128] == b"IM" else ">", _HEADER)
    while file.place + 8 <= len(data):
        kind, content = file.next()
        if kind == _COMPRESSED:
            kind, content = _Elements(_unpacked(content), file.order).next()
        if kind == _MATRIX:
            yield from _array(_Elements(content, file.order), None, 0)


def _unpacked(content: memoryview) -> memoryview:
    stream = zlib.decompressobj()
    unpacked = stream.decompress(content, _MAX_BYTES)
    if not stream.eof:
        raise ValueError("a compressed variable is cut off or too large")
    return memoryview(unpacked)


def _array(parts: _Elements, name: str | None, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield what an array holds; `name` replaces its own, which is empty within structures."""
    if not len(parts.data):
        return
    flags = int(parts.numbers()[0])
    shape = tuple(int(size) for size in parts.numbers())
    own = parts.text()
    name = own if name is None else name
    if flags & 0xFF == _STRUCT and shape == (1, 1) and depth < _MAX_DEPTH:
        width = int(parts.numbers()[0])
        names = bytes(parts.next()[1])
        if not 0 < width <= 256:
            raise ValueError(f"the fields of a structure have names of {width} bytes")
        for start in range(0, len(names) - width + 1, width):
            field = names[start : start + width].split(b"\0")[0].decode("utf-8", errors="replace")
            kind, content = parts.next()
            if kind != _MATRIX:
                raise ValueError(f"a field of a structure has the type {kind}")
            yield from _array(_Elements(content, parts.order), f"{name}.{field}", depth + 1)
    elif flags & 0xFF in _NUMBERS and not flags & _COMPLEX:
        # Stored by columns, in the smallest type that holds the numbers.
        yield name, parts.numbers().astype(np.float64).reshape(shape, order="F")
