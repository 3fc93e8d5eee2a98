"""Zip archives whose bytes follow from their content alone."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

# The first moment a zip entry can carry.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_zip(path: Path, members: Mapping[str, bytes]) -> None:
    """Write `members` (archive name -> content) to `path`: sorted, deflated, with fixed times and rights."""
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(members):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # Unix on every machine
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, members[name], compresslevel=9)


def read_zip(path: Path) -> dict[str, bytes]:
    """Return the files of an archive that we have just written ourselves."""
    with zipfile.ZipFile(path) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist() if not entry.is_dir()}
