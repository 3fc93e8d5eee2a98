"""Tables that are no row for each sample: long form, wider than long, cells of lists or with units."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

# Long form: at most so many names, each at least so often.
_MAX_NAMES, _MIN_ROWS = 60, 5
# A table of so many times more columns than rows has its signals in rows.
_WIDE = 4
_UNIT_CELL = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\d\s.,;:+-][^\d\s]{0,9})")
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:([,.' ])\d{3})(?:\1\d{3})*(?:(?!\1)[.,]\d+)?")
_LIST = re.compile(r"\s*[\[(].*[\])]\s*")
_MAX_ITEMS = 64


@dataclass(frozen=True, slots=True, eq=False)
class Reshaped:
    """A table with a row for each sample.

    `frame`: the table. `lines`: what was done. `units`: column -> unit in its cells. `doubt`: what may be wrong, "".
    """

    frame: pd.DataFrame
    lines: tuple[str, ...] = ()
    units: tuple[tuple[str | int, str], ...] = ()
    doubt: str = ""


def reshaped(frame: pd.DataFrame) -> Reshaped:
    """Return `frame` with a row for each sample and numbers in its cells, as far as its content tells."""
    lines: list[str] = []
    doubt = ""
    if len(frame) >= 2 and frame.shape[1] > max(_WIDE * len(frame), 20):
        frame = _transposed(frame)
        doubt = f"the table was wider than long ({frame.shape[1]} x {len(frame)}): its rows were taken as columns"
        lines.append(f"file: transposed: {doubt}")
    elif (names := _long_form(frame)) is not None:
        time, name, value = names
        count = frame[name].nunique()
        lines.append(f"file: long form: {count} signals by the names in column '{name}', pivoted")
        order = list(dict.fromkeys(frame[name]))
        table = frame.pivot_table(index=time, columns=name, values=value, sort=True, aggfunc="first")[order]
        frame = table.reset_index().rename_axis(columns=None)
    frame, listed = _without_lists(frame)
    lines += listed
    frame, units, cleaned = _plain_numbers(frame)
    return Reshaped(frame, (*lines, *cleaned), units, doubt)


def _transposed(frame: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    turned = frame.T.reset_index(drop=True)
    if frame.iloc[:, 0].map(lambda cell: isinstance(cell, str)).all():
        turned.columns = [str(cell) for cell in frame.iloc[:, 0]]
        turned = turned.iloc[1:].reset_index(drop=True)
    numbers = [pd.Series(pd.to_numeric(turned.iloc[:, j], errors="coerce")) for j in range(turned.shape[1])]
    return pd.DataFrame(dict(zip(turned.columns, numbers, strict=True)))


def _long_form(frame: pd.DataFrame) -> tuple[str, str, str] | None:
    """Return the columns of time, name and value of a table in long form; None for another."""
    if not 3 <= frame.shape[1] <= 4 or not all(isinstance(name, str) for name in frame.columns):
        return None
    words = [name for name in frame.columns if frame[name].dtype.kind == "O"]
    numbers = [name for name in frame.columns if frame[name].dtype.kind in "iuf"]
    if len(words) != 1 or len(numbers) < 2:
        return None
    counts = frame[words[0]].value_counts()
    if not 2 <= len(counts) <= _MAX_NAMES or counts.min() < _MIN_ROWS:
        return None
    within = frame.groupby(words[0], sort=False)
    rising = [name for name in numbers if all((np.diff(part[name]) > 0).all() for _, part in within)]
    values = [name for name in numbers if name not in rising]
    return (rising[0], words[0], values[0]) if len(rising) == 1 and len(values) == 1 else None


def _without_lists(frame: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Give each item of lists such as `[0.1, 0.2]` a column of its own."""
    import pandas as pd

    parts, lines = [], []
    for place, name in enumerate(frame.columns):
        column = frame.iloc[:, place]
        cells = column.dropna()
        if column.dtype.kind != "O" or not len(cells) or not cells.map(_is_list).all():
            parts.append(column)
            continue
        rows = [_items(cell) for cell in column]
        width = min(max(map(len, rows)), _MAX_ITEMS)
        table = pd.DataFrame([(row + [np.nan] * width)[:width] for row in rows], index=frame.index)
        table.columns = [f"{name}[{j}]" for j in range(width)]
        parts.append(table)
        lines.append(f"file: column '{name}' holds lists: its {width} items are columns")
    return (pd.concat(parts, axis=1) if lines else frame), lines


def _is_list(cell: object) -> bool:
    return isinstance(cell, str) and _LIST.fullmatch(cell) is not None and bool(_items(cell))


def _items(cell: object) -> list[float]:
    """Return the numbers of a list, between commas or, as numpy prints it, blanks; none if there is another item."""
    inner = re.split(r"[,\s]+", str(cell).strip().strip("[]()").strip())
    try:
        return [float(item) for item in inner if item]
    except ValueError:
        return []


def _plain_numbers(frame: pd.DataFrame) -> tuple[pd.DataFrame, tuple[tuple[str | int, str], ...], list[str]]:
    """Return a table whose cells `1.2 rad` and `1,234.5` are numbers, the units in cells, and lines."""
    import pandas as pd

    changed: dict[int, pd.Series] = {}
    units: list[tuple[str | int, str]] = []
    lines: list[str] = []
    for place, name in enumerate(frame.columns):
        column = frame.iloc[:, place]
        cells = column.dropna().astype(str).str.strip() if column.dtype.kind == "O" else None
        if cells is None or not len(cells):
            continue
        with_units = cells.str.extract(_UNIT_CELL.pattern)[1] if cells.str.fullmatch(_UNIT_CELL.pattern).all() else None
        if with_units is not None and with_units.nunique() == 1:
            units.append((name, str(with_units.iloc[0])))
            changed[place] = column.astype(str).str.extract(_UNIT_CELL.pattern)[0].astype(float)
            lines.append(f"file: cells of column '{name}' hold the unit {with_units.iloc[0]}")
        elif (grouped := _grouping(cells)) is not None:
            mark, decimal = grouped
            text = (
                column.astype(str).str.strip().str.replace(mark, "", regex=False).str.replace(decimal, ".", regex=False)
            )
            changed[place] = pd.Series(pd.to_numeric(text, errors="coerce"))
            lines.append(f"file: `{mark}` separates thousands in column '{name}'")
    if not changed:
        return frame, (), []
    parts = [changed[place] if place in changed else frame.iloc[:, place] for place in range(frame.shape[1])]
    table = pd.concat(parts, axis=1)
    table.columns = frame.columns
    return table, tuple(units), lines


def _grouping(cells: pd.Series) -> tuple[str, str] | None:
    """Return the mark of thousands and the decimal mark of cells that have both, or two groups; None for others."""
    marks = {match[1] for cell in cells if (match := _GROUPED.fullmatch(cell)) and _is_sure(cell, match[1])}
    if len(marks) != 1:
        return None
    mark = marks.pop()
    decimal = "." if mark != "." else ","
    plain = cells.str.replace(mark, "", regex=False).str.replace(decimal, ".", regex=False)
    return (mark, decimal) if plain.str.fullmatch(r"[+-]?\d*\.?\d+(?:[eE][+-]?\d+)?").all() else None


def _is_sure(cell: str, mark: str) -> bool:
    """Return whether `mark` cannot be a decimal mark: it occurs twice, is a blank, or another mark follows."""
    return cell.count(mark) > 1 or mark in " '" or any(other in cell for other in ".," if other != mark)
