"""Whole files or none: everything is written to a temporary name and renamed."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ._errors import OutputFileError


@contextlib.contextmanager
def atomic_write(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it becomes `path`, on failure it vanishes.

    Raises:
        OutputFileError: `path` exists and `force` is false, or its folder cannot be written, or the disk is full.
    """
    target = Path(path)
    refuse_existing(target, force=force)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.stem[:40]}-", suffix=target.suffix, dir=target.parent)
        os.close(handle)
    except OSError as error:
        raise OutputFileError(f"{target}: cannot be written: {error.strerror}. Choose another folder.") from error
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    except OSError as error:
        if isinstance(error, OutputFileError):
            raise
        reason = error.strerror or str(error)
        raise OutputFileError(f"{target}: cannot be written: {reason}. Nothing was left behind.") from error
    finally:
        temporary.unlink(missing_ok=True)


def refuse_existing(path: str | Path, *, force: bool) -> None:
    """Raise OutputFileError if `path` is a folder, or a file that `force` does not allow to replace."""
    target = Path(path)
    if target.is_dir():
        raise OutputFileError(f"{target}: is a folder; name a file.")
    if target.exists() and not force:
        raise OutputFileError(f"{target}: exists already; use --force to replace it or choose another name.")


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
