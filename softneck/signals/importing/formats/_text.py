"""Format of a file by its first bytes, encoding of a text, and dates as seconds."""

from __future__ import annotations

import codecs
import re
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from softneck.core import DataError, FileFormatError, Vector, error_reason, open_zip, require_size, require_table

if TYPE_CHECKING:
    import pandas as pd

#: Formats of logs; `text` is any file without a mark.
FORMATS = ("text", "parquet", "mat", "sheet", "mcap", "labview", "json")
_HEAD_BYTES = 2**16
_FORMAT_MARKS = (
    (b"PAR1", "parquet"),
    (b"\x89HDF\r\n\x1a\n", "mat"),
    (b"MATLAB 5.0", "mat"),
    (b"MATLAB 7.3", "mat"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"\x93NUMPY", "mat"),
    (b"LabVIEW Measurement", "labview"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "sheet"),
)
# Messages for files in other formats, each with a remedy.
_EXPORT_HINT = "export the log as CSV"
_SAVE_AS_MAT = "save it there by `save -v7 log.mat`"
_OTHER_FORMATS = (
    (b"\x89PNG", "a PNG picture", _EXPORT_HINT),
    (b"\xff\xd8\xff", "a JPEG picture", _EXPORT_HINT),
    (b"GIF8", "a GIF picture", _EXPORT_HINT),
    (b"BM", "a BMP picture", _EXPORT_HINT),
    (b"RIFF", "a sound, film or picture", _EXPORT_HINT),
    (b"%PDF", "a PDF document", _EXPORT_HINT),
    (b"TDSm", "a TDMS file of LabVIEW", "export it as .lvm or CSV (in Python npTDMS reads it)"),
    (b"\x1f\x8b", "compressed by gzip", "unpack it with gunzip"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"SQLite format 3", "a SQLite database", "a ROS 2 bag of this kind becomes MCAP by `ros2 bag convert`"),
    (b"#ROSBAG", "a bag of ROS 1", "convert it with `rosbags-convert` to MCAP of ROS 2, or export CSV"),
    (b"\x7fELF", "a program", _EXPORT_HINT),
    (b"Octave-1-", "a binary file of Octave", _SAVE_AS_MAT),
    (b"# Created by Octave", "a text of Octave's `save`", _SAVE_AS_MAT),
)
# Byte order marks, longer ones first: UTF-32 begins like UTF-16.
_BOMS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
         (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))  # fmt: skip
#: Values of `[file] encoding`.
ENCODINGS = ("utf-8", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-32")


def format_of(source: Path) -> str:
    """Return the format of a file, one of `FORMATS`, by its content."""
    if source.is_dir():
        inside = sorted(path.name for path in source.iterdir() if path.suffix.lower() in (".mcap", ".csv"))
        hint = f"name a file in it, such as {source / inside[0]}" if inside else "name a file in it"
        raise FileFormatError(f"{source}: is a folder; {hint}.")
    if not source.is_file():
        raise FileFormatError(f"{source}: no such file.")
    require_size(source)
    with source.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head.strip():
        raise FileFormatError(f"{source}: cannot be read as a table (it is empty).")
    if head.startswith(b"PK\x03\x04"):
        return _zip_format(source)
    for mark, name in _FORMAT_MARKS:
        if head.startswith(mark):
            return name
    for mark, what, remedy in _OTHER_FORMATS:
        # A text may begin with the letters of a mark, but holds no zeros.
        if head.startswith(mark) and (b"\0" in head[:512] or not mark.isalpha()):
            raise FileFormatError(f"{source}: is {what}, not a log; {remedy}.")
    if _CAN_LOG.match(head.lstrip()):
        raise FileFormatError(
            f"{source}: is a log of CAN frames, not of signals; decode it to CSV with the bus's DBC file."
        )
    if _is_json(head):
        return "json"
    return {".mat": "mat", ".parquet": "parquet"}.get(source.suffix.lower(), "text")


# Lines of `candump -l` and `-ta`, and the head of Vector's .asc.
_CAN_LOG = re.compile(rb"\(\d+\.\d+\)\s+\w+\s+[0-9A-Fa-f]{3,8}(#|\s+\[\d\])|date \w{3} \w{3} .*\r?\nbase (hex|dec)")


def _is_json(head: bytes) -> bool:
    """Return whether a text begins as a JSON object, or a list of some."""
    start = re.sub(rb"\s", b"", head.removeprefix(codecs.BOM_UTF8)[:512])
    return start.startswith((b'{"', b'[{"'))


def _zip_format(source: Path) -> str:
    try:
        with open_zip(source, verify=True) as archive:
            names = set(archive.namelist())
    except FileFormatError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError):
        names = set()
    if names & {"xl/workbook.xml", "xl/workbook.bin", "content.xml"}:
        return "sheet"
    if names and all(name.endswith(".npy") for name in names):
        return "mat"
    raise FileFormatError(f"{source}: is a ZIP archive that holds no spreadsheet; unpack it and name the log in it.")


