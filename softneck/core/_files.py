"""Whole files or none: everything is written to a temporary name, brought to the disk and renamed."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from ._errors import FileFormatError, OutputFileError, SettingsError

# Beside every target: `.NAME-softneck-RANDOM.SUFFIX`; readers and listings of `*.SUFFIX` pass over hidden files.
_MARK = "-softneck-"


@contextlib.contextmanager
def atomic_write(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it becomes `path`, on failure it vanishes.

    The file and its folder are on the disk when this returns, so that a power cut leaves the old file or the new one. A
    symbolic link is followed: what it points to is replaced, and the link stays. What killed processes left in the
    folder is removed.

    Raises:
        OutputFileError: `path` exists and `force` is false, or its folder cannot be written, or the disk is full.
    """
    named = Path(path)
    refuse_existing(named, force=force)
    try:
        target = _followed(named)
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target.parent)
        temporary, held = _begun(target)
    except OSError as error:
        raise OutputFileError(f"{named}: cannot be written: {error.strerror}. Choose another folder.") from error
    try:
        yield temporary
        _to_disk(temporary)
        temporary.replace(target)
        _to_disk(target.parent)
    except OSError as error:
        if isinstance(error, OutputFileError):  # of a writer in a writer, which knows the temporary file alone
            raise OutputFileError(str(error).replace(str(temporary), str(named))) from error
        reason = error.strerror or str(error)
        raise OutputFileError(f"{named}: cannot be written: {reason}. Nothing was left behind.") from error
    finally:
        temporary.unlink(missing_ok=True)
        os.close(held)


def _followed(path: Path) -> Path:
    """Return what a symbolic link points to, there or not yet; raise OSError where links lead in a circle."""
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    return target


def _begun(target: Path) -> tuple[Path, int]:
    """Return a new temporary file and the descriptor that holds its lock; the umask decides who may read it."""
    while True:
        path = target.with_name(f".{target.stem[:40]}{_MARK}{secrets.token_hex(4)}{target.suffix}")
        held = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        fcntl.flock(held, fcntl.LOCK_EX)
        # Between the two lines another process may have taken it for one that was left.
        if path.exists():
            return path, held
        os.close(held)


def _sweep(folder: Path) -> None:
    """Remove the temporary files of processes that ended: nobody holds their locks."""
    for entry in os.scandir(folder):
        if entry.name.startswith(".") and _MARK in entry.name and entry.is_file(follow_symlinks=False):
            with contextlib.suppress(OSError):
                held = os.open(entry.path, os.O_RDONLY | os.O_NOFOLLOW)
                try:
                    fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(entry.path)  # noqa: PTH108  (what scandir gives)
                finally:
                    os.close(held)


def _to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def refuse_existing(path: str | Path, *, force: bool) -> None:
    """Raise OutputFileError if `path` is a folder, or a file that `force` does not allow to replace."""
    target = Path(path)
    if target.is_dir():
        raise OutputFileError(f"{target}: is a folder; name a file.")
    if target.exists() and not force:
        raise OutputFileError(f"{target}: exists already; use --force to replace it or choose another name.")


def as_path(thing: object) -> Path:
    """Return a path; raise SettingsError for what names no file."""
    if not isinstance(thing, str | Path):
        raise SettingsError(f"the name of a file is needed; got a {type(thing).__name__}.")
    return Path(thing)


def require_file(path: str | Path) -> None:
    """Raise FileFormatError where there is no file, and say so of a folder."""
    if not Path(path).is_file():
        what = "is a folder; name a file in it" if Path(path).is_dir() else "no such file"
        raise FileFormatError(f"{path}: {what}.")


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
