"""Atomic writing of files: to a temporary file, flushed to the disk, then renamed; and checks of paths."""

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
        _sweep(target.parent)
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
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        # Between these two lines another process may have removed it as an abandoned file.
        if path.exists():
            return path, descriptor
        os.close(descriptor)


def _sweep(folder: Path) -> None:
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
    """Raise OutputFileError if `path` is a folder, or a file that `force` does not allow to replace."""
    target = Path(path)
    if target.is_dir():
        raise OutputFileError(f"{target}: is a folder; name a file.")
    if target.exists() and not force:
        raise OutputFileError(f"{target}: exists already; use --force to replace it or choose another name.")


def as_path(thing: object) -> Path:
    """Return `thing` as a path; raise SettingsError if it is neither a text nor a path."""
    if not isinstance(thing, str | Path):
        raise SettingsError(f"the name of a file is needed; got a {type(thing).__name__}.")
    return Path(thing)


def require_file(path: str | Path) -> None:
    """Raise FileFormatError if `path` does not exist or is a folder."""
    if not Path(path).is_file():
        what = "is a folder; name a file in it" if Path(path).is_dir() else "no such file"
        raise FileFormatError(f"{path}: {what}.")


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
