"""Limits on the size of files that softneck reads, shared by all readers.

The size that a file declares is checked before the file is read, and checked again while reading: a small hostile file
may unpack to any size, or to more than it declares.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path

from ._errors import FileFormatError, SettingsError

# [bytes] Largest TOML file that people write (the reader takes 2 s for 4 MB); largest JSON file that commands write, or
# EDS.
MOST_TOML, MOST_JSON = 2**20, 2**24
# [bytes] Largest log on the disk: a day of 12 columns at 100 Hz is 1 GB of text. Largest unpacked size of an archive.
MOST_LOG, MOST_UNPACKED = 2**30, 2 * 2**30
# Most numbers in one table or variable (1 GB as doubles), and most columns: a recording of a neck has 15.
MOST_NUMBERS, MOST_COLUMNS = 2**27, 10_000
# Highest compression ratio: measured numbers, text and programs reach 10 at best, zeros 1000. Files that unpack to less
# than `_SMALL_BYTES` are not checked.
_MOST_RATIO, _SMALL_BYTES = 100, 2**25
# [bytes] Largest directory of an archive: 10,000 members, which zipfile reads in 0.1 s.
_MOST_DIRECTORY = 2**20
# [bytes] Longest line: 10,000 columns of 13 letters. A window of this size without a line break is too long.
_WINDOW_BYTES = 2**17
# pandas needs four times the size of a text of short numbers.
_TEXT_GROWTH = 4
# A key like `a.a.a`: tomllib takes a time that grows with the square of its length.
_LONG_KEY = re.compile(r"(?<![\w-])(?:[\w-]+[ \t]*\.[ \t]*){33}")


def settings_text(path: str | Path, most: int = MOST_TOML) -> str:
    """Return the text of a file of settings.

    Raises:
        ValueError: not a text, larger than `most` bytes, or a key of too many parts.
        OSError: no such file.
    """
    source = Path(path)
    size = source.stat().st_size
    if size > most:
        raise ValueError(_too_large(size, most))
    text = source.read_text(encoding="utf-8")
    if most == MOST_TOML and (found := _LONG_KEY.search(text)):
        raise ValueError(f"the key `{found[0][:20]}...` has more than 32 parts")
    return text


def require_size(path: Path, most: int = MOST_LOG) -> None:
    """Raise FileFormatError if a file is larger than `most` [bytes], or too large for the memory that is free."""
    about = path.stat()
    size, stored = about.st_size, 512 * about.st_blocks
    if size > most:
        raise FileFormatError(f"{path}: {_too_large(size, most)}. {_CUT_IT}")
    if size > largest_unpacked(stored) and stored:  # 0 where a file system does not count
        raise FileFormatError(
            f"{path}: is {_size_text(size)} long, but {_size_text(stored)} on the disk (a sparse file). {_CUT_IT}"
        )
    _require_memory(path, size)


def largest_unpacked(packed: int) -> int:
    """Return the largest size [bytes] to which `packed` bytes of a file may unpack."""
    return min(MOST_UNPACKED, max(_SMALL_BYTES, _MOST_RATIO * packed))


def require_unpacked(path: Path, size: int, packed: int) -> None:
    """Raise FileFormatError if `packed` bytes of a file may not become `size` bytes."""
    if size > largest_unpacked(packed):
        raise FileFormatError(
            f"{path}: unpacks to {_size_text(size)}, too much for a softneck file or a log of {_size_text(packed)}; "
            "it is damaged or hostile."
        )
    _require_memory(path, size)


def require_numbers(path: Path, rows: int, columns: int = 1) -> None:
    """Raise FileFormatError if a table declares more rows or columns than a log can have."""
    if columns > MOST_COLUMNS:
        raise FileFormatError(f"{path}: has {columns} columns; softneck reads at most {MOST_COLUMNS}. {_CUT_IT}")
    if rows * columns > MOST_NUMBERS:
        raise FileFormatError(f"{path}: declares {rows} x {columns} numbers; that is not a log. {_CUT_IT}")
    _require_memory(path, 8 * rows * columns)


def require_steps(name: str, duration: float, step: float, columns: int = 1) -> int:
    """Return the number of steps [s] in a duration [s]; raise SettingsError if a table cannot hold so many."""
    steps, most = duration / step, MOST_NUMBERS // columns
    if not steps <= most:
        raise SettingsError(
            f"`{name}` of {duration:g} s at {step:g} s a step would be {steps:.3g} rows; at most {most} rows of "
            f"{columns} numbers fit. Shorten it."
        )
    return round(steps)


def require_table(path: Path, *, zeros: bool = False) -> None:
    """Raise FileFormatError if a text is not a table: too large, too wide, or with zero bytes (unless `zeros`)."""
    require_size(path)
    _require_memory(path, _TEXT_GROWTH * path.stat().st_size)
    require_lines(path, zeros=zeros, columns=True)


def require_lines(path: Path, *, zeros: bool = False, columns: bool = False) -> None:
    """Raise FileFormatError if a text has a line that is too long, too many `columns`, or zeros unless allowed."""
    with path.open("rb") as file:
        part = file.read(_WINDOW_BYTES)
        for line in part.splitlines() if columns else ():
            require_numbers(path, 1, 1 + max(line.count(mark) for mark in (b",", b";", b"\t", b" ")))
        while part:
            if not zeros and b"\0" in part:
                raise FileFormatError(f"{path}: is not a text: it holds zero bytes; export the log as CSV.")
            if len(part) == _WINDOW_BYTES and b"\n" not in part and b"\r" not in part:
                raise FileFormatError(
                    f"{path}: has a line of more than {_size_text(_WINDOW_BYTES)}; that is no table. {_CUT_IT}"
                )
            part = file.read(_WINDOW_BYTES)


def open_zip(path: Path, *, verify: bool = False) -> zipfile.ZipFile:
    """Open an archive after checking its size; with `verify` also unpack each member and compare its size.

    Readers that trust the streams and not the directory need `verify`.

    Raises:
        FileFormatError: it unpacks to too much, has too many members, or a member is larger than declared.
        zipfile.BadZipFile, OSError: not an archive.
    """
    _require_directory(path)
    archive = zipfile.ZipFile(path)
    try:
        entries = archive.infolist()
        require_unpacked(path, sum(entry.file_size for entry in entries), path.stat().st_size)
        for entry in entries if verify else ():
            _require_true(path, entry)
    except BaseException:
        archive.close()
        raise
    return archive


def _require_directory(path: Path) -> None:
    """Raise FileFormatError if an archive's directory is too large: zipfile would read all of it on opening."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 2**16 - 42))
        tail = file.read()
    at = len(tail) - 22 if tail[-22:-18] == b"PK\5\6" and tail[-2:] == b"\0\0" else tail.rfind(b"PK\5\6")
    size = int.from_bytes(tail[at + 12 : at + 16], "little")
    if at >= 0 and (size > _MOST_DIRECTORY or tail[max(0, at - 20) : at].startswith(b"PK\6\7")):
        raise FileFormatError(f"{path}: is an archive with more members than any softneck file or log has.")


