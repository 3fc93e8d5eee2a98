"""Certificates: what is written is read again; a changed file, a changed certificate, a failed one are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from softneck.core import (
    CheckFailedError,
    FileFormatError,
    OutputFileError,
    certifies,
    check_certificate,
    file_hash,
    read_certificate,
    write_certificate,
)
from softneck.core._certificate import certificate_contents, certificate_path


def _written(folder: Path, *, holds: bool = True, kind: str = "verify") -> tuple[Path, Path]:
    controller = folder / "pi.npz"
    controller.write_bytes(b"a controller")
    files = {"controller": (str(controller), file_hash(controller))}
    rows = [{"metric": "pitch.sensitivity", "holds": holds}]
    path = folder / "pi.certificate.json"
    contents = certificate_contents(kind, holds=holds, files=files, more={"requirements": rows})
    write_certificate(path, contents)
    return path, controller


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path, controller = _written(tmp_path)
    found = read_certificate(path)
    assert found.kind == "verify"
    assert found.holds
    assert found.files == {"controller": (str(controller), file_hash(controller))}
    assert check_certificate(path, [controller]).failed_metrics() == []


def test_a_file_counts_by_its_content_wherever_it_lies(tmp_path: Path) -> None:
    path, controller = _written(tmp_path)
    moved = tmp_path / "elsewhere.npz"
    controller.rename(moved)
    check_certificate(path, [moved])


def test_a_changed_file_is_refused(tmp_path: Path) -> None:
    path, controller = _written(tmp_path)
    controller.write_bytes(b"another controller")
    with pytest.raises(CheckFailedError, match="was changed after it was certified"):
        check_certificate(path, [controller])


def test_a_file_that_is_not_covered_is_refused(tmp_path: Path) -> None:
    path, controller = _written(tmp_path)
    other = tmp_path / "other.npz"
    other.write_bytes(b"other")
    with pytest.raises(CheckFailedError, match="not what was certified"):
        check_certificate(path, [controller, other])
    with pytest.raises(FileFormatError, match="no such file"):
        check_certificate(path, [tmp_path / "none.npz"])


def test_a_certificate_that_fails_is_read_but_does_not_pass(tmp_path: Path) -> None:
    path, controller = _written(tmp_path, holds=False)
    assert not read_certificate(path).holds
    with pytest.raises(CheckFailedError, match=r"pitch\.sensitivity did not hold"):
        check_certificate(path, [controller])


def test_a_certificate_of_a_simulation_is_none_of_a_verification(tmp_path: Path) -> None:
    path, controller = _written(tmp_path, kind="simulate")
    with pytest.raises(CheckFailedError, match="softneck verify"):
        check_certificate(path, [controller])
    check_certificate(path, [controller], kind="simulate")


def test_an_edited_certificate_is_refused(tmp_path: Path) -> None:
    path, controller = _written(tmp_path, holds=False)
    path.write_text(path.read_text(encoding="utf-8").replace('"holds": false', '"holds": true'), encoding="utf-8")
    with pytest.raises(FileFormatError, match="was changed after it was written"):
        check_certificate(path, [controller])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "not JSON"),
        ("[1]", "is not a certificate"),
        ('{"certificate": "else"}', "is not a certificate"),
        ('{"certificate": "verify", "certificate_version": 99}', "version 99"),
    ],
)
def test_what_is_no_certificate_is_refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=match):
        read_certificate(path)


def test_a_certificate_without_files_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    write_certificate(path, certificate_contents("verify", holds=True, files={}, more={}))
    with pytest.raises(FileFormatError, match="names no files"):
        read_certificate(path)
    with pytest.raises(OutputFileError, match="exists already"):
        write_certificate(path, {})


def test_the_certificate_is_looked_for_beside_the_controller(tmp_path: Path) -> None:
    assert certificate_path(tmp_path / "pi.npz") == Path("build/certificates/pi.certificate.json")
    path, controller = _written(tmp_path)
    assert certificate_path(controller) == path
    assert json.loads(path.read_text(encoding="utf-8"))["softneck"]


def test_a_certificate_without_requirements_and_a_row_without_a_verdict_certify_nothing(tmp_path: Path) -> None:
    path, controller = tmp_path / "none.json", tmp_path / "pi.npz"
    controller.write_bytes(b"a controller")
    files = {"controller": (str(controller), file_hash(controller))}
    write_certificate(path, certificate_contents("verify", holds=True, files=files, more={"requirements": []}))
    with pytest.raises(CheckFailedError, match="has no requirements, so it certifies nothing"):
        check_certificate(path, [controller])
    rows = [{"metric": "a", "holds": True}, {"metric": "b"}, {"metric": "c", "holds": None}]
    other = tmp_path / "rows.json"
    write_certificate(other, certificate_contents("verify", holds=False, files=files, more={"requirements": rows}))
    assert read_certificate(other).failed_metrics() == ["b"]


def test_a_changed_file_is_named_so_beside_one_of_another_name(tmp_path: Path) -> None:
    one, two, path = tmp_path / "pi.npz", tmp_path / "kalman.npz", tmp_path / "both.json"
    for file in (one, two):
        file.write_bytes(file.name.encode())
    files = {file.stem: (str(file), file_hash(file)) for file in (one, two)}
    rows = [{"metric": "a", "holds": True}]
    write_certificate(path, certificate_contents("verify", holds=True, files=files, more={"requirements": rows}))
    one.write_bytes(b"another")
    with pytest.raises(CheckFailedError, match=r"pi\.npz: was changed after it was certified"):
        check_certificate(path, [one, two])


@pytest.mark.parametrize("key", ["requirements", "limits"])
@pytest.mark.parametrize(
    ("said", "rows", "holds"),
    [(True, [True], True), (True, [None, True], True), (True, [None, None], False), (True, [], False),
     (False, [True], False), (1, [True], False), (None, [True], False), (True, [1], False), (True, [False], False)],
)  # fmt: skip
def test_a_certificate_certifies_where_it_says_so_and_something_in_it_holds(
    key: str, said: Any, rows: list[Any], holds: bool
) -> None:
    assert certifies({"holds": said, key: [{"metric": "m", "holds": one} for one in rows]}) is holds
    assert not certifies({"holds": said})