def encoding_of(source: Path) -> tuple[str, str | None]:
    """Return a text's encoding, one of `ENCODINGS`, and the reason unless it is UTF-8."""
    require_table(source, zeros=True)
    with source.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        for mark, name in _BOMS:
            if head.startswith(mark):
                return name, None if name == "utf-8" else f"{name.upper()}, because it begins with its mark"
        zeros = [head[first::2].count(0) for first in (0, 1)]
        pairs = max(len(head) // 2, 1)
        for first, name in ((0, "utf-16-be"), (1, "utf-16-le")):
            # Latin letters and digits: every other byte is zero, the rest is not.
            if zeros[first] > 0.7 * pairs and zeros[1 - first] < 0.1 * pairs:
                return name, f"{name.upper()}, because every other byte is zero"
        if 0 in head:
            raise FileFormatError(f"{source}: is not a text: it holds zero bytes; export the log as CSV.")
        if _is_utf8(head, file):
            return "utf-8", None
        file.seek(0)
        while part := file.read(2**20):
            try:
                part.decode("cp1252")
            except UnicodeDecodeError as error:
                place = file.tell() - len(part) + error.start
                raise FileFormatError(
                    f"{source}: is not a text: byte {place} is none in UTF-8 or Windows-1252; export the log as CSV."
                ) from None
    return "cp1252", "Windows-1252 (Latin 1), because it is not UTF-8"


def _is_utf8(head: bytes, rest: BinaryIO) -> bool:
    """Return whether all of a file is UTF-8; `rest` follows `head`."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        decoder.decode(head)
        while part := rest.read(2**20):
            decoder.decode(part)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True


# ISO 8601 (year first) is unambiguous; of the other orders the first that fits is taken.
_DAY_PATTERN = r"\d{1,2}"
_TIME_PATTERN = r"\d{1,2}:\d{2}(:\d{2}([.,:]\d+)?)?(\s?[AaPp][Mm])?"
# A time of day with `:` before its milliseconds, and minutes with seconds of an hour, `mm:ss.mmm`.
_COLON_FRACTION = re.compile(r"(\d{1,2}:\d{2}:\d{2}):(\d{1,3})$")
_MINUTES = re.compile(r"(\d{1,4}):(\d{2}[.,]\d+)")
_ISO = re.compile(rf"\d{{4}}-\d{{2}}-\d{{2}}([T ]+{_TIME_PATTERN})?\s?(Z|[+-]\d{{2}}:?\d{{2}})?")
_SPLIT = re.compile(
    rf"({_DAY_PATTERN})([./-])({_DAY_PATTERN})\2(\d{{4}}|\d{{2}})(,?\s+{_TIME_PATTERN})?|{_TIME_PATTERN}"
)
#: The unit of a time column that holds dates or times of day.
DATE = "date"
# [s] A larger number is the time since 1970, not since the start of the log; it means 1973.
EPOCH = 1e8


def is_date(cell: object) -> bool:
    """Return whether a cell looks like a date or a time of day."""
    text = str(cell).strip()
    return any(pattern.fullmatch(text) is not None for pattern in (_ISO, _SPLIT, _MINUTES))


def seconds(column: pd.Series, name: str) -> Vector:
    """Return (time,) seconds of dates or times of day, from the first on.

    Times of day that fall by more than 12 h pass midnight. A number above 12 distinguishes day and month; their order
    does not matter for a log of less than a day.
    """
    import pandas as pd

    if column.dtype.kind == "M":
        moments = pd.DatetimeIndex(column)
    else:
        text = column.astype(str).str.strip().str.replace(r"(\d),(\d)", r"\1.\2", regex=True)
        if text.str.fullmatch(_MINUTES.pattern).all():
            return _minutes(text)
        text = text.str.replace(_COLON_FRACTION, lambda found: f"{found[1]}.{found[2].zfill(3)}", regex=True)
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
    try:
        ns = np.asarray((moments - moments[0]).as_unit("ns").asi8, dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"column `{name}` spans more than 292 years; is one of its dates damaged?") from error
    t = ns / 1e9
    if column.dtype.kind != "M" and ":" in str(column.iloc[0])[:3]:
        t = t + 86_400.0 * np.concatenate([[0], np.cumsum(np.diff(t) < -43_200.0)])
    return t


def _minutes(text: pd.Series) -> Vector:
    """Return the seconds of `mm:ss.mmm`, from the first on; minutes that begin again are those of the next hour."""
    parts = text.str.extract(_MINUTES.pattern).astype(float).to_numpy()
    t = 60.0 * parts[:, 0] + parts[:, 1]
    t = t + 3600.0 * np.concatenate([[0], np.cumsum(np.diff(t) < -1800.0)])
    return t - t[0]


def _moments(text: pd.Series, name: str) -> pd.DatetimeIndex:
    import pandas as pd

    first = str(text.iloc[0])
    parts = text.str.extract(rf"^({_DAY_PATTERN})[./-]({_DAY_PATTERN})[./-]")
    numbers = parts.apply(pd.to_numeric, errors="coerce").max()
    # 23.11.2026 and 11/23/2026. If both are at most 12, a point means day first and a slash month first.
    day_first = bool(numbers[0] > 12) or ("." in first[:3] and not numbers[1] > 12)
    try:
        return pd.DatetimeIndex(pd.to_datetime(text, format="mixed", dayfirst=day_first, utc=True))
    except (ValueError, OverflowError) as error:
        raise DataError(f"column `{name}` cannot be read as dates ({error_reason(error)}).") from error
