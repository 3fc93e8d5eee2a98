"""Octave's own files, `save -text` (its default) and `save -binary`: numbers only.

The forms are those of Octave's load-save room: `libinterp/corefcn/ls-oct-text.cc` and `ls-oct-binary.cc` of
gnu-octave/octave, whose comments describe them; nothing of it is copied.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

from softneck.core import FileFormatError
from softneck.core._budget import MOST_NUMBERS

# As in MATLAB files: deeper structures are loops or hostile, and larger arrays are no logs.
_MAX_DEPTH = 4
# A range is three numbers in the file.
_MAX_RANGE = 2**22
# Save types of doubles, in the order of Octave's `save_type`.
_DOUBLES = ("u1", "u2", "u4", "i1", "i2", "i4", "f4", "f8", "u8", "i8")
_INTEGERS = {f"{sign}int{bits}": f"{sign[:1] or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
_ELEMENT = "<cell-element>"

Named = Iterator[tuple[str, np.ndarray]]


def octave_arrays(source: Path) -> dict[str, np.ndarray]:
    """Return all real arrays (rows, columns) of a file by their names.

    A field of a structure is `structure.field`, an element of a cell or of an array of structures `name{1}`.

    Raises:
        FileFormatError: the file is damaged, or holds what Octave saves for itself alone.
    """
    data = source.read_bytes()
    try:
        if data.startswith(b"Octave-1-"):
            found = dict(_Binary(memoryview(data), "<" if data[9:10] == b"L" else ">", 11).variables())
        else:
            found = dict(_Text(data.decode("utf-8", errors="replace").splitlines()).variables())
    except (ValueError, IndexError, struct.error, RecursionError, MemoryError, OverflowError) as error:
        said = " ".join(str(error).split())  # names of the file's may hold line ends
        raise FileFormatError(
            f"{source}: cannot be read as a file of Octave ({said}); save it again by `save -text`."
        ) from error
    return {name: array for name, array in found.items() if array.ndim == 2 and array.size}


def _shaped(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return numbers as Octave stores them, columns first, as an array of float64."""
    return np.asarray(values, dtype=np.float64).reshape(shape, order="F")


def _checked(shape: tuple[int, ...]) -> tuple[int, ...]:
    if any(size < 0 for size in shape) or prod(shape) > MOST_NUMBERS:
        raise ValueError(f"an array of {' x '.join(map(str, shape))} numbers is no log")
    return shape


@dataclass(slots=True)
class _Text:
    """Lines of `save -text`: `# key: value` before the numbers of each variable."""

    lines: list[str]
    place: int = 0

    def variables(self) -> Named:
        """Yield all arrays of the file."""
        while self._seek():
            yield from self._variable("", 0)

    def _seek(self) -> bool:
        """Go to the next line that names a variable."""
        while self.place < len(self.lines) and not self.lines[self.place].startswith("# name:"):
            self.place += 1
        return self.place < len(self.lines)

    def _key(self, key: str) -> str | None:
        """Return the value of the line `# key: value` if it is the next one."""
        while self.place < len(self.lines) and not self.lines[self.place].strip():
            self.place += 1
        if self.place >= len(self.lines) or not self.lines[self.place].startswith(f"# {key}:"):
            return None
        self.place += 1
        return self.lines[self.place - 1].partition(":")[2].strip()

    def _shape(self) -> tuple[tuple[int, ...], bool]:
        """Return the sizes of an array, and whether its numbers stand row by row: those said by rows and columns do."""
        if self._key("ndims") is not None:
            self.place += 1
            return _checked(tuple(int(word) for word in self.lines[self.place - 1].split())), False
        rows, columns = self._key("rows"), self._key("columns")
        if rows is None or columns is None:
            raise ValueError(f"line {self.place + 1} does not say the size of an array")
        return _checked((int(rows), int(columns))), True

    def _numbers(self, count: int) -> np.ndarray:
        words: list[str] = []
        while len(words) < count and self.place < len(self.lines) and not self.lines[self.place].startswith("#"):
            words += self.lines[self.place].split()
            self.place += 1
        if len(words) != count:
            raise ValueError(f"line {self.place}: {count} numbers are declared and {len(words)} are there")
        named = {"NA": "nan"}  # Octave's mark of a missing number
        return np.array([float(named.get(word, word)) for word in words])

    def _variable(self, before: str, depth: int) -> Named:
        if not self._seek():
            raise ValueError("it ends within a structure")
        name = self._key("name") or ""
        name = before.removesuffix(".") if name == _ELEMENT else before + name
        kind = (self._key("type") or "").removeprefix("global ")
        if kind.endswith("struct") and depth < _MAX_DEPTH:
            if self._key("ndims") is not None:
                self.place += 1
            for _ in range(int(self._key("length") or 0)):
                yield from self._variable(f"{name}.", depth + 1)
        elif kind == "cell" and depth < _MAX_DEPTH:
            for place in range(prod(self._shape()[0])):
                yield from self._variable(f"{name}{{{place + 1}}}.", depth + 1)
        elif "complex" in kind or "sparse" in kind:
            return
        elif kind.endswith("matrix"):
            shape, by_rows = self._shape()
            values = self._numbers(prod(shape))
            yield name, values.reshape(shape) if by_rows else _shaped(values, shape)
        elif kind.endswith("range"):
            base, limit, step = self._numbers_below_a_remark()
            yield name, _range(base, limit, step)[None, :]
        elif kind.endswith("scalar") or kind == "bool":
            yield name, self._numbers(1)[None, :]

    def _numbers_below_a_remark(self) -> tuple[float, float, float]:
        base, limit, step = (float(word) for word in self.lines[self.place + 1].split()[:3])
        self.place += 2
        return base, limit, step


