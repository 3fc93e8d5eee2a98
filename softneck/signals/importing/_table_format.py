"""Format of a log's table: encoding, delimiter, decimal mark, header, sheet, and matrix of a MAT file."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, FileFormatError, Vector

from ..recording._files import WHITESPACE, read_table
from ._clocks import last_values
from ._column_titles import Title, read_title
from ._layout import Column, Layout
from .formats._mat import mat_arrays, table_of
from .formats._mcap import mcap_table
from .formats._records import json_table, labview_table
from .formats._shapes import reshaped
from .formats._sheets import sheet_cells, sheet_table
from .formats._text import encoding_of, format_of, is_date, seconds

if TYPE_CHECKING:
    import pandas as pd


# Enough lines to detect a format.
_HEAD_BYTES = 2**16
_HEAD_ROWS = 500
# Of fewer rows nothing can be guessed, not even a clock.
_FEWEST_ROWS = 2
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d+")
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
# Three motors and an angle; a recording of a neck has five channels and a time.
MIN_COLUMNS = 4
# Time, name and value of a table in long form.
_LONG_COLUMNS = 3
_NAMES = {"\t": "a tab", ";": "`;`", ",": "`,`", WHITESPACE: "blanks"}
# Share of complete rows below which rows are messages of several clocks.
_WHOLE_ROWS = 0.5

Form = tuple["pd.DataFrame", Layout, tuple[str, ...], list[str]]


@dataclass(frozen=True, slots=True, eq=False)
class SniffResult:
    """A log's columns and the detected format.

    `columns`: name, or index without a header -> (time,) numbers; NaN for empty cells. Dates are seconds; with several
    clocks each column holds its last value. `words`: columns without numbers. `form`: a layout without channels: the
    format of the file; `merge` if rows may be of several clocks. `units`: column -> unit in a line of units, if there
    is one. `dates`: columns of dates or times of day. `doubt`: what may be wrong about rows and columns, "".
    """

    columns: dict[Column, Vector]
    words: tuple[Column, ...]
    form: Layout
    lines: tuple[str, ...]
    units: dict[Column, str]
    dates: frozenset[Column]
    frame: pd.DataFrame
    doubt: str = ""

    def title(self, column: Column) -> Title:
        """Return the meaning of a column's title, with the unit of a line of units."""
        unit = self.units.get(column)
        return read_title(str(column) if unit is None else f"{column} [{unit}]")

    def lacks(self, column: Column) -> bool:
        """Return whether a column has empty cells."""
        cells = self.frame[column] if isinstance(column, str) else self.frame.iloc[:, column]
        return bool(cells.isna().any())


def sniff(path: str | Path, *, fewest: int = MIN_COLUMNS) -> SniffResult:
    """Detect the format of a log and read it; a recording of its robot needs at least `fewest` columns."""
    source = Path(path)
    raw, form, lines, units = _form(source, fewest)
    named = {name: unit for name, unit in zip(raw.columns, units, strict=False) if unit}
    shape = reshaped(raw)
    frame, lines = shape.frame, (*lines, *shape.lines)
    named |= dict(shape.units)
    columns: dict[Column, Vector] = {}
    words: list[Column] = []
    dates: set[Column] = set()
    for place, name in enumerate(frame.columns):
        # A repeated name needs the index.
        key = name if isinstance(name, str) and list(frame.columns).count(name) == 1 else place
        values = _numbers(frame.iloc[:, place])
        if values is None and (values := _seconds(frame.iloc[:, place])) is not None:
            dates.add(key)
        if values is None:
            words.append(key)
        else:
            columns[key] = values
    if len(columns) < fewest and len(frame):
        raise DataError(
            f"{source}: has {len(columns)} column(s) of numbers; a recording needs one for each set-point and output. "
            "Is this a log? If so, write its delimiter into a layout and use --layout."
        )
    if len(frame) < _FEWEST_ROWS:
        raise DataError(f"{source}: has {len(frame)} row(s) of numbers; a log has one for each sample.")
    if form.merge or _is_sparse(columns):
        form = replace(form, merge=True)
        columns = {name: last_values(values) for name, values in columns.items()}
    return SniffResult(columns, tuple(words), form, lines, named, frozenset(dates), frame, shape.doubt)


