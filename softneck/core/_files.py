"""Limits on the size of files that softneck reads, and atomic writing.

The size that a file declares is checked before the file is read, and checked again while reading: a small hostile file
may unpack to any size, or to more than it declares.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import secrets
import tomllib
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ._errors import FileFormatError, OutputFileError, SettingsError

# [bytes] Largest TOML file that people write (the reader takes 2 s for 4 MB); largest JSON file that commands
# write.
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

    Raises ValueError: not a text, larger than `most` bytes, or a key of too many parts; OSError: no such file.
    """
    source = Path(path)
    size = source.stat().st_size
    if size > most:
        raise ValueError(_too_large(size, most))
    text = source.read_text(encoding="utf-8")
    if most == MOST_TOML and (found := _LONG_KEY.search(text)):
        raise ValueError(f"the key `{found[0][:20]}...` has more than 32 parts")
    return text


def require_size(path: Path) -> None:
    """Raise FileFormatError if a log is larger than `MOST_LOG`, or too large for the memory that is free."""
    about = path.stat()
    size, stored = about.st_size, 512 * about.st_blocks
    if size > MOST_LOG:
        raise FileFormatError(f"{path}: {_too_large(size, MOST_LOG)}. {_CUT_IT}")
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
    with path.open("rb") as file:
        part = file.read(_WINDOW_BYTES)
        for line in part.splitlines():
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
    Raises FileFormatError: it unpacks to too much, has too many members, or a member is larger than declared;
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


# Temporary files are called `.NAME-softneck-RANDOM.SUFFIX`: hidden, so that listings of `*.SUFFIX` skip them.
_NAME_MARK = "-softneck-"


@contextlib.contextmanager
def atomic_write(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it becomes `path`, on failure it vanishes.

    The file and its folder are on the disk when this returns, so that a power cut leaves either the old file or the new
    one. A symbolic link is followed: its target is replaced, and the link stays. Temporary files that killed processes
    left in the folder are removed.

    Raises:
        OutputFileError: `path` exists and `force` is false, or its folder cannot be written, or the disk is full.
    """
    named = Path(path)
    refuse_existing(named, force=force)
    try:
        target = _resolve_link(named)
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(target.parent)
        temporary, descriptor = _create_temporary(target)
    except OSError as error:
        raise OutputFileError(f"{named}: cannot be written: {error.strerror}. Choose another folder.") from error
    try:
        yield temporary
        _to_disk(temporary)
        temporary.replace(target)
        _to_disk(target.parent)
    except OSError as error:
        if isinstance(error, OutputFileError):  # of a nested writer, which only has the name of the temporary file
            raise OutputFileError(str(error).replace(str(temporary), str(named))) from error
        reason = error.strerror or str(error)
        raise OutputFileError(f"{named}: cannot be written: {reason}. Nothing was left behind.") from error
    finally:
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


def write_text(path: str | Path, text: str, *, force: bool = False) -> None:
    """Write a text as `atomic_write` does."""
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _resolve_link(path: Path) -> Path:
    """Return the target of a symbolic link, whether or not it exists; raise OSError if links form a circle."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    return target


def _create_temporary(target: Path) -> tuple[Path, int]:
    """Create a temporary file; return its path and the descriptor that holds its lock. Its mode follows the umask."""
    while True:
        path = target.with_name(f".{target.stem[:40]}{_NAME_MARK}{secrets.token_hex(4)}{target.suffix}")
        descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            # Between these two lines another process may have removed it as an abandoned file.
            if path.exists():
                return path, descriptor
        except BaseException:  # Ctrl-C too leaves no file
            path.unlink(missing_ok=True)
            os.close(descriptor)
            raise
        os.close(descriptor)


def remove_abandoned(folder: Path) -> None:
    """Remove the temporary files of processes that ended: those whose lock is free."""
    for entry in os.scandir(folder):
        if entry.name.startswith(".") and _NAME_MARK in entry.name and entry.is_file(follow_symlinks=False):
            with contextlib.suppress(OSError):
                descriptor = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(entry.path)  # noqa: PTH108  (scandir gives a text)
                finally:
                    os.close(descriptor)


def _to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def refuse_existing(path: str | Path, *, force: bool) -> None:
    """Raise OutputFileError if `path` is a folder, a file that `force` does not allow to replace, or not writable.

    Commands call this before their work, which may take minutes.
    """
    target = Path(path)
    if target.is_dir():
        raise OutputFileError(f"{target}: is a folder; name a file.")
    if target.exists() and not force:
        raise OutputFileError(f"{target}: exists already; use --force to replace it or choose another name.")
    folder = next(parent for parent in Path(os.path.realpath(target)).parents if parent.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
        read_only = os.statvfs(folder).f_flag & os.ST_RDONLY
        reason = errno.ENOTDIR if not folder.is_dir() else errno.EROFS if read_only else errno.EACCES
        raise OutputFileError(f"{target}: cannot be written: {os.strerror(reason)}. Choose another folder.")


def as_path(thing: object) -> Path:
    """Return `thing` as a path; raise SettingsError if it is neither a text nor a path."""
    if not isinstance(thing, str | Path):
        raise SettingsError(f"the name of a file is needed; got a {type(thing).__name__}.")
    return Path(thing)


def require_file(path: str | Path, hint: str = "") -> None:
    """Raise FileFormatError if `path` does not exist or is a folder; the line ends with `hint`."""
    if not Path(path).is_file():
        what = "is a folder; name a file in it" if Path(path).is_dir() else "no such file"
        raise FileFormatError(f"{path}: {what}{hint and '; '}{hint}.")


def read_toml(path: str | Path, hint: str = "") -> dict[str, Any]:
    """Return the content of a TOML file; `hint` says what to give instead of a file that is missing.

    Raises FileFormatError: no such file, or no TOML.
    """
    require_file(path, hint)
    try:
        return tomllib.loads(settings_text(path))
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, thousands of digits or brackets
        raise FileFormatError(f"{path}: is not valid TOML ({error}).") from error
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}.") from error


def refuse_unknown(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    """Raise SettingsError if `table` has a key that is not `known`."""
    unknown = [key for key in table if key not in known]
    if unknown:
        raise SettingsError(f"unknown key `{unknown[0]}` of {where}; it takes {', '.join(known)}.")


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
