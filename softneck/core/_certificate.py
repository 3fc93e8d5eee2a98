"""Certificates: JSON files that say what held, on which files, and whether those are still the same.

A certificate is bound to the content of each file that it was made from, by SHA-256, and to itself: `seal` is the
SHA-256 of all else that stands in it. The seal is a checksum and no signature: it guards against accidents and edits by
hand, not against forgers, for whoever can write the file can seal it again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck import __version__

from ._budget import MOST_JSON, settings_text
from ._errors import CheckFailedError, FileFormatError
from ._files import atomic_write, file_hash
from ._shown import Shown

CERTIFICATE_VERSION = 1
# The commands that write certificates.
CERTIFICATE_KINDS = ("verify", "simulate")
CERTIFICATE_ENDING = ".certificate.json"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_FOLDER = Path("build") / "certificates"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Certificate(Shown):
    """What a certificate says: whether all held, and for which files.

    Attributes:
        path: of the file.
        kind: "verify" or "simulate".
        holds: whether something was required, and all of it held.
        files: role -> (path, SHA-256) of every file that was read for it.
        contents: all of the JSON.
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

    def failed(self) -> list[str]:
        """Return the names of the requirements or limits that did not hold; one that is None was not computed."""
        judged = (row for row in self.rows if row.get("holds", False) is not None)
        return [str(row.get("metric")) for row in judged if not row.get("holds")]


def required_rows(contents: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the requirements or limits in a certificate's JSON values; one without any certifies nothing."""
    rows = contents.get("requirements", contents.get("limits"))
    found = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return [{**row, "metric": sim_name(row["metric"])} if "metric" in row else row for row in found]


def sim_name(name: Any) -> Any:
    """Return the name of a metric or table: what is `sim.*` of any robot was `neck.*` up to softneck 0.2."""
    return re.sub(r"^neck(?=\.|$)", "sim", name) if isinstance(name, str) else name


def certificate_contents(
    kind: str, *, holds: bool, files: Mapping[str, tuple[str, str]], more: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the JSON values of a certificate.

    Args:
        kind: "verify" or "simulate".
        holds: whether all that was required held.
        files: role -> (path, SHA-256) of every file that was read.
        more: what else it says, JSON values only (no NaN, no infinity).
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
    """Write what `certificate_contents` returned, in one piece.

    Raises:
        OutputFileError: the file exists (and not `force`) or cannot be written.
    """
    with atomic_write(path, force=force) as temporary:
        temporary.write_text(json.dumps(contents, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def read_certificate(path: str | Path) -> Certificate:
    """Return the certificate in a file, whether or not what it asks for held.

    Raises:
        FileFormatError: no such file, no certificate, of another version, or edited since it was written.
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
        holds=contents.get("holds") is True and bool(required_rows(contents)),
        files=_files(source, contents.get("files")),
        contents=contents,
    )


def check_certificate(path: str | Path, files: Iterable[str | Path], *, kind: str = "verify") -> Certificate:
    """Return the certificate if it holds and was made from exactly these files, by content and wherever they lie.

    Args:
        path: of the certificate.
        files: that must be covered, such as the controller and the observer that are about to be used.
        kind: "verify" or "simulate": which command must have written it.

    Raises:
        FileFormatError: no certificate, damaged, or edited.
        CheckFailedError: something required does not hold, or a file was changed since or is not covered.
    """
    found = read_certificate(path)
    if found.kind != kind:
        raise CheckFailedError(
            f"{found.path}: is a certificate of `softneck {found.kind}`; one of `softneck {kind}` is needed."
        )
    if not found.rows:
        raise CheckFailedError(f"{found.path}: requires nothing, so it shows nothing; state limits and make it again.")
    if not found.holds:
        listed = ", ".join(found.failed()) or "something required"
        raise CheckFailedError(f"{found.path}: says that {listed} did not hold; mend the design and verify again.")
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
    """Return where the certificate of a controller file is looked for: beside it, else where `verify` writes it.

    Beside `pi.npz` that is `pi.certificate.json`; without `-o`, `softneck verify` writes
    `build/certificates/pi.certificate.json`. The file need not exist.
    """
    source = Path(controller)
    beside = source.with_name(source.stem + CERTIFICATE_ENDING)
    return beside if beside.exists() else _FOLDER / beside.name


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