def _form(source: Path, fewest: int) -> Form:
    """Return a log's table, its format, reasons, and the cells of its line of units."""
    kind = format_of(source)
    if kind == "mat":
        return (*_arrays(source, fewest), [])
    if kind == "parquet":
        form = Layout(channels={})
        return read_table(source, ".parquet", form.form), form, (), []
    if kind == "mcap":
        line = "file: MCAP: a row for each message, of the topics that hold numbers"
        return mcap_table(source), Layout(channels={}, merge=True), (line,), []
    if kind == "sheet":
        return _sheet(source)
    if kind in WITHIN:
        encoding, said = encoding_of(source)
        lines = (f"file: {WITHIN[kind]}", *([] if said is None else [f"file: {said}"]))
        return self_described_table(source, kind, encoding), Layout(channels={}, encoding=encoding), lines, []
    form, lines, units = _text_form(source, fewest)
    whole = read_table(source, ".csv", form.form)
    frame = without_remarks(whole)
    if len(frame) < len(whole):
        lines = (*lines, f"file: {len(whole) - len(frame)} line(s) of remarks between the rows are left out")
    if form.header:
        frame.columns = [str(name).strip() for name in frame.columns]
    return frame, form, lines, units


#: Formats whose content says how to read them.
WITHIN = {"labview": "a LabVIEW measurement file", "json": "JSON: a row for each object"}


def self_described_table(source: Path, kind: str, encoding: str) -> pd.DataFrame:
    """Return the table of a file in one of the formats of `WITHIN`."""
    return labview_table(source, encoding) if kind == "labview" else json_table(source, encoding)


def without_remarks(frame: pd.DataFrame) -> pd.DataFrame:
    """Drop comment lines between the rows, such as `# paused` or `% mark 2`."""
    if not frame.shape[1] or frame.iloc[:, 0].dtype.kind != "O":
        return frame
    remark = frame.iloc[:, 0].astype(str).str.lstrip().str.startswith(("#", "%"))
    return frame.loc[~remark].reset_index(drop=True) if remark.any() else frame


def _is_sparse(columns: dict[Column, Vector]) -> bool:
    """Return whether rows are messages of several clocks: few are complete, and different cells are empty."""
    absent = [np.isnan(values) for values in columns.values()]
    patterns = {gaps.tobytes() for gaps in absent if gaps.mean() > 0.2}
    return len(patterns) > 1 and float(np.any(absent, axis=0).mean()) > 1.0 - _WHOLE_ROWS


def _seconds(column: pd.Series) -> Vector | None:
    """Return a column of dates as seconds, or None for another column."""
    cells = column.head(_HEAD_ROWS)
    if column.dtype.kind != "M" and not (cells.size and all(map(is_date, cells))):
        return None
    try:
        return seconds(column, str(column.name))
    except DataError:
        return None


