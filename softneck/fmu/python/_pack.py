"""Zip archives whose bytes follow from their content alone."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from softneck.core import SettingsError

# PKWARE's APPNOTE 6.3: local header, entry of the directory, end of the directory.
_LOCAL, _ENTRY, _END = "<4s5H3L2H", "<4s6H3L5H2L", "<4s4H2LH"
_VERSION, _UNIX, _UTF8, _STORED, _DEFLATED = 20, 3 << 8, 1 << 11, 0, 8
# 1980-01-01, the first moment that an entry can carry; rw-r--r-- of a plain file.
_TIME, _DATE, _RIGHTS = 0, 33, 0o100644 << 16
# Measured numbers hardly deflate: a tree of 1,000,000 points loses 11 % in 20 s. Beyond this many bytes they stay as
# they are; what is beyond the other one needs the 64-bit headers that not every host reads.
_LARGE, _MOST = 1 << 24, (1 << 32) - 2  # a size of 2^32 - 1 says: see the 64-bit header


def deflated(data: bytes) -> bytes:
    """Return `data` as a raw deflate stream."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def write_zip(path: Path, members: Mapping[str, bytes], streams: Mapping[bytes, bytes] | None = None) -> None:
    """Write `members` (archive name -> content) to `path`: sorted, deflated, with fixed times and rights.

    `streams` holds content that was deflated before (by a slower, better packer); zipfile would not take it.

    Raises:
        SettingsError: more than 4 GB.
    """
    if sum(map(len, members.values())) > _MOST:
        raise SettingsError(f"{path.name}: would hold more than 4 GB, which not every host reads; fit fewer points.")
    directory, offset = [], 0
    with path.open("wb") as file:
        for name in sorted(members):
            data, title = members[name], name.encode()
            large = len(data) > _LARGE
            packed = data if large else (streams or {}).get(data) or deflated(data)
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
    """Return the files of an archive that we have just written ourselves."""
    with zipfile.ZipFile(path) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist() if not entry.is_dir()}