def _range(base: float, limit: float, step: float) -> np.ndarray:
    """Return base, base + step, ... up to `limit`, which for a step of 0 is the count."""
    count = limit if step == 0.0 else np.floor((limit - base) / step * (1.0 + 1e-15) + 1e-10) + 1.0
    if not count <= _MAX_RANGE:
        raise ValueError(f"a range of {count:g} numbers is no log")
    return base + step * np.arange(int(max(count, 0.0)))


@dataclass(slots=True)
class _Binary:
    """Records of `save -binary` one behind the other, numbers in byte `order`."""

    data: memoryview
    order: str
    place: int

    def variables(self) -> Named:
        """Yield all arrays of the file."""
        while self.place < len(self.data):
            yield from self._variable("", 0)

    def _take(self, size: int) -> memoryview:
        if size < 0 or self.place + size > len(self.data):
            raise ValueError("it ends in the middle of a variable")
        self.place += size
        return self.data[self.place - size : self.place]

    def _int(self) -> int:
        return struct.unpack(self.order + "i", self._take(4))[0]

    def _text(self) -> str:
        return bytes(self._take(self._int())).decode("utf-8", errors="replace")

    def _values(self, kind: str, count: int) -> np.ndarray:
        return np.frombuffer(self._take(count * np.dtype(kind).itemsize), dtype=self.order + kind)

    def _doubles(self, count: int) -> np.ndarray:
        """Return numbers behind the byte that says in which type they were saved."""
        return self._values(_DOUBLES[self._take(1)[0]], count)

    def _shape(self) -> tuple[int, ...]:
        """Return the sizes of an array: their count is negative; files before 2001 have rows and columns alone."""
        count = self._int()
        if count >= 0:
            return _checked((count, self._int()))
        if count < -32:
            raise ValueError(f"an array has {-count} dimensions")
        return _checked(tuple(self._int() for _ in range(-count)))

    def _variable(self, before: str, depth: int) -> Named:
        name = self._text()
        name = before.removesuffix(".") if name == _ELEMENT else before + name
        self._text()
        self._take(1)
        code = self._take(1)[0]
        old = {1: "scalar", 2: "matrix", 3: "complex scalar", 4: "complex matrix", 6: "range", 7: "string"}
        kind = self._text() if code == 255 else old.get(code, f"type {code}")
        if kind.endswith("struct") and depth < _MAX_DEPTH:
            count = self._int()
            if count < 0:  # an array of structures: its sizes, then the number of fields
                for _ in range(-count):
                    self._int()
                count = self._int()
            for _ in range(count):
                yield from self._variable(f"{name}.", depth + 1)
        elif kind == "cell" and depth < _MAX_DEPTH:
            for place in range(prod(self._shape())):
                yield from self._variable(f"{name}{{{place + 1}}}.", depth + 1)
        else:
            values = self._array(kind)
            if values is not None:
                yield name, values

    def _array(self, kind: str) -> np.ndarray | None:
        """Read an array; None for words and complex numbers."""
        integer, _, form = kind.partition(" ")
        if kind in ("matrix", "float matrix"):
            shape = self._shape()
            return _shaped(self._doubles(prod(shape)), shape)
        if kind in ("scalar", "float scalar"):
            return _shaped(self._doubles(1), (1, 1))
        if kind in ("range", "double_range"):
            self._take(1)
            base, limit, step = self._values("f8", 3)
            return _range(float(base), float(limit), float(step))[None, :]
        if kind == "bool":
            return _shaped(self._values("u1", 1), (1, 1))
        if kind == "bool matrix" or (integer in _INTEGERS and form == "matrix"):
            shape = self._shape()
            return _shaped(self._values(_INTEGERS.get(integer, "u1"), prod(shape)), shape)
        if integer in _INTEGERS and form == "scalar":
            return _shaped(self._values(_INTEGERS[integer], 1), (1, 1))
        if kind in ("string", "sq_string"):
            self._take(prod(self._shape()))
        elif kind in ("complex matrix", "float complex matrix"):
            self._doubles(2 * prod(self._shape()))
        elif kind in ("complex scalar", "float complex scalar"):
            self._doubles(2)
        else:
            raise ValueError(f"it holds a `{kind[:40]}`")
        return None
