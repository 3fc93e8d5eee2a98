"""Spreadsheets (.xlsx, .xls, .xlsb, .ods) as rows of cells, by python-calamine.

It reads all four formats in one wheel without dependencies; openpyxl reads only .xlsx.
"""

from __future__ import annotations

import datetime
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import DataError, FileFormatError, error_reason, require_package

if TYPE_CHECKING:
    import pandas as pd

# A sheet of Excel has 1,048,576 rows.
_MOST_CELLS = 50_000_000
# Two cells in opposite corners make the reader allocate all cells between, and the process dies without memory. So a
# child process reads the file first, with 128 MB and more for larger files.
_TRIAL_SCRIPT = """
import resource, sys
import python_calamine
resource.setrlimit(resource.RLIMIT_DATA, (int(sys.argv[2]),) * 2)
book = python_calamine.CalamineWorkbook.from_path(sys.argv[1])
for name in book.sheet_names:
    book.get_sheet_by_name(name)
"""
_LEAST_ROOM, _MOST_ROOM, _ROOM_PER_BYTE, _PATIENCE_S = 2**27, 2**31, 200, 120.0
Cells = Sequence[Sequence[object]]


def sheet_cells(source: Path, sheet: str | None) -> tuple[str, Cells]:
    """Return a sheet's name and its rows of cells; the largest sheet without a name."""
    require_package("python_calamine")
    import python_calamine as calamine

    _try(source)
    try:
        book = calamine.CalamineWorkbook.from_path(source)
        names = list(book.sheet_names)
        if sheet is not None and sheet not in names:
            raise DataError(f"{source}: there is no sheet `{sheet}`; it has {', '.join(names)}.")
        sheets = [book.get_sheet_by_name(name) for name in ([sheet] if sheet is not None else names)]
        found = max(sheets, key=lambda one: one.total_height * one.total_width, default=None)
        if found is None or found.total_height * found.total_width == 0:
            raise DataError(f"{source}: its sheets hold no cell ({', '.join(names)}).")
        if found.total_height * found.total_width > _MOST_CELLS:
            raise DataError(f"{source}: sheet `{found.name}` declares {found.total_height} rows; that is not a log.")
        return found.name, found.to_python(skip_empty_area=False)
    except DataError:
        raise
    except Exception as error:  # readers raise anything for damaged bytes
        raise FileFormatError(f"{source}: cannot be read as a spreadsheet ({error_reason(error)}).") from error


def _try(source: Path) -> None:
    """Raise FileFormatError if reading a spreadsheet kills the process."""
    most = min(_MOST_ROOM, _LEAST_ROOM + _ROOM_PER_BYTE * source.stat().st_size)
    arguments = [sys.executable, "-c", _TRIAL_SCRIPT, str(source.resolve()), str(most)]
    try:
        done = subprocess.run(arguments, capture_output=True, timeout=_PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        raise FileFormatError(f"{source}: takes longer than {_PATIENCE_S:g} s to read; export it as CSV.") from None
    # The reader's own exceptions give exit code 1; they are reported by the real reading.
    if done.returncode < 0 or b"MemoryError" in done.stderr:
        raise FileFormatError(
            f"{source}: its sheets would fill {most / 1e6:.0f} MB of memory, which no log of its size does; "
            "export the table as CSV."
        )


def sheet_table(cells: Cells, *, header: bool, skip: int, unit_row: bool) -> pd.DataFrame:
    """Return the table after `skip` rows, with names in its first row or columns 0, 1, ..."""
    import pandas as pd

    rows = cells[skip:]
    names: list[object] = list(range(len(rows[0]) if rows else 0))
    if header and rows:
        names = [str(cell).strip() or f"Unnamed: {place}" for place, cell in enumerate(rows[0])]
        rows = rows[1 + unit_row :]
    # An empty cell is an empty text; all rows have the same width.
    frame = pd.DataFrame([[None if cell == "" else cell for cell in row] for row in rows], dtype=object)
    frame = frame.dropna(how="all").reset_index(drop=True)
    found = pd.DataFrame({place: _column(pd.Series(frame[place])) for place in frame.columns})
    found.columns = names[: found.shape[1]]
    return found


def _column(cells: pd.Series) -> pd.Series:
    """Return a column as numbers, dates or words, by the types of its cells."""
    import pandas as pd

    kinds = {type(cell) for cell in cells.dropna()}
    if kinds <= {int, float, bool}:
        return cells.astype("float64")
    if kinds <= {datetime.datetime, datetime.date}:
        return pd.to_datetime(cells)
    return cells
