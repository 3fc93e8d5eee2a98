"""FMUs unpacked where they are safe to run.

pythonfmu's binary decodes only `%20` in the path it gets and crashes the process on `+`, `#`, `%`,
parentheses or accents in it, so the folder's own path must be plain, whatever the FMU's path is.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from softneck.core import FileFormatError, OutputFileError

# A three-platform FMU weighs a few MB; more than this wants to fill the disk.
_MAX_BYTES = 2 * 2**30
_PLAIN = re.compile(r"[A-Za-z0-9_./\\:~-]+")


def unpack(path: str | Path) -> Path:
    """Unpack an FMU into a new folder with a plain path and return that; the caller removes it.

    Raises:
        FileFormatError: no FMU, or one with members that reach out of the folder or are too large.
    """
    source = Path(path)
    if not source.is_file():
        raise FileFormatError(f"{source}: no such file.")
    try:
        with zipfile.ZipFile(source) as archive:
            _check_members(source, archive)
            folder = Path(tempfile.mkdtemp(prefix="softneck-unpacked-", dir=_plain_folder()))
            try:
                archive.extractall(folder)
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
    except FileFormatError:
        raise
    except OSError as error:
        raise OutputFileError(f"{source}: cannot be unpacked: {error.strerror or error}.") from error
    except Exception as error:  # zipfile and its decompressors raise whatever damaged bytes lead to
        raise FileFormatError(f"{source}: is not an FMU or is damaged ({error}).") from error
    return folder


@contextmanager
def unpacked(path: str | Path) -> Iterator[Path]:
    """Yield the folder that `unpack` makes and remove it afterwards."""
    folder = unpack(path)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check_members(source: Path, archive: zipfile.ZipFile) -> None:
    entries = archive.infolist()
    for entry in entries:
        name = PurePosixPath(entry.orig_filename)
        if name.is_absolute() or ".." in name.parts or "\\" in entry.orig_filename or ":" in entry.orig_filename:
            raise FileFormatError(f"{source}: its member `{entry.orig_filename}` reaches out of the FMU; not unpacked.")
    total = sum(entry.file_size for entry in entries)
    if total > _MAX_BYTES:
        raise FileFormatError(f"{source}: unpacks to {total} bytes, over the limit of {_MAX_BYTES}.")
    if "modelDescription.xml" not in archive.namelist():
        raise FileFormatError(f"{source}: is not an FMU: it has no modelDescription.xml.")


def _plain_folder() -> Path:
    for folder in (tempfile.gettempdir(), "/tmp", "/var/tmp", str(Path.home())):
        if _PLAIN.fullmatch(folder) and Path(folder).is_dir():
            return Path(folder)
    raise OutputFileError("no temporary folder has a plain path (letters, digits, _ . - only); set TMPDIR to one.")
