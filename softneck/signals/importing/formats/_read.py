"""Any logger's file as a table, by what it is and how a layout says it is read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import DataError

from ...recording._files import TextForm, read_table
from ._arrays import table_of
from ._encodings import format_of
from ._mat import mat_arrays
from ._mcap import mcap_table
from ._sheets import sheet_cells, sheet_table

if TYPE_CHECKING:
    import pandas as pd


def read_foreign(
    source: Path, form: TextForm, *, variable: str | None = None, sheet: str | None = None, wanted: tuple[str, ...] = ()
) -> pd.DataFrame:
    """Return the table of a log.

    Args:
        source: the file.
        form: how a text, or a sheet, is a table.
        variable: the matrix of a MATLAB file; None takes its vectors.
        sheet: of a spreadsheet; None takes the largest.
        wanted: the columns that are needed, by which vectors of another length are told.

    Raises:
        FileFormatError: no such file or no table.
        DataError: no such variable or sheet.
    """
    kind = format_of(source)
    if variable is not None and kind != "mat":
        raise DataError(f"{source}: the layout's `variable` is for a `.mat` file.")
    if sheet is not None and kind != "sheet":
        raise DataError(f"{source}: the layout's `sheet` is for a spreadsheet.")
    if kind == "mat":
        return table_of(source, mat_arrays(source), variable, wanted)
    if kind == "mcap":
        return mcap_table(source)
    if kind == "sheet":
        _, cells = sheet_cells(source, sheet)
        return sheet_table(cells, header=form.header, skip=form.skip, unit_row=form.unit_row)
    frame = without_remarks(read_table(source, ".parquet" if kind == "parquet" else ".csv", form))
    frame.columns = [name.strip() if isinstance(name, str) else name for name in frame.columns]
    return frame


def without_remarks(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table without the lines that a logger or its operator put between its rows: `# paused`, `% mark 2`."""
    if not frame.shape[1] or frame.iloc[:, 0].dtype.kind != "O":
        return frame
    remark = frame.iloc[:, 0].astype(str).str.lstrip().str.startswith(("#", "%"))
    return frame.loc[~remark].reset_index(drop=True) if remark.any() else frame
