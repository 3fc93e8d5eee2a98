"""What kind of table a log is: delimiter, decimal mark, header line, and which matrix of a MAT file."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, FileFormatError, Vector

from ..recording._files import WHITESPACE, TextForm, read_table
from ._layout import Column, Layout
from ._mat import mat_arrays, mat_table

if TYPE_CHECKING:
    import pandas as pd


# Enough lines to tell a format, whatever the size of the log.
_HEAD_BYTES = 2**16
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
# A recording has five channels and a time.
_FEWEST = 5
_NAMES = {"\t": "a tab", ";": "`;`", ",": "`,`", WHITESPACE: "blanks"}


@dataclass(frozen=True, slots=True, eq=False)
class SniffResult:
    """A log's columns and how they were read.

    Attributes:
        columns: name, or index where there is no header -> (time,) numbers; NaN where a cell is empty.
        words: columns that hold no numbers.
        form: a layout without channels that says how to read the file.
        lines: why.
        units: what the line of units says of each column, where there is such a line.
    """

    columns: dict[Column, Vector]
    words: tuple[Column, ...]
    form: Layout
    lines: tuple[str, ...]
    units: dict[Column, str]


def sniff(path: str | Path, *, fewest: int = _FEWEST) -> SniffResult:
    """Read a log of unknown form, of at least `fewest` columns: those that a recording of its robot needs.

    Raises:
        FileFormatError: no such file, or no table.
        DataError: a table of fewer columns than a recording needs.
    """
    source = Path(path)
    if not source.is_file():
        raise FileFormatError(f"{source}: no such file.")
    suffix = source.suffix.lower()
    units: list[str] = []
    if suffix == ".mat":
        frame, form, lines = _mat(source, fewest)
    elif suffix == ".parquet":
        frame, form, lines = read_table(source, suffix, TextForm()), Layout(channels={}), ()
    else:
        form, lines, units = _text_form(source, fewest)
        frame = read_table(source, ".csv", form.form)
        if form.header:
            frame.columns = [str(name).strip() for name in frame.columns]
    columns: dict[Column, Vector] = {}
    words: list[Column] = []
    for place, name in enumerate(frame.columns):
        # Where a name stands twice, only its index tells which.
        key = name if isinstance(name, str) and list(frame.columns).count(name) == 1 else place
        values = _numbers(frame.iloc[:, place])
        if values is None:
            words.append(key)
        else:
            columns[key] = values
    if len(columns) < fewest:
        needed = "three set-points, pitch and roll" if fewest == _FEWEST else "a set-point and an output at least"
        raise DataError(
            f"{source}: has {len(columns)} column(s) of numbers; a recording needs {needed}. "
            "Is this a log? If so, write its delimiter into a layout and use --layout."
        )
    named = {name: unit for name, unit in zip(frame.columns, units, strict=False) if unit}
    return SniffResult(columns, tuple(words), form, lines, named)


def _numbers(column: pd.Series) -> Vector | None:
    """Return a column's numbers, or None where it holds words, dates or lists."""
    import pandas as pd

    if column.dtype.kind in "biuf":
        return column.to_numpy(dtype=np.float64)
    if column.dtype.kind in "mMc":
        return None
    try:
        values = np.asarray(pd.to_numeric(column, errors="coerce"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    filled = ~np.isnan(values) | column.isna().to_numpy()
    # A few words in a column of numbers are for the importer to name, row by row.
    return values if values.size and filled.mean() > 0.5 and np.isfinite(values).any() else None


def _mat(source: Path, fewest: int) -> tuple[pd.DataFrame, Layout, tuple[str, ...]]:
    arrays = mat_arrays(source)
    vectors = [array.size for array in arrays.values() if 1 in array.shape and array.size > 1]
    length, count = Counter(vectors).most_common(1)[0] if vectors else (0, 0)
    matrices = {name: array for name, array in arrays.items() if min(array.shape) >= fewest}
    if count >= fewest or not matrices:
        line = f"file: {count} vectors of {length} numbers by their names"
        return mat_table(source, arrays, None), Layout(channels={}), (line,)
    name = max(matrices, key=lambda key: matrices[key].size)
    line = f"file: the matrix '{name}', because it is the largest one ({' x '.join(map(str, matrices[name].shape))})"
    return mat_table(source, arrays, name), Layout(channels={}, variable=name, header=False), (line,)


def _text_form(source: Path, fewest: int) -> tuple[Layout, tuple[str, ...], list[str]]:
    """Return how a text is a table, why, and the cells of its line of units."""
    with source.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    raw = head.decode("utf-8-sig", errors="replace").splitlines()
    if len(head) == _HEAD_BYTES:
        raw = raw[:-1]
    lines = [line for line in raw if line.strip()]
    if not lines:
        raise FileFormatError(f"{source}: cannot be read as a table (it is empty).")
    delimiter, cells = _delimiter(lines, fewest)
    # A logger's remarks before the table are cut into another number of cells.
    skip = next((place for place, line in enumerate(raw) if len(_cells(line, delimiter)) == cells), 0)
    lines = [line for line in raw[skip:] if line.strip()]
    body = [cell.strip() for line in lines[1:] for cell in _cells(line, delimiter)]
    comma = delimiter != "," and any(map(_COMMA_NUMBER.fullmatch, body)) and not any("." in cell for cell in body)
    first = [cell.strip().replace(",", ".") if comma else cell.strip() for cell in _cells(lines[0], delimiter)]
    header = any(cell and not _NUMBER.fullmatch(cell) for cell in first)
    why = f"file: cells are separated by {_NAMES[delimiter]}, because that splits all lines into equally many"
    second = "the first line holds words: names" if header else "no header line, because the first line holds numbers"
    units = _unit_row(raw[skip + 1 : skip + 3], delimiter) if header else []
    form = Layout(
        channels={},
        header=header,
        delimiter=delimiter,
        decimal="," if comma else ".",
        skip=skip,
        unit_row=bool(units),
    )
    before = (f"file: the first {skip} line(s) are not part of the table",) if skip else ()
    after = [
        *(["file: the line below the names holds units"] if units else []),
        *(["file: decimal commas"] if comma else []),
    ]
    return form, (why, *before, f"file: {second}", *after), units


def _unit_row(lines: list[str], delimiter: str) -> list[str]:
    """Return the cells of the line below the names, without brackets, if it holds no number and the next line does."""
    if len(lines) < 2:
        return []
    cells = [cell.strip().strip("[]()").strip() for cell in _cells(lines[0], delimiter)]
    below = [cell.strip().replace(",", ".") for cell in _cells(lines[1], delimiter)]
    words = [cell for cell in cells if cell]
    if not words or any(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in words):
        return []
    return cells if sum(bool(_NUMBER.fullmatch(cell)) for cell in below) > len(below) / 2 else []


def _cells(line: str, delimiter: str) -> list[str]:
    return line.split() if delimiter == WHITESPACE else [cell.strip('"') for cell in line.split(delimiter)]


def _delimiter(lines: list[str], fewest: int) -> tuple[str, int]:
    """Return what cuts nearly all lines into equally many cells, and how many; a comma may be a decimal mark: late."""
    for delimiter in ("\t", ";", ",", WHITESPACE):
        counts = Counter(len(_cells(line, delimiter)) for line in lines)
        cells, often = counts.most_common(1)[0]
        if cells >= fewest and often >= 0.9 * len(lines):
            return delimiter, cells
    return ",", len(_cells(lines[0], ","))
