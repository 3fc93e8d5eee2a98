"""MATLAB files as tables: v5, and v7.3 (HDF5) through h5py; numbers only, no code, no other files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, FileFormatError

if TYPE_CHECKING:
    import pandas as pd

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


# A small hostile file may declare any size; no log of ours comes near 2^27 numbers (1 GiB).
_MAX_NUMBERS = 2**27


def read_mat(source: Path, variable: str | None, wanted: tuple[str, ...] = ()) -> pd.DataFrame:
    """Read a MAT file as a table.

    Args:
        source: the file, v5 or v7.3.
        variable: a matrix (time, columns), whose columns get the numbers 0, 1, ...; None takes all vectors
            by their names. Fields of a structure are named `structure.field`.
        wanted: the vectors that are needed; others of another length are left out.

    Raises:
        FileFormatError: no MAT file.
        DataError: the variable is not there, is not a matrix of numbers, or vectors differ in length.
    """
    return mat_table(source, mat_arrays(source), variable, wanted)


def mat_table(
    source: Path, arrays: dict[str, np.ndarray], variable: str | None, wanted: tuple[str, ...] = ()
) -> pd.DataFrame:
    """Return the table of `read_mat` from the file's arrays."""
    return _vectors(source, arrays, wanted) if variable is None else _matrix(source, arrays, variable)


def mat_arrays(source: Path) -> dict[str, np.ndarray]:
    """Return all arrays (rows, columns) of numbers in a MAT file by their names.

    Raises:
        FileFormatError: no MAT file.
        DataError: a variable lies in another file or declares an impossible size.
    """
    import h5py  # slow to import, and few logs need it

    try:
        found = _by_name(_hdf5(source) if h5py.is_hdf5(source) else read_mat5(source.read_bytes()))
    except (DataError, FileFormatError):
        raise
    except Exception as error:  # the parsers raise whatever the damaged bytes lead to
        reason = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise FileFormatError(f"{source}: cannot be read as a MAT file ({reason}).") from error
    return {name: array for name, array in found.items() if array.ndim == 2 and array.size}


def _by_name(arrays: Iterator[tuple[str, np.ndarray]]) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for name, array in arrays:
        if name in found:
            raise ValueError(f"the variable `{name}` stands there twice")
        found[name] = array
    return found


def _matrix(source: Path, arrays: dict[str, np.ndarray], variable: str) -> pd.DataFrame:
    import pandas as pd

    if variable not in arrays:
        raise DataError(f"{source}: there is no variable `{variable}` with numbers; the file has {_listed(arrays)}.")
    array = arrays[variable]
    return pd.DataFrame(array.T if array.shape[0] == 1 else array)


def _vectors(source: Path, arrays: dict[str, np.ndarray], wanted: tuple[str, ...]) -> pd.DataFrame:
    import pandas as pd

    vectors = {name: array.ravel() for name, array in arrays.items() if 1 in array.shape and array.size > 1}
    if not vectors:
        raise DataError(
            f"{source}: has no vectors of numbers; name the matrix by `[file] variable`; it has {_listed(arrays)}."
        )
    lengths = {name: vectors[name].size for name in wanted if name in vectors}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} ({size})" for name, size in lengths.items())
        raise DataError(f"{source}: the layout's variables differ in length: {listed}; cut them to one length.")
    sizes = [vector.size for vector in vectors.values()]
    rows = next(iter(lengths.values()), max(sizes, key=sizes.count))
    return pd.DataFrame({name: vector for name, vector in vectors.items() if vector.size == rows})


def _listed(arrays: dict[str, np.ndarray]) -> str:
    return ", ".join(f"{name} ({a.shape[0]} x {a.shape[1]})" for name, a in arrays.items()) or "none"


def _hdf5(source: Path) -> Iterator[tuple[str, np.ndarray]]:
    import h5py

    with h5py.File(source, "r") as file:
        yield from _members(file, "", 0)


def _members(group: Any, prefix: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    import h5py

    for name in group:
        # Soft and external links lead elsewhere, external ones to other files; MATLAB writes neither.
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Group):
            if depth < _MAX_DEPTH:
                yield from _members(item, f"{prefix}{name}.", depth + 1)
        elif isinstance(item, h5py.Dataset) and _is_numbers(item):
            if item.external or item.is_virtual:
                raise DataError(f"variable `{prefix}{name}` lies in another file; softneck reads what is in this one.")
            if item.size is not None and item.size > _MAX_NUMBERS:
                raise DataError(f"variable `{prefix}{name}` declares {item.size} numbers; that is not a log.")
            # MATLAB stores columns first: the file's shape is the transpose.
            yield f"{prefix}{name}", np.asarray(item[()], dtype=np.float64).T


def _is_numbers(item: Any) -> bool:
    kind = item.attrs.get("MATLAB_class", b"double")
    return item.dtype.kind in "biuf" and kind != b"char" and "MATLAB_empty" not in item.attrs
