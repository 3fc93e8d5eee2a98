"""Certificates: JSON files with verified requirements and the SHA-256 of every file that they were verified on.

A certificate is bound to the content of each of these files, by SHA-256, and to its own: `seal` is the SHA-256 of the
rest of the file. The seal is a checksum and not a signature: it guards against accidents and edits by hand, not against
forgery, as anyone who can write the file can also compute a new seal.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softneck import __version__

from ._display import ReprMixin
from ._errors import CheckFailedError, DataError, FileFormatError
from ._files import MOST_JSON, file_hash, settings_text, write_text

CERTIFICATE_VERSION = 1
# The commands that write certificates.
CERTIFICATE_KINDS = ("verify", "simulate")
CERTIFICATE_ENDING = ".certificate.json"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_FOLDER = Path("build") / "certificates"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Certificate(ReprMixin):
    """A certificate as read from its file.

    Attributes:
        path: of the file.
        kind: "verify" or "simulate".
        holds: whether at least one requirement was checked and all of them hold.
        files: role -> (path, SHA-256) of every file that was read for it.
        contents: the whole JSON.
    """

    path: Path
    kind: str
    holds: bool
    files: Mapping[str, tuple[str, str]]
    contents: Mapping[str, Any]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The requirements or limits, each with "metric", "limit", "value" and "holds"."""
        return required_rows(self.contents)

    def failed_metrics(self) -> list[str]:
        """Return the requirements or limits that do not hold; those that were not computed (None) are left out."""
        verdicts = ((row, row.get("holds", False)) for row in self.rows)
        return [str(row.get("metric")) for row, holds in verdicts if holds is not None and not holds]


