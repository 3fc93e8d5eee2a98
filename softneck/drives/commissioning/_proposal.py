"""The files of a commissioning: proposed drives and robot file, and the page."""

from __future__ import annotations

import tempfile
from pathlib import Path

import tomli_w

from softneck.core import OutputFileError, atomic_write, refuse_existing
from softneck.plots import write_page

from ..bus._write import drives_table
from ._commission import Commissioned
from ._commission_page import commission_page

DRIVES, ROBOT, PAGE = "drives.toml", "robot.toml", "commission.html"
_REMARK = "# Proposed by `softneck drives commission`; look at commission.html before it is used.\n"


def require_folder(folder: Path, *, force: bool) -> None:
    """Raise where the files of a commissioning could not be written; before anything moves.

    Raises:
        OutputFileError: a file exists and not `force`, or the folder cannot be written.
    """
    for name in (DRIVES, ROBOT, PAGE):
        refuse_existing(folder / name, force=force)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFileError(
            f"{folder}: cannot be written: {error.strerror}. Choose another folder; nothing was sent."
        ) from error


def write_files(folder: Path, result: Commissioned, *, force: bool) -> dict[str, str]:
    """Write proposal and page; return what -> path. Where nothing moved there is nothing to propose but the page."""
    written = {"page": folder / PAGE}
    if result.moves is None:
        # What an earlier one proposed does not belong to this page.
        for name in (DRIVES, ROBOT) if force else ():
            (folder / name).unlink(missing_ok=True)
    else:
        # All in memory before the first is written.
        texts = {DRIVES: tomli_w.dumps(drives_table(result.file)), ROBOT: tomli_w.dumps(result.robot.as_dict())}
        for name, text in texts.items():
            with atomic_write(folder / name, force=force) as temporary:
                temporary.write_text(_REMARK + text, encoding="utf-8")
        written = {"drives": folder / DRIVES, "robot": folder / ROBOT, **written}
    write_page(folder / PAGE, commission_page(result), force=force)
    return {what: str(path) for what, path in written.items()}