def _numbers(column: pd.Series) -> Vector | None:
    """Return a column's numbers, or None for words, dates or lists."""
    import pandas as pd

    if column.dtype.kind in "biuf":
        return column.to_numpy(dtype=np.float64)
    if column.dtype.kind in "mMc":
        return None
    try:
        values = np.asarray(pd.to_numeric(column, errors="coerce"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    absent = column.isna() | column.astype(str).str.strip().str.lower().eq("nan")
    fill_gaps = ~np.isnan(values) | absent.to_numpy()
    # The importer reports single words in a column of numbers, with their row.
    return values if values.size and fill_gaps.mean() > 0.5 and np.isfinite(values).any() else None


def _arrays(source: Path, fewest: int) -> tuple[pd.DataFrame, Layout, tuple[str, ...]]:
    arrays = mat_arrays(source)
    try:
        beside = table_of(source, arrays, None)
    except DataError:
        beside = None
    matrices = {name: array for name, array in arrays.items() if min(array.shape) >= fewest}
    if beside is not None and (len(beside.columns) >= fewest or not matrices):
        line = f"file: {len(beside.columns)} columns of {len(beside)} numbers, vectors and matrices by their names"
        return beside, Layout(channels={}), (line,)
    if not matrices:
        return table_of(source, arrays, None), Layout(channels={}), ()  # which raises the error
    name = max(matrices, key=lambda key: matrices[key].size)
    line = f"file: the matrix '{name}', because it is the largest one ({' x '.join(map(str, matrices[name].shape))})"
    return table_of(source, arrays, name), Layout(channels={}, variable=name, header=False), (line,)


def _sheet(source: Path) -> Form:
    sheet, cells = sheet_cells(source, None)
    rows = [[str(cell).strip() for cell in row] for row in cells[:_HEAD_ROWS]]
    fill_gaps = [sum(bool(cell) for cell in row) for row in rows]
    usual = Counter(count for count in fill_gaps if count > 1).most_common(1)
    if not usual:
        raise FileFormatError(f"{source}: cannot be read as a table (no row of sheet `{sheet}` has two cells).")
    skip = next(place for place, count in enumerate(fill_gaps) if count >= usual[0][0])
    header = any(cell and not _NUMBER.fullmatch(cell) and not is_date(cell) for cell in rows[skip])
    units = _unit_row(rows[skip + 1 : skip + 3]) if header else []
    form = Layout(channels={}, sheet=sheet, header=header, skip=skip, unit_row=bool(units))
    line = f"file: sheet '{sheet}', because it is the only one or the largest"
    frame = sheet_table(cells, header=header, skip=skip, unit_row=bool(units))
    return frame, form, (line, *_remarks(form)), units


def _text_form(source: Path, fewest: int) -> tuple[Layout, tuple[str, ...], list[str]]:
    """Return the format of a text table, reasons, and the cells of its line of units."""
    encoding, said = encoding_of(source)
    with source.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    raw = head.decode("utf-8-sig" if encoding == "utf-8" else encoding, errors="replace").splitlines()
    if len(head) == _HEAD_BYTES:
        raw = raw[:-1]
    lines = [line for line in raw if line.strip()]
    if not lines:
        raise FileFormatError(f"{source}: cannot be read as a table (it is empty).")
    delimiter, cells = _delimiter(lines, fewest)
    # Comments before the table have another number of cells.
    skip = next((place for place, line in enumerate(raw) if len(_cells(line, delimiter)) == cells), 0)
    lines = [line for line in raw[skip:] if line.strip()]
    body = [cell.strip() for line in lines[1:] for cell in _cells(line, delimiter)]
    comma = delimiter != "," and any(map(_COMMA_NUMBER.fullmatch, body)) and not any(
        "." in cell for cell in body if not is_date(cell) and not _THOUSANDS.fullmatch(cell)
    )  # fmt: skip
    first = [cell.strip().replace(",", ".") if comma else cell.strip() for cell in _cells(lines[0], delimiter)]
    header = any(cell and not _NUMBER.fullmatch(cell) and not is_date(cell) for cell in first)
    why = f"file: cells are separated by {_NAMES[delimiter]}, because that splits all lines into equally many"
    below = [[cell.strip() for cell in _cells(line, delimiter)] for line in raw[skip + 1 : skip + 3]]
    units = _unit_row(below) if header else []
    form = Layout(
        channels={},
        header=header,
        delimiter=delimiter,
        decimal="," if comma else ".",
        skip=skip,
        unit_row=bool(units),
        encoding=encoding,
    )
    return form, (why, *([] if said is None else [f"file: {said}"]), *_remarks(form)), units


def _remarks(form: Layout) -> list[str]:
    second = (
        "the first line holds words: names" if form.header else "no header line, because the first line holds numbers"
    )
    return [
        *([f"file: the first {form.skip} line(s) are not part of the table"] if form.skip else []),
        f"file: {second}",
        *(["file: the line below the names holds units"] if form.unit_row else []),
        *(["file: decimal commas"] if form.decimal == "," else []),
    ]


def _unit_row(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return the cells of the row below the names, without brackets, if it holds units and the next row numbers."""
    if len(lines) < 2:
        return []
    cells = [cell.strip("[]()").strip() for cell in lines[0]]
    below = [cell.replace(",", ".") for cell in lines[1]]
    words = [cell for cell in cells if cell]
    if not words or any(_NUMBER.fullmatch(cell.replace(",", ".")) or is_date(cell) for cell in words):
        return []
    return cells if sum(bool(_NUMBER.fullmatch(cell)) for cell in below) > len(below) / 2 else []


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == WHITESPACE:
        return line.split()
    if '"' not in line:
        return line.split(delimiter)
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])


def _delimiter(lines: list[str], fewest: int) -> tuple[str, int]:
    """Return the delimiter that splits nearly all lines into equally many cells, and their number.

    The comma comes late, since it may be a decimal mark.
    """
    for least in (fewest, min(fewest, _LONG_COLUMNS)):
        for delimiter in ("\t", ";", ",", WHITESPACE):
            counts = Counter(len(_cells(line, delimiter)) for line in lines)
            cells, often = counts.most_common(1)[0]
            if cells >= least and often >= 0.9 * len(lines):
                return delimiter, cells
    return ",", len(_cells(lines[0], ","))
