"""MATLAB files as tables: v5, and v7.3 (HDF5) through h5py; numbers only, no code, no other files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, FileFormatError

from ._mat5 import read_mat5

if TYPE_CHECKING:
    import pandas as pd


# Structures of logs are one or two deep; deeper ones are loops or hostile.
_MAX_DEPTH = 4
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
