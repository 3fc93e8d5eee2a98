"""FMUs as ZIP archives: reproducible writing, and unpacking into folders with plain paths.

pythonfmu's binary decodes only `%20` in the path it gets and crashes the process on `+`, `#`, `%`,
parentheses or accents in it, so the folder must have a plain path; the FMU itself may have any path.
"""

from __future__ import annotations

import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from softneck.core import FileFormatError, OutputFileError, SettingsError, open_zip, require_file

# PKWARE's APPNOTE 6.3: local header, entry of the directory, end of the directory.
_LOCAL, _ENTRY, _END = "<4s5H3L2H", "<4s6H3L5H2L", "<4s4H2LH"
_VERSION, _UNIX, _UTF8, _STORED, _DEFLATED = 20, 3 << 8, 1 << 11, 0, 8
# 1980-01-01, the earliest date of an entry; rights rw-r--r-- of a plain file.
_TIME, _DATE, _RIGHTS = 0, 33, 0o100644 << 16
# Measured numbers hardly compress: a tree of 1,000,000 points by 11 % in 20 s. Members beyond the first size [bytes]
# are stored; beyond the second an archive needs 64-bit headers, which not every host reads.
_LARGE, _MOST = 1 << 24, (1 << 32) - 2  # a size of 2^32 - 1 refers to the 64-bit header


def deflate(data: bytes) -> bytes:
    """Return `data` as a raw deflate stream."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def write_zip(path: Path, members: Mapping[str, bytes], streams: Mapping[bytes, bytes] | None = None) -> None:
    """Write `members` (archive name -> content) to `path`: sorted, deflated, with fixed times and rights.

    `streams` has content that is already deflated (by a slower, better compressor), which zipfile does not accept.
    Raises SettingsError: more than 4 GB.
    """
    if sum(map(len, members.values())) > _MOST:
        raise SettingsError(f"{path.name}: would have more than 4 GB, which not every host reads; fit fewer points.")
    directory, offset = [], 0
    with path.open("wb") as file:
        for name in sorted(members):
            data, title = members[name], name.encode()
            large = len(data) > _LARGE
            packed = data if large else (streams or {}).get(data) or deflate(data)
            sizes = (zlib.crc32(data), len(packed), len(data), len(title), 0)
            common = (_VERSION, _UTF8, _STORED if large else _DEFLATED, _TIME, _DATE, *sizes)
            file.write(struct.pack(_LOCAL, b"PK\3\4", *common) + title)
            file.write(packed)
            rest = (0, 0, 0, _RIGHTS, offset)
            directory.append(struct.pack(_ENTRY, b"PK\1\2", _UNIX | _VERSION, *common, *rest) + title)
            offset = file.tell()
        count, size = len(directory), sum(map(len, directory))
        file.write(b"".join(directory) + struct.pack(_END, b"PK\5\6", 0, 0, count, count, size, offset, 0))


def read_zip(path: Path) -> dict[str, bytes]:
    """Return the files of an archive written by softneck itself."""
    with zipfile.ZipFile(path) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist() if not entry.is_dir()}


_PLAIN = re.compile(r"[A-Za-z0-9_./\\:~-]+")


def unpack(path: str | Path, *, main: str = "modelDescription.xml", what: str = "an FMU") -> Path:
    """Unpack an FMU, or another archive with a member `main`, into a new folder with a plain path and return that.

    The caller removes the folder.

    Raises:
        FileFormatError: not an FMU, or one with members outside the folder or too large.
    """
    source = Path(path)
    require_file(source)
    try:
        with open_zip(source) as archive:
            _check_members(source, archive, main, what)
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
    except Exception as error:  # damaged bytes raise all kinds of errors in zipfile and its decompressors
        raise FileFormatError(f"{source}: is not {what} or is damaged ({error}).") from error
    return folder


@contextmanager
def unpacked(path: str | Path) -> Iterator[Path]:
    """Yield the folder that `unpack` makes and remove it afterwards."""
    folder = unpack(path)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check_members(source: Path, archive: zipfile.ZipFile, main: str, what: str) -> None:
    entries = archive.infolist()
    for entry in entries:
        name = PurePosixPath(entry.orig_filename)
        if name.is_absolute() or ".." in name.parts or "\\" in entry.orig_filename or ":" in entry.orig_filename:
            raise FileFormatError(
                f"{source}: its member `{entry.orig_filename}` would be outside the folder; not unpacked."
            )
    if main not in archive.namelist():
        raise FileFormatError(f"{source}: is not {what}: it has no {main}.")


def _plain_folder() -> Path:
    for folder in (tempfile.gettempdir(), "/tmp", "/var/tmp", str(Path.home())):
        if _PLAIN.fullmatch(folder) and Path(folder).is_dir():
            return Path(folder)
    raise OutputFileError("no temporary folder has a plain path (letters, digits, _ . - only); set TMPDIR to one.")
