"""Dates and times of day as seconds."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, Vector

if TYPE_CHECKING:
    import pandas as pd

# Year first is ISO 8601 and has one reading; the others are tried as they stand, the first of two that fit is taken.
_DAY = r"\d{1,2}"
_CLOCK = r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?(\s?[AaPp][Mm])?"
_ISO = re.compile(rf"\d{{4}}-\d{{2}}-\d{{2}}([T ]+{_CLOCK})?\s?(Z|[+-]\d{{2}}:?\d{{2}})?")
_SPLIT = re.compile(rf"({_DAY})([./-])({_DAY})\2(\d{{4}}|\d{{2}})(,?\s+{_CLOCK})?|{_CLOCK}")
#: The unit of a time column that holds dates or times of day.
DATE = "date"
# [s] A number beyond is the time since 1970 and not since the log began; it is 1973 there.
EPOCH = 1e8


def is_date(cell: object) -> bool:
    """Return whether a cell reads like a date or a time of day."""
    text = str(cell).strip()
    return _ISO.fullmatch(text) is not None or _SPLIT.fullmatch(text) is not None


def seconds(column: pd.Series, name: str) -> Vector:
    """Return (time,) the seconds of dates or times of day from the first of them on.

    Times of day that fall by more than 12 h have passed midnight. Day and month are told apart by a number above 12; a
    log of less than a day is the same in either order.
    """
    import pandas as pd

    if column.dtype.kind == "M":
        moments = pd.DatetimeIndex(column)
    else:
        text = column.astype(str).str.strip().str.replace(r"(\d),(\d)", r"\1.\2", regex=True)
        bad = ~text.map(is_date).to_numpy(dtype=bool)
        if bad.any():
            row = int(np.argmax(bad))
            raise DataError(
                f"column `{name}` holds `{column.iloc[row]}` at row {row} (the first is 0), which is no date."
            )
        moments = _moments(text, name)
    if moments.isna().any():
        row = int(np.argmax(moments.isna()))
        raise DataError(f"column `{name}` holds no date at row {row} (the first is 0).")
    # Whole nanoseconds: seconds since 1970 in a double are off by 1e-7 s.
    ns = np.asarray(moments.as_unit("ns").asi8, dtype=np.int64)
    t = (ns - ns[0]) / 1e9
    if column.dtype.kind != "M" and ":" in str(column.iloc[0])[:3]:
        t = t + 86_400.0 * np.concatenate([[0], np.cumsum(np.diff(t) < -43_200.0)])
    return t


def _moments(text: pd.Series, name: str) -> pd.DatetimeIndex:
    import pandas as pd

    first = str(text.iloc[0])
    parts = text.str.extract(rf"^({_DAY})[./-]({_DAY})[./-]")
    numbers = parts.apply(pd.to_numeric, errors="coerce").max()
    # 23.11.2026 and 11/23/2026; where both are at most 12, a point says day first and a stroke month first.
    day_first = bool(numbers[0] > 12) or ("." in first[:3] and not numbers[1] > 12)
    try:
        return pd.DatetimeIndex(pd.to_datetime(text, format="mixed", dayfirst=day_first, utc=True))
    except (ValueError, OverflowError) as error:
        reason = (str(error).splitlines() or [""])[0][:100]
        raise DataError(f"column `{name}` cannot be read as dates ({reason}).") from error
