"""Named arrays of a MATLAB file as one table of columns."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError

if TYPE_CHECKING:
    import pandas as pd

Arrays = dict[str, np.ndarray]
#: The column that numbers the elements of a cell, or of an array of structures, from which a table was made.
RUN = "run"
_ELEMENT = re.compile(r"\{(\d+)\}")
# More columns beside a vector are a picture or a map, not signals.
_WIDEST = 16


def table_of(source: Path, arrays: Arrays, variable: str | None, wanted: tuple[str, ...] = ()) -> pd.DataFrame:
    """Return the table of a file's arrays.

    Args:
        source: the file, for errors.
        arrays: name -> (rows, columns).
        variable: a matrix (time, columns), whose columns get the numbers 0, 1, ...; None takes all vectors by their
            names, and matrices beside them (time, n) as `name(:,1)` to `name(:,n)`. What cells of structures hold,
            one experiment in each, is joined below each other with the column `run`.
        wanted: the columns that are needed; vectors of another length are left out.

    Raises:
        DataError: the variable is not there or is not a matrix of numbers, or vectors differ in length.
    """
    import pandas as pd

    if variable is not None:
        if variable not in arrays:
            raise DataError(f"{source}: there is no variable `{variable}` with numbers; the file has {listed(arrays)}.")
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
    """Return what each element of a cell or of an array of structures holds, if there are several that hold vectors."""
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
            f"{source}: has no vectors of numbers; name the matrix by `[file] variable`; it has {listed(arrays)}."
        )
    lengths = {name: vectors[name].size for name in wanted if name in vectors}
    if len(set(lengths.values())) > 1:
        named = ", ".join(f"{name} ({size})" for name, size in lengths.items())
        raise DataError(f"{source}: the layout's variables differ in length: {named}; cut them to one length.")
    rows = next(iter(lengths.values()), usual_length(arrays))
    found = {name: vector for name, vector in vectors.items() if vector.size == rows}
    for name, array in arrays.items():
        if 1 not in array.shape and rows in array.shape and min(array.shape) <= _WIDEST:
            by_time = array if array.shape[0] == rows else array.T
            found |= {f"{_ELEMENT.sub('', name)}(:,{j + 1})": by_time[:, j] for j in range(by_time.shape[1])}
    return found


def usual_length(arrays: Arrays) -> int:
    """Return the length that most columns have, of vectors and of matrices beside them; 0 without vectors."""
    sizes = Counter(array.size for array in arrays.values() if 1 in array.shape and array.size > 1)
    for array in arrays.values():
        for size in set(array.shape) if 1 not in array.shape and min(array.shape) <= _WIDEST else ():
            if size in sizes:
                sizes[size] += array.size // size
    return sizes.most_common(1)[0][0] if sizes else 0


def listed(arrays: Arrays) -> str:
    """Return all arrays with their sizes, for a message."""
    return ", ".join(f"{name} ({a.shape[0]} x {a.shape[1]})" for name, a in arrays.items()) or "none"