def _require_true(path: Path, entry: zipfile.ZipInfo) -> None:
    """Raise FileFormatError if a member's stream unpacks to more than its directory declares."""
    with path.open("rb") as file:
        file.seek(entry.header_offset + 26)
        names = file.read(4)
        file.seek(sum(int.from_bytes(part, "little") for part in (names[:2], names[2:])), 1)
        stream, left, total = zlib.decompressobj(-zlib.MAX_WBITS), entry.compress_size, 0
        while entry.compress_type == zipfile.ZIP_DEFLATED and left > 0 and not stream.eof:
            data = stream.unconsumed_tail or file.read(min(left, _WINDOW_BYTES))
            left -= 0 if stream.unconsumed_tail else max(len(data), 1)
            total += len(stream.decompress(data, _WINDOW_BYTES))
            if total > entry.file_size:
                raise FileFormatError(f"{path}: `{entry.filename}` unpacks to more than it declares; it is hostile.")


def available_bytes() -> int | None:
    """Return the memory [bytes] available without swapping, or None where the system does not report it."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return 1024 * kilobytes[0] if kilobytes else None


def _require_memory(path: Path, size: int) -> None:
    # A small size fits anywhere.
    free = available_bytes() if size > _SMALL_BYTES else None
    if free is not None and size > free:
        raise FileFormatError(
            f"{path}: needs about {_size_text(size)} of memory, and {_size_text(free)} are free. {_CUT_IT}"
        )


def _too_large(size: int, most: int) -> str:
    return f"has {_size_text(size)}; softneck reads at most {_size_text(most)} here"


def _size_text(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"


_CUT_IT = "Cut it, or name another file."
