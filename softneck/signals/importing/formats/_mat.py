"""Files of arrays: MATLAB v5, v7.3 (HDF5) through h5py, and NumPy; numbers only, no code, no links to other files.

`scipy.io.loadmat` follows nested cells without a limit: 10 MB of them crash the process (segmentation fault).
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    SoftneckError,
    error_reason,
    largest_unpacked,
    open_zip,
    require_package,
)

if TYPE_CHECKING:
    import pandas as pd

# Table 1-1: types of data.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
# Table 1-3: classes of arrays.
_CELL, _STRUCT, _NUMBERS = 1, 2, range(6, 16)
_COMPLEX_FLAG = 0x0800
_HEADER_BYTES = 128
# HDF5 file format, II.A: offsets of the superblock; MATLAB uses 512.
_SIGNATURE, _SUPERBLOCKS = b"\x89HDF\r\n\x1a\n", (0, 512, 1024, 2048)
# Structures of logs have one or two levels; deeper ones are loops or hostile.
_MAX_DEPTH = 4


@dataclass(slots=True)
class _Elements:
    """A sequence of elements in `data`, numbers in byte `order`."""

    data: memoryview
    order: str
    place: int = 0

    def next(self) -> tuple[int, memoryview]:
        """Return the type and the content of the next element."""
        word, size = struct.unpack_from(self.order + "II", self.data, self.place)
        start = self.place + 8
        # A small element has its size in the upper half of its type, and up to 4 bytes instead of the size.
        if word >> 16:
            kind, size, start, self.place = word & 0xFFFF, word >> 16, self.place + 4, start
            if size > 4:
                raise ValueError("a small element holds more than 4 bytes")
        else:
            kind = word
            # Elements are padded to 8 bytes, except compressed ones.
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


def read_mat5(data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name -> real numeric array of a file; structures and cells are opened.

    A field is `structure.field`; an element of a cell or of an array of structures is `name{1}`.
    """
    if len(data) < _HEADER_BYTES or data[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
        raise ValueError("neither version 5 nor 7.3; save it with -v7")
    left = largest_unpacked(len(data))
    file = _Elements(memoryview(data), "<" if data[126:128] == b"IM" else ">", _HEADER_BYTES)
    while file.place + 8 <= len(data):
        kind, content = file.next()
        if kind == _COMPRESSED:
            unpacked = _unpack(content, file.order, left)
            left -= len(unpacked)
            kind, content = _Elements(unpacked, file.order).next()
        if kind == _MATRIX:
            yield from _array(_Elements(content, file.order), None, 0)


def _unpack(content: memoryview, order: str, most: int) -> memoryview:
    stream = zlib.decompressobj()
    head = stream.decompress(content, 8)
    # The declared size; a stream that holds more has not ended after it.
    size = struct.unpack(order + "II", head)[1]
    unpacked = head + stream.decompress(stream.unconsumed_tail, size + 1) if size < most else b""
    if not stream.eof or len(unpacked) > 8 + size:
        raise ValueError("a compressed variable is cut off or too large")
    return memoryview(unpacked)


def _array(parts: _Elements, name: str | None, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays in an element; `name` replaces its own, which is empty within structures."""
    if not len(parts.data):
        return
    flags = int(parts.numbers()[0])
    shape = tuple(int(size) for size in parts.numbers())
    own = parts.text()
    name = own if name is None else name
    kind = flags & 0xFF
    if kind == _CELL and depth < _MAX_DEPTH:
        for place in range(prod(shape)):
            yield from _array(_Elements(_matrix(parts), parts.order), f"{name}{{{place + 1}}}", depth + 1)
    elif kind == _STRUCT and depth < _MAX_DEPTH:
        width = int(parts.numbers()[0])
        names = bytes(parts.next()[1])
        if not 0 < width <= 256:
            raise ValueError(f"the fields of a structure have names of {width} bytes")
        for place in range(prod(shape)):
            element = name if prod(shape) == 1 else f"{name}{{{place + 1}}}"
            for start in range(0, len(names) - width + 1, width):
                field = names[start : start + width].split(b"\0")[0].decode("utf-8", errors="replace")
                yield from _array(_Elements(_matrix(parts), parts.order), f"{element}.{field}", depth + 1)
    elif kind in _NUMBERS and not flags & _COMPLEX_FLAG:
        # Stored by columns, in the smallest type that holds the numbers.
        yield name, parts.numbers().astype(np.float64).reshape(shape, order="F")


def _matrix(parts: _Elements) -> memoryview:
    """Return the next element, which must be an array."""
    kind, content = parts.next()
    if kind != _MATRIX:
        raise ValueError(f"a field of a structure has the type {kind}")
    return content


# Larger cells are no experiments.
_MAX_ELEMENTS = 10_000


def mat_arrays(source: Path) -> dict[str, np.ndarray]:
    """Return name -> array (rows, columns) of all numbers in a MAT file, or in a `.npz` or `.npy` of NumPy."""
    if (found := _numpy_arrays(source)) is not None:
        return found
    try:
        hdf5 = _is_hdf5(source)
        if hdf5:
            require_package("h5py")
        arrays = _hdf5(source) if hdf5 else read_mat5(source.read_bytes())
        found = _by_name(arrays, largest_unpacked(8 * source.stat().st_size))
    except SoftneckError:
        raise
    except Exception as error:  # the parsers raise whatever the damaged bytes lead to
        raise FileFormatError(f"{source}: cannot be read as a MAT file ({error_reason(error)}).") from error
    # An array of HDF5 that MATLAB did not write may have one dimension.
    found = {name: np.atleast_2d(array) for name, array in found.items() if array.size}
    return {name: array for name, array in found.items() if array.ndim == 2}


def _numpy_arrays(source: Path) -> dict[str, np.ndarray] | None:
    """Return the arrays of a `.npz` or `.npy` file as those of a MAT file; None for another file."""
    with source.open("rb") as file:
        start = file.read(6)
    if start != b"\x93NUMPY" and not start.startswith(b"PK"):
        return None
    try:
        if start.startswith(b"PK"):
            open_zip(source).close()
        loaded = np.load(source, allow_pickle=False)
        arrays = {name: loaded[name] for name in loaded.files} if hasattr(loaded, "files") else {"array": loaded}
    except SoftneckError:
        raise
    except Exception as error:  # damaged bytes raise all kinds of errors in zipfile, its decompressors and numpy
        raise FileFormatError(f"{source}: cannot be read as arrays of NumPy ({error_reason(error)}).") from error
    # Of a member that is no array NumPy returns the bytes.
    kept = {name: array for name, array in arrays.items() if isinstance(array, np.ndarray) and array.ndim in (1, 2)}
    kept = {name: array for name, array in kept.items() if array.dtype.kind in "biuf"}
    return {name: np.atleast_2d(array).astype(np.float64) for name, array in kept.items() if array.size}


def _by_name(arrays: Iterator[tuple[str, np.ndarray]], left: int) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for name, array in arrays:
        left -= array.nbytes
        if left < 0:
            raise ValueError("its variables unpack to more than a log of its size holds")
        if name in found:
            raise ValueError(f"the variable `{name}` occurs twice")
        found[name] = array
    return found


def _is_hdf5(source: Path) -> bool:
    with source.open("rb") as file:
        head = file.read(_SUPERBLOCKS[-1] + len(_SIGNATURE))
    return any(head.startswith(_SIGNATURE, at) for at in _SUPERBLOCKS)


def _hdf5(source: Path) -> Iterator[tuple[str, np.ndarray]]:
    import h5py

    with h5py.File(source, "r") as file:
        yield from _members(file, "", 0, set())


def _members(group: Any, prefix: str, depth: int, visited: set[int]) -> Iterator[tuple[str, np.ndarray]]:
    import h5py

    for name in group:
        # Soft and external links lead elsewhere, the latter to other files; MATLAB writes neither.
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        yield from _item(group[name], f"{prefix}{name}", depth, visited)


def _item(item: Any, name: str, depth: int, visited: set[int]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays in a group or dataset; skip `visited` addresses, since references may form cycles."""
    import h5py

    if isinstance(item, h5py.Group):
        if depth < _MAX_DEPTH:
            yield from _members(item, f"{name}.", depth + 1, visited)
    elif isinstance(item, h5py.Dataset) and item.dtype.kind == "O" and item.size is not None and depth < _MAX_DEPTH:
        # Elements of cells and fields of arrays of structures are references.
        references = np.asarray(item[()]) if item.size <= _MAX_ELEMENTS else np.array([])
        for place, reference in enumerate(references.ravel(order="C")):
            if isinstance(reference, h5py.Reference) and reference:
                target = item.file[reference]
                address = h5py.h5o.get_info(target.id).addr  # pyright: ignore[reportAttributeAccessIssue]
                if address not in visited:
                    visited.add(address)
                    yield from _item(target, f"{name}{{{place + 1}}}", depth + 1, visited)
    elif isinstance(item, h5py.Dataset) and _is_numbers(item):
        if item.external or item.is_virtual:
            raise DataError(f"variable `{name}` is in another file; softneck reads what is in this one.")
        if item.size is not None and 8 * item.size > largest_unpacked(8 * item.file.id.get_filesize()):
            raise DataError(f"variable `{name}` declares {item.size} numbers; that is not a log.")
        # MATLAB stores columns first: the file holds the transpose.
        yield name, np.asarray(item[()], dtype=np.float64).T


def _is_numbers(item: Any) -> bool:
    kind = item.attrs.get("MATLAB_class", b"double")
    return item.dtype.kind in "biuf" and kind != b"char" and "MATLAB_empty" not in item.attrs


Arrays = dict[str, np.ndarray]
#: The column that numbers the elements of a cell or of an array of structures.
RUN = "run"
_ELEMENT = re.compile(r"\{(\d+)\}")
# Wider matrices are pictures or maps, not signals.
_MAX_SIGNAL_COLUMNS = 16


def table_of(source: Path, arrays: Arrays, variable: str | None, wanted: tuple[str, ...] = ()) -> pd.DataFrame:
    """Return the table of a file's arrays.

    `arrays`: name -> (rows, columns). `variable`: a matrix (time, columns), whose columns get the numbers 0, 1, ...;
    None takes all vectors by name, and matrices (time, n) as `name(:,1)` to `name(:,n)`. Experiments in elements of a
    cell are concatenated, with the column `run`. `wanted`: the required columns; vectors of another length are dropped.
    """
    import pandas as pd

    if variable is not None:
        if variable not in arrays:
            raise DataError(
                f"{source}: there is no variable `{variable}` with numbers; the file has {list_arrays(arrays)}."
            )
        array = arrays[variable]
        return pd.DataFrame(array.T if array.shape[0] == 1 else array)
    runs = _experiments(arrays)
    if not runs:
        return pd.DataFrame(_columns(source, arrays, wanted))
    tables = []
    for number, content in runs.items():
        frame = pd.DataFrame(_columns(source, content, tuple(name for name in wanted if name != RUN)))
        tables.append(frame.assign(**{RUN: number}))
    shared = [name for name in tables[0].columns if all(name in table.columns for table in tables)]
    return pd.concat([table[shared] for table in tables], ignore_index=True)


def _experiments(arrays: Arrays) -> dict[int, Arrays]:
    """Return number -> arrays of each element of a cell or array of structures, if several hold vectors."""
    runs: dict[int, Arrays] = {}
    for name, array in arrays.items():
        match = _ELEMENT.search(name)
        if match is not None and array.size > 1:
            runs.setdefault(int(match[1]), {})[_ELEMENT.sub("", name, count=1)] = array
    return dict(sorted(runs.items())) if len(runs) > 1 else {}


def _columns(source: Path, arrays: Arrays, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    vectors = {_ELEMENT.sub("", name): a.ravel() for name, a in arrays.items() if 1 in a.shape and a.size > 1}
    if not vectors:
        raise DataError(
            f"{source}: has no vectors of numbers; name the matrix by `[file] variable`; it has {list_arrays(arrays)}."
        )
    lengths = {name: vectors[name].size for name in wanted if name in vectors}
    if len(set(lengths.values())) > 1:
        named = ", ".join(f"{name} ({size})" for name, size in lengths.items())
        raise DataError(f"{source}: the layout's variables differ in length: {named}; cut them to one length.")
    rows = next(iter(lengths.values()), usual_length(arrays))
    found = {name: vector for name, vector in vectors.items() if vector.size == rows}
    for name, array in arrays.items():
        if 1 not in array.shape and rows in array.shape and min(array.shape) <= _MAX_SIGNAL_COLUMNS:
            by_time = array if array.shape[0] == rows else array.T
            found |= {f"{_ELEMENT.sub('', name)}(:,{j + 1})": by_time[:, j] for j in range(by_time.shape[1])}
    return found


def usual_length(arrays: Arrays) -> int:
    """Return the length of most columns, of vectors and matrices; 0 without vectors."""
    sizes = Counter(array.size for array in arrays.values() if 1 in array.shape and array.size > 1)
    for array in arrays.values():
        for size in set(array.shape) if 1 not in array.shape and min(array.shape) <= _MAX_SIGNAL_COLUMNS else ():
            if size in sizes:
                sizes[size] += array.size // size
    return sizes.most_common(1)[0][0] if sizes else 0


def list_arrays(arrays: Arrays) -> str:
    """Return all arrays with their sizes, for a message."""
    return ", ".join(f"{name} ({a.shape[0]} x {a.shape[1]})" for name, a in arrays.items()) or "none"
