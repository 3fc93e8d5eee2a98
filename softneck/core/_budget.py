"""What reading a file may cost: the one place for the budgets of all readers.

What a file says of itself is looked at before it is read, and what it says is not believed: a small hostile file may
unpack to any size, or to more than it says.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path

from ._errors import FileFormatError, SettingsError

# [bytes] Of TOML that people write (the reader takes 2 s for 4 MB), of JSON that commands write, and of an EDS.
MOST_TOML, MOST_JSON = 2**20, 2**24
# [bytes] Of a log as it lies on the disk: a day of 12 columns at 100 Hz is 1 GB of text. Of what an archive unpacks to.
MOST_LOG, MOST_UNPACKED = 2**30, 2 * 2**30
# Of one table or variable (1 GB as doubles); a neck has 15 columns, and 10,000 names take a screen of a minute to read.
MOST_NUMBERS, MOST_COLUMNS = 2**27, 10_000
# Measured numbers, text and programs pack to a tenth at best, and zeros to a thousandth; below `_SMALL` nobody minds.
_MOST_RATIO, _SMALL = 100, 2**25
# [bytes] Of the list of an archive's members: 10,000 of them, which zipfile reads in 0.1 s.
_MOST_DIRECTORY = 2**20
# [bytes] A line of 10,000 columns of 13 letters. Windows of this size without an end of line hold a longer one.
_WINDOW = 2**17
# pandas holds a text of short numbers four times.
_TEXT_GROWS = 4
# A key like `a.a.a`: the time that tomllib takes for it grows with the square of its length.
_LONG_KEY = re.compile(r"(?<![\w-])(?:[\w-]+[ \t]*\.[ \t]*){33}")


def settings_text(path: str | Path, most: int = MOST_TOML) -> str:
    """Return the text of a file of settings.

    Raises:
        ValueError: no text, larger than any that people write, or a key of too many parts.
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
        raise FileFormatError(f"{path}: {_too_large(size, most)}. {_CUT}")
    if size > room(stored) and stored:  # 0 where a file system does not count
        raise FileFormatError(f"{path}: says {_said(size)} and holds {_said(stored)}: the rest is holes. {_CUT}")
    _require_memory(path, size)


def room(packed: int) -> int:
    """Return how many bytes `packed` bytes of a file may become."""
    return min(MOST_UNPACKED, max(_SMALL, _MOST_RATIO * packed))


def require_unpacked(path: Path, size: int, packed: int) -> None:
    """Raise FileFormatError if `packed` bytes of a file may not become `size` bytes."""
    if size > room(packed):
        raise FileFormatError(
            f"{path}: unpacks to {_said(size)}, which no file of ours and no log of {_said(packed)} does; "
            "it is damaged or hostile."
        )
    _require_memory(path, size)


def require_numbers(path: Path, rows: int, columns: int = 1) -> None:
    """Raise FileFormatError if a table declares more rows or columns than a log can have."""
    if columns > MOST_COLUMNS:
        raise FileFormatError(f"{path}: has {columns} columns; softneck reads at most {MOST_COLUMNS}. {_CUT}")
    if rows * columns > MOST_NUMBERS:
        raise FileFormatError(f"{path}: declares {rows} x {columns} numbers; that is not a log. {_CUT}")
    _require_memory(path, 8 * rows * columns)


def require_steps(name: str, duration: float, step: float, columns: int = 1) -> int:
    """Return how many steps [s] a duration [s] has; raise SettingsError for more than a table of them can hold."""
    steps, most = duration / step, MOST_NUMBERS // columns
    if not steps <= most:
        raise SettingsError(
            f"`{name}` of {duration:g} s at {step:g} s a step would be {steps:.3g} rows; at most {most} rows of "
            f"{columns} numbers fit. Shorten it."
        )
    return round(steps)


def require_table(path: Path, *, zeros: bool = False) -> None:
    """Raise FileFormatError if a text is no table: too large, too wide, or of bytes that are 0 unless `zeros`."""
    require_size(path)
    _require_memory(path, _TEXT_GROWS * path.stat().st_size)
    require_lines(path, zeros=zeros, columns=True)


def require_lines(path: Path, *, zeros: bool = False, columns: bool = False) -> None:
    """Raise FileFormatError if a text has a line that is too long, too many `columns`, or zeros unless allowed."""
    with path.open("rb") as file:
        part = file.read(_WINDOW)
        for line in part.splitlines() if columns else ():
            require_numbers(path, 1, 1 + max(line.count(mark) for mark in (b",", b";", b"\t", b" ")))
        while part:
            if not zeros and b"\0" in part:
                raise FileFormatError(f"{path}: is not a text: it holds zero bytes; export the log as CSV.")
            if len(part) == _WINDOW and b"\n" not in part and b"\r" not in part:
                raise FileFormatError(f"{path}: has a line of more than {_said(_WINDOW)}; that is no table. {_CUT}")
            part = file.read(_WINDOW)


def open_zip(path: Path, *, verify: bool = False) -> zipfile.ZipFile:
    """Return an archive that may be read; with `verify` for readers that believe its streams and not its directory.

    Raises:
        FileFormatError: it unpacks to too much, has too many members, or a member that holds more than it says.
        zipfile.BadZipFile, OSError: no archive.
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
    """Look at the end of an archive as zipfile does, which reads the whole directory before it may be asked."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 2**16 - 42))
        tail = file.read()
    at = len(tail) - 22 if tail[-22:-18] == b"PK\5\6" and tail[-2:] == b"\0\0" else tail.rfind(b"PK\5\6")
    size = int.from_bytes(tail[at + 12 : at + 16], "little")
    if at >= 0 and (size > _MOST_DIRECTORY or tail[max(0, at - 20) : at].startswith(b"PK\6\7")):
        raise FileFormatError(f"{path}: is an archive of more members than any file of ours or log has.")


def _require_true(path: Path, entry: zipfile.ZipInfo) -> None:
    """Raise FileFormatError if a member's stream holds more than the directory says."""
    with path.open("rb") as file:
        file.seek(entry.header_offset + 26)
        names = file.read(4)
        file.seek(sum(int.from_bytes(part, "little") for part in (names[:2], names[2:])), 1)
        stream, left, total = zlib.decompressobj(-zlib.MAX_WBITS), entry.compress_size, 0
        while entry.compress_type == zipfile.ZIP_DEFLATED and left > 0 and not stream.eof:
            data = stream.unconsumed_tail or file.read(min(left, _WINDOW))
            left -= 0 if stream.unconsumed_tail else max(len(data), 1)
            total += len(stream.decompress(data, _WINDOW))
            if total > entry.file_size:
                raise FileFormatError(f"{path}: `{entry.filename}` unpacks to more than it says; it is hostile.")


def available_bytes() -> int | None:
    """Return how much memory may be had without swapping, or None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    kilobytes = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return 1024 * kilobytes[0] if kilobytes else None


def _require_memory(path: Path, size: int) -> None:
    # What fits anywhere is not worth a look at the system.
    free = available_bytes() if size > _SMALL else None
    if free is not None and size > free:
        raise FileFormatError(f"{path}: needs about {_said(size)} of memory, and {_said(free)} are free. {_CUT}")


def _too_large(size: int, most: int) -> str:
    return f"has {_said(size)}; softneck reads at most {_said(most)} here"


def _said(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"


_CUT = "Cut it, or name another file."