def required_rows(contents: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the requirements or limits in a certificate's JSON values."""
    rows = contents.get("requirements", contents.get("limits"))
    found = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return [{**row, "metric": sim_name(row["metric"])} if "metric" in row else row for row in found]


def certifies(contents: Mapping[str, Any]) -> bool:
    """Return whether a certificate's JSON values say that it holds, and that some requirement of it does."""
    return contents.get("holds") is True and any(row.get("holds") is True for row in required_rows(contents))


def sim_name(name: Any) -> Any:
    """Return the current name of a metric or table: up to softneck 0.2 `sim.*` was called `neck.*`."""
    return re.sub(r"^neck(?=\.|$)", "sim", name) if isinstance(name, str) else name


def certificate_contents(
    kind: str, *, holds: bool, files: Mapping[str, tuple[str, str]], more: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the JSON values of a certificate.

    `kind`: "verify" or "simulate". `holds`: whether all requirements hold. `files`: role -> (path, SHA-256) of every
    file that was read. `more`: further entries, JSON values only (no NaN, no infinity).
    """
    contents = {
        "certificate": kind,
        "certificate_version": CERTIFICATE_VERSION,
        "softneck": __version__,
        "holds": bool(holds),
        **more,
        "files": {role: {"path": path, "sha256": digest} for role, (path, digest) in files.items()},
    }
    return {**contents, "seal": _seal(contents)}


def write_certificate(path: str | Path, contents: Mapping[str, Any], *, force: bool = False) -> None:
    """Write the values of `certificate_contents` to a file, whole or not at all.

    Raises:
        OutputFileError: the file exists (and not `force`) or cannot be written.
    """
    write_text(path, json.dumps(contents, indent=2, allow_nan=False) + "\n", force=force)


def read_certificate(path: str | Path) -> Certificate:
    """Return the certificate in a file, whether or not its requirements hold.

    Raises:
        FileFormatError: no such file, not a certificate, of another version, or edited since it was written.
    """
    source = Path(path)
    try:
        contents = json.loads(settings_text(source, MOST_JSON))
    except FileNotFoundError as error:
        raise FileFormatError(f"{source}: no such certificate; `softneck verify` writes one.") from error
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise FileFormatError(f"{source}: is not a certificate (not JSON); `softneck verify` writes one.") from error
    if not isinstance(contents, dict) or contents.get("certificate") not in CERTIFICATE_KINDS:
        raise FileFormatError(f"{source}: is not a certificate; `softneck verify` and `softneck simulate` write them.")
    if contents.get("certificate_version") != CERTIFICATE_VERSION:
        raise FileFormatError(
            f"{source}: has certificate version {contents.get('certificate_version')}; this softneck reads "
            f"{CERTIFICATE_VERSION}. Verify again."
        )
    if contents.get("seal") != _seal({key: value for key, value in contents.items() if key != "seal"}):
        raise FileFormatError(f"{source}: was changed after it was written; verify again.")
    return Certificate(
        path=source,
        kind=contents["certificate"],
        holds=certifies(contents),
        files=_files(source, contents.get("files")),
        contents=contents,
    )


def check_certificate(path: str | Path, files: Iterable[str | Path], *, kind: str = "verify") -> Certificate:
    """Return the certificate if it holds and covers exactly these files, compared by content and not by path.

    Args:
        path: of the certificate.
        files: that must be covered, such as the controller and the observer to be used.
        kind: "verify" or "simulate": the command that must have written it.

    Raises:
        FileFormatError: not a certificate, damaged, or edited.
        CheckFailedError: a requirement does not hold, or a file has changed since or is not covered.
    """
    found = read_certificate(path)
    if found.kind != kind:
        raise CheckFailedError(
            f"{found.path}: is a certificate of `softneck {found.kind}`; one of `softneck {kind}` is needed."
        )
    if not found.rows:
        raise CheckFailedError(
            f"{found.path}: has no requirements, so it certifies nothing; set limits and run the command again."
        )
    if not found.holds:
        listed = ", ".join(found.failed_metrics()) or "a requirement"
        raise CheckFailedError(f"{found.path}: {listed} did not hold; fix the design and verify again.")
    digests = {digest for _, digest in found.files.values()}
    for item in map(Path, files):
        if not item.is_file():
            raise FileFormatError(f"{item}: no such file.")
        if file_hash(item) not in digests:
            changed = any(Path(name).name == item.name for name, _ in found.files.values())
            what = "was changed after it was certified" if changed else "is not what was certified"
            raise CheckFailedError(f"{item}: {what} (certificate {found.path}); run `softneck {kind}` on it.")
    return found


def certificate_path(controller: str | Path) -> Path:
    """Return the path of a controller file's certificate: beside the file, else where `verify` writes it.

    Beside `pi.npz` that is `pi.certificate.json`; without `-o`, `softneck verify` writes
    `build/certificates/pi.certificate.json`. The file need not exist.
    """
    source = Path(controller)
    beside = source.with_name(source.stem + CERTIFICATE_ENDING)
    return beside if beside.exists() else _FOLDER / beside.name


def _refuse(value: Any) -> None:
    raise DataError(f"a certificate cannot hold a {type(value).__name__}.")


def to_json(value: Any, other: Callable[[Any], Any] = _refuse) -> Any:
    """Convert numbers, arrays and tables to JSON values; numbers that are not finite become None.

    `other`: converts a value of any other type; by default DataError is raised.
    """
    if isinstance(value, Mapping):
        return {str(key): to_json(item, other) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_json(value.tolist(), other)
    if isinstance(value, list | tuple):
        return [to_json(item, other) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | bool | int) else other(value)


def _seal(contents: Mapping[str, Any]) -> str:
    text = json.dumps(contents, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _files(source: Path, table: Any) -> dict[str, tuple[str, str]]:
    files: dict[str, tuple[str, str]] = {}
    for role, entry in table.items() if isinstance(table, dict) else ():
        if isinstance(entry, dict) and _SHA256.fullmatch(str(entry.get("sha256"))):
            files[role] = (str(entry.get("path")), str(entry["sha256"]))
    if not files or len(files) != len(table):
        raise FileFormatError(f"{source}: names no files with their SHA-256; verify again.")
    return files
