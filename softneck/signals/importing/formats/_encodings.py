"""What a file is by its first bytes, and in which encoding a text is."""

from __future__ import annotations

import codecs
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

from softneck.core import FileFormatError, open_zip, require_size, require_table

#: What a logger's file may be; `text` is all that has no mark of its own.
FORMATS = ("text", "parquet", "mat", "sheet", "mcap")
_HEAD = 2**16
_MARKS = (
    (b"PAR1", "parquet"),
    (b"\x89HDF\r\n\x1a\n", "mat"),
    (b"MATLAB 5.0", "mat"),
    (b"MATLAB 7.3", "mat"),
    (b"\x89MCAP0\r\n", "mcap"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "sheet"),
)
# Of these the user hears what they are, and what would do instead.
_EXPORT = "export the log as CSV"
_SAVE_AS_MAT = "save it there by `save -v7 log.mat`"
_OTHERS = (
    (b"\x89PNG", "a PNG picture", _EXPORT),
    (b"\xff\xd8\xff", "a JPEG picture", _EXPORT),
    (b"GIF8", "a GIF picture", _EXPORT),
    (b"BM", "a BMP picture", _EXPORT),
    (b"RIFF", "a sound, film or picture", _EXPORT),
    (b"%PDF", "a PDF document", _EXPORT),
    (b"\x1f\x8b", "compressed by gzip", "unpack it with gunzip"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"SQLite format 3", "a SQLite database", "a ROS 2 bag of this kind becomes MCAP by `ros2 bag convert`"),
    (b"#ROSBAG", "a bag of ROS 1", "convert it with `rosbags-convert` to MCAP of ROS 2, or export CSV"),
    (b"\x7fELF", "a program", _EXPORT),
    (b"Octave-1-", "a binary file of Octave", _SAVE_AS_MAT),
    (b"# Created by Octave", "a text of Octave's `save`", _SAVE_AS_MAT),
)
# A BOM says it; the longer mark first, as one begins with the other.
_BOMS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
         (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))  # fmt: skip
#: What `[file] encoding` may say.
ENCODINGS = ("utf-8", "cp1252", "utf-16", "utf-16-le", "utf-16-be", "utf-32")


def format_of(source: Path) -> str:
    """Return which of `FORMATS` a file is, by its content."""
    if source.is_dir():
        inside = sorted(path.name for path in source.iterdir() if path.suffix.lower() in (".mcap", ".csv"))
        hint = f"name a file in it, such as {source / inside[0]}" if inside else "name a file in it"
        raise FileFormatError(f"{source}: is a folder; {hint}.")
    if not source.is_file():
        raise FileFormatError(f"{source}: no such file.")
    require_size(source)
    with source.open("rb") as file:
        head = file.read(_HEAD)
    if not head.strip():
        raise FileFormatError(f"{source}: cannot be read as a table (it is empty).")
    if head.startswith(b"PK\x03\x04"):
        return _zipped(source)
    for mark, name in _MARKS:
        if head.startswith(mark):
            return name
    for mark, what, instead in _OTHERS:
        # A text may begin with letters like a mark's; a text has no zeros.
        if head.startswith(mark) and (b"\0" in head[:512] or not mark.isalpha()):
            raise FileFormatError(f"{source}: is {what}, not a log; {instead}.")
    return {".mat": "mat", ".parquet": "parquet"}.get(source.suffix.lower(), "text")


def _zipped(source: Path) -> str:
    try:
        with open_zip(source, verify=True) as archive:
            names = set(archive.namelist())
    except FileFormatError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, ValueError, NotImplementedError):
        names = set()
    if names & {"xl/workbook.xml", "xl/workbook.bin", "content.xml"}:
        return "sheet"
    raise FileFormatError(f"{source}: is a ZIP archive that holds no spreadsheet; unpack it and name the log in it.")


def encoding_of(source: Path) -> tuple[str, str | None]:
    """Return a text's encoding, one of `ENCODINGS`, and why where it is not UTF-8."""
    require_table(source, zeros=True)
    with source.open("rb") as file:
        head = file.read(_HEAD)
        for mark, name in _BOMS:
            if head.startswith(mark):
                return name, None if name == "utf-8" else f"{name.upper()}, because it begins with its mark"
        zeros = [head[first::2].count(0) for first in (0, 1)]
        pairs = max(len(head) // 2, 1)
        for first, name in ((0, "utf-16-be"), (1, "utf-16-le")):
            # Latin letters and digits: every other byte is zero, and the bytes between are not.
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
    """Return whether all of a file is UTF-8; `rest` is the file behind `head`."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        decoder.decode(head)
        while part := rest.read(2**20):
            decoder.decode(part)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True
