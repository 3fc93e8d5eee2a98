"""Recordings as softneck writes them, read without pandas, whose import takes longer than the reading."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from softneck.core import Vector

# All that a table of numbers is made of; a file with anything else is left to pandas.
_CHARACTERS = "0123456789+-.eE,\n"
# Beyond this pandas is faster, import included.
_LARGEST = 20_000_000


def read_plain_csv(source: Path) -> dict[str, Vector] | None:
    """Return title -> column of a CSV file of plain numbers, an empty cell as NaN; None where it is anything else.

    The numbers are those that pandas reads: both round a decimal to the nearest double.
    """
    try:
        if source.stat().st_size > _LARGEST:
            return None
        head, _, body = source.read_text(encoding="utf-8").replace("\r\n", "\n").partition("\n")
        if head.startswith("# "):  # whose recording it is
            head, _, body = body.partition("\n")
    except (OSError, UnicodeDecodeError):
        return None
    titles = head.split(",")
    if body.strip(_CHARACTERS) or not all(titles) or len(set(titles)) < len(titles) or '"' in head:
        return None
    rows = [line.split(",") for line in body.split("\n") if line]
    if not rows or any(len(row) != len(titles) for row in rows):
        return None
    try:
        columns = [
            np.array([float(cell) if cell else math.nan for cell in column]) for column in zip(*rows, strict=True)
        ]
    except ValueError:
        return None
    return dict(zip(titles, columns, strict=True))
