"""Logs whose content alone says how to read them: LabVIEW's measurement files, and JSON objects or lines."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, FileFormatError, error_reason, require_numbers

if TYPE_CHECKING:
    import pandas as pd

# Ends the header of a `.lvm` file and that of each segment.
_END_OF_HEADER = "***End_of_Header***"
# A list in a cell with more items is no set of signals.
_MAX_ITEMS = 64


def labview_table(source: Path, encoding: str) -> pd.DataFrame:
    """Return the table of a LabVIEW measurement file (NI, "Specification for the LabVIEW Measurement File").

    Several segments follow each other, `run` numbers them. Without a column of times, `X_Value` counts samples by the
    header's Delta_X.
    """
    import pandas as pd

    lines = source.read_text(encoding=encoding, errors="replace").splitlines()
    head, at = _labview_header(lines, 0)
    separator = "," if head.get("Separator", "Tab").strip().lower() == "comma" else "\t"
    decimal = head.get("Decimal_Separator", ".").strip() or "."
    tables: list[pd.DataFrame] = []
    while at < len(lines):
        part, at = _labview_header(lines, at, separator)
        rows: list[list[str]] = []
        while at < len(lines) and not lines[at].startswith("Channels" + separator):
            if lines[at].strip():
                rows.append(lines[at].split(separator))
            at += 1
        if len(rows) > 1:
            tables.append(_labview_segment(rows, part, decimal))
    if not tables:
        raise FileFormatError(f"{source}: is a LabVIEW measurement file without rows of numbers; record again.")
    if len(tables) == 1:
        return tables[0]
    return pd.concat([one.assign(run=number) for number, one in enumerate(tables)], ignore_index=True)


def _labview_header(lines: Sequence[str], at: int, separator: str = "\t") -> tuple[dict[str, str], int]:
    """Return key -> text of a header, and the line behind it."""
    found: dict[str, str] = {}
    for place in range(at, len(lines)):
        if lines[place].strip() == _END_OF_HEADER:
            return found, place + 1
        key, _, value = lines[place].partition(separator if separator in lines[place] else "\t")
        found[key.strip()] = value
    return found, len(lines)


def _labview_segment(rows: list[list[str]], head: dict[str, str], decimal: str) -> pd.DataFrame:
    import pandas as pd

    titles, *body = rows
    width = len([title for title in titles if title.strip() and title.strip() != "Comment"])
    cells = [[cell.strip().replace(decimal, ".") for cell in row[:width]] for row in body]
    cells = [row + [""] * (width - len(row)) for row in cells]
    names = [title.strip() for title in titles[:width]]
    columns: dict[str, np.ndarray] = {
        name: np.asarray(pd.to_numeric(pd.Series([row[j] for row in cells]), errors="coerce"), dtype=np.float64)
        for j, name in enumerate(names)
    }
    step = next((text.split()[0].replace(decimal, ".") for key, text in head.items() if key == "Delta_X" and text), "")
    first = columns.get("X_Value")
    if first is None or np.isnan(first).all():
        if not step:
            raise DataError("the LabVIEW file has neither times nor Delta_X; write its time column.")
        columns["X_Value"] = np.arange(len(cells), dtype=np.float64) * float(step)
    # LabVIEW calls the time X_Value.
    return pd.DataFrame({"time [s]": columns.pop("X_Value"), **columns})


def json_table(source: Path, encoding: str) -> pd.DataFrame:
    """Return the table of JSON lines, of a list of objects, or of an object of lists; nested names get a dot."""
    import pandas as pd

    text = source.read_text(encoding=encoding)
    try:
        objects = list(_json_objects(text))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: is no valid JSON ({error_reason(error)}).") from error
    if len(objects) == 1 and isinstance(objects[0], dict) and all(isinstance(v, list) for v in objects[0].values()):
        columns = objects[0]
        if len({len(values) for values in columns.values()}) > 1:
            raise DataError(f"{source}: the lists of its JSON object differ in length.")
        objects = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    elif len(objects) == 1 and isinstance(objects[0], list):
        objects = objects[0]
    if not objects or not all(isinstance(one, dict) for one in objects):
        raise FileFormatError(f"{source}: holds JSON, but no objects with one value for each signal.")
    rows = [dict(_flat(one, "")) for one in objects]
    require_numbers(source, len(rows), max(map(len, rows)))
    return pd.DataFrame(rows)


def _json_objects(text: str) -> Iterator[Any]:
    """Yield the values of a text: one, or one in each line."""
    try:
        yield json.loads(text)
    except ValueError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2:
            raise
        for number, line in enumerate(lines, start=1):
            try:
                yield json.loads(line)
            except ValueError as error:
                if number == len(lines):  # a logger that was killed leaves half a line
                    return
                raise ValueError(f"line {number}: {error_reason(error)}") from error


def _flat(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for number, item in enumerate(value[:_MAX_ITEMS]):
            yield from _flat(item, f"{name}[{number}]")
    else:
        yield name, value
