"""Files of version 1 as they were written once, byte by byte here: what reads and checks them must not change."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import (
    CheckFailedError,
    FileFormatError,
    OutputFileError,
    check_certificate,
    read_archive,
    read_certificate,
)
from softneck.core._archive import is_archive, write_archive
from softneck.core._certificate import certificate_contents, certificate_path, write_certificate
from softneck.core._files import MOST_UNPACKED

DIGEST = hashlib.sha256(b"a controller").hexdigest()


def sealed(contents: dict[str, Any]) -> str:
    """Return a certificate's text with the seal that the format asks for: SHA-256 of the rest, keys sorted."""
    text = json.dumps(contents, sort_keys=True, separators=(",", ":"))
    return json.dumps({**contents, "seal": hashlib.sha256(text.encode()).hexdigest()})


def certificate(**changes: Any) -> dict[str, Any]:
    return {
        "certificate": "verify", "certificate_version": 1, "softneck": "0.1", "holds": True,
        "requirements": [{"metric": "a", "holds": True}],
        "files": {"controller": {"path": "somewhere/pi.npz", "sha256": DIGEST}}, **changes,
    }  # fmt: skip


@pytest.fixture
def controller(tmp_path: Path) -> Path:
    path = tmp_path / "pi.npz"
    path.write_bytes(b"a controller")
    return path


def test_an_archive_of_version_1_is_read_and_written(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    text = json.dumps({"format": "softneck", "format_version": 1, "kind": "x"}).encode()
    np.savez(path, header=np.frombuffer(text, dtype=np.uint8), a=np.arange(3.0))
    header, arrays = read_archive(path)
    assert header == {"format": "softneck", "format_version": 1, "kind": "x"}
    np.testing.assert_array_equal(arrays["a"], [0.0, 1.0, 2.0])
    write_archive(tmp_path / "b.npz", {"kind": "x"}, {"a": np.arange(3.0)})
    with np.load(tmp_path / "b.npz", allow_pickle=False) as file:
        assert json.loads(file["header"].tobytes()) == {**header, "shapes": {"a": [3]}}
    assert read_archive(tmp_path / "b.npz")[0] == header
    # Compressed: zeros take no room.
    write_archive(tmp_path / "c.npz", {}, {"a": np.zeros(100_000)})
    assert (tmp_path / "c.npz").stat().st_size < 10_000


@pytest.mark.parametrize("version", [0, 2, "1", None])
def test_archives_of_other_versions_are_refused(tmp_path: Path, version: object) -> None:
    path = tmp_path / "a.npz"
    text = json.dumps({"format": "softneck", "format_version": version}).encode()
    np.savez(path, header=np.frombuffer(text, dtype=np.uint8))
    with pytest.raises(FileFormatError, match="version"):
        read_archive(path)


def told(version: int = 1, **more: Any) -> np.ndarray:
    text = json.dumps({"format": "softneck", "format_version": version, **more}).encode()
    return np.frombuffer(text, dtype=np.uint8)


def test_every_member_of_an_archive_is_an_array_of_real_numbers(tmp_path: Path) -> None:
    for name, array in (("complex", np.array([1j])), ("text", np.array(["a"])), ("date", np.array(["2026"], "M8[Y]"))):
        np.savez(tmp_path / f"{name}.npz", header=told(), good=np.zeros(2), bad=array)
        with pytest.raises(FileFormatError, match="its member `bad` is not an array of numbers"):
            read_archive(tmp_path / f"{name}.npz")
    path = tmp_path / "raw.npz"
    np.savez(path, header=told())
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("bad", b"1 2 3")
    with pytest.raises(FileFormatError, match="its member `bad` is not an array of numbers"):
        read_archive(path)
    np.savez(path, header=told(), i=np.arange(2), u=np.arange(2, dtype="u1"), b=np.array([True]), f=np.zeros(1, "f4"))
    assert [array.dtype.kind for array in read_archive(path)[1].values()] == ["i", "u", "b", "f"]


@pytest.mark.parametrize(
    ("shapes", "wrong"),
    [({"a": [3], "b": [2]}, "`b` has shape [1] and was written with [2]"),
     ({"a": [3, 1], "b": [1]}, "`a` has shape [3] and was written with [3, 1]"),
     ({"a": [3]}, "`b` has shape [1] and was written with None"),
     ({"a": [3], "b": [1], "c": []}, "`c` has shape None and was written with []"), (5, "`a` has shape [3]")],
)  # fmt: skip
def test_each_array_has_the_shape_that_it_was_written_with(tmp_path: Path, shapes: object, wrong: str) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, header=told(shapes=shapes), a=np.zeros(3), b=np.zeros(1))
    with pytest.raises(FileFormatError) as caught:
        read_archive(path)
    assert wrong in str(caught.value)


def test_a_header_is_read_up_to_its_greatest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, header=told())
    monkeypatch.setattr("softneck.core._archive.MOST_JSON", told().nbytes)
    assert read_archive(path) == ({"format": "softneck", "format_version": 1}, {})
    monkeypatch.setattr("softneck.core._archive.MOST_JSON", told().nbytes - 1)
    with pytest.raises(FileFormatError, match=f"its header has {told().nbytes} bytes"):
        read_archive(path)


def test_only_a_zip_archive_without_our_header_is_known_to_be_none_of_ours(tmp_path: Path) -> None:
    ours, other, damaged = (tmp_path / name for name in ("ours.npz", "other.npz", "damaged.npz"))
    write_archive(ours, {}, {"a": np.zeros(2)})
    np.savez(other, a=np.zeros(2))
    damaged.write_bytes(ours.read_bytes()[:-30])
    assert [is_archive(path) for path in (ours, other, damaged, tmp_path, tmp_path / "none")] == [
        True, False, True, True, True,
    ]  # fmt: skip
    with pytest.raises(FileFormatError, match="damaged; expected a model, family, controller or observer"):
        read_archive(damaged)
    with pytest.raises(OutputFileError, match="exists"):
        write_archive(ours, {}, {})


@pytest.mark.parametrize(("size", "refused"), [(0, False), (1, True)])
def test_two_gibibytes_are_the_most_that_an_archive_may_unpack_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int, refused: bool
) -> None:
    """The sum over all members counts; it is what the directory says, before anything is unpacked."""
    path = tmp_path / "a.npz"
    write_archive(path, {}, {"a": np.arange(3.0), "b": np.arange(3.0)})
    listed = zipfile.ZipFile.infolist

    def enormous(file: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
        entries = listed(file)
        rest = sum(entry.file_size for entry in entries[1:])
        entries[0].file_size = 2 * 2**30 - rest + size
        return entries

    assert MOST_UNPACKED == 2 * 2**30
    # What is packed as well as this is a bomb by its ratio; here the sum decides.
    monkeypatch.setattr("softneck.core._files._MOST_RATIO", 2**31)
    monkeypatch.setattr("softneck.core._files.available_bytes", lambda: None)
    monkeypatch.setattr(zipfile.ZipFile, "infolist", enormous)
    if refused:
        with pytest.raises(FileFormatError, match="unpacks"):
            read_archive(path)
    else:
        assert sorted(read_archive(path)[1]) == ["a", "b"]


def test_a_certificate_of_version_1_is_read_whatever_made_it(tmp_path: Path, controller: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text(sealed(certificate()), encoding="utf-8")
    found = read_certificate(path)
    assert (found.path, found.kind, found.holds) == (path, "verify", True)
    assert found.files == {"controller": ("somewhere/pi.npz", DIGEST)}
    assert check_certificate(path, [controller]).contents["softneck"] == "0.1"


def test_what_is_written_is_of_version_1_and_sealed(tmp_path: Path) -> None:
    contents = certificate_contents("simulate", holds=False, files={"loop": ("a.toml", DIGEST)}, more={"x": [1.5]})
    assert contents["certificate_version"] == 1
    rest = {key: value for key, value in contents.items() if key != "seal"}
    assert json.loads(sealed(rest)) == contents
    assert contents["files"] == {"loop": {"path": "a.toml", "sha256": DIGEST}}
    assert contents["x"] == [1.5]
    write_certificate(tmp_path / "c.json", contents)
    text = (tmp_path / "c.json").read_text(encoding="utf-8")
    assert json.loads(text) == contents
    assert text.startswith('{\n  "certificate": "simulate",\n')
    with pytest.raises(ValueError, match="JSON compliant"):
        write_certificate(tmp_path / "d.json", {"x": float("nan")})


@pytest.mark.parametrize(
    "changes",
    [
        {"certificate_version": 0},
        {"certificate_version": 2},
        {"certificate": "deploy"},
        {"files": {}},
        {"files": []},
        {"files": {"controller": {"path": "pi.npz", "sha256": DIGEST[:-1]}}},
        {"files": {"controller": {"path": "pi.npz", "sha256": DIGEST + "0"}}},
        {"files": {"controller": {"path": "pi.npz"}}},
        {"files": {"controller": DIGEST}},
        # One that is named rightly does not make up for one that is not.
        {"files": {"controller": {"path": "pi.npz", "sha256": DIGEST}, "observer": {"path": "kf.npz"}}},
    ],
)
def test_a_sealed_certificate_that_says_too_little_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = tmp_path / "c.json"
    path.write_text(sealed(certificate(**changes)), encoding="utf-8")
    with pytest.raises(FileFormatError):
        read_certificate(path)


@pytest.mark.parametrize("change", [{"holds": False}, {"softneck": "0.2"}, {"more": 1}, {"seal": ""}])
def test_any_edit_breaks_the_seal(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "c.json"
    path.write_text(json.dumps({**json.loads(sealed(certificate())), **change}), encoding="utf-8")
    with pytest.raises(FileFormatError):
        read_certificate(path)


@pytest.mark.parametrize("holds", [False, None, 1, "true"])
def test_only_true_holds(tmp_path: Path, controller: Path, holds: object) -> None:
    path = tmp_path / "c.json"
    path.write_text(sealed(certificate(holds=holds)), encoding="utf-8")
    assert read_certificate(path).holds is False
    with pytest.raises(CheckFailedError):
        check_certificate(path, [controller])


def test_the_rows_that_failed_are_named_in_their_order(tmp_path: Path) -> None:
    rows = [
        {"metric": "a", "holds": True},
        {"metric": "b", "holds": False},
        {"metric": "c"},
        {"metric": "open", "holds": None},
        "no row",
    ]
    for key in ("requirements", "limits"):
        changed = certificate(holds=False)
        del changed["requirements"]
        path = tmp_path / f"{key}.json"
        path.write_text(sealed({**changed, key: rows}), encoding="utf-8")
        assert read_certificate(path).failed_metrics() == ["b", "c"]


def test_metrics_of_earlier_versions_have_their_names_of_today(tmp_path: Path) -> None:
    rows = [{"metric": name, "holds": True} for name in ("neck.slack_s", "neck", "necks.a", "a.neck.b", 5)]
    path = tmp_path / "c.json"
    path.write_text(sealed(certificate(requirements=[*rows, {"holds": True}])), encoding="utf-8")
    found = read_certificate(path).rows
    assert [row.get("metric") for row in found] == ["sim.slack_s", "sim", "necks.a", "a.neck.b", 5, None]
    with pytest.raises(FileFormatError, match="no such certificate"):
        read_certificate(tmp_path / "none.json")


def test_a_certificate_lies_beside_its_controller_or_where_verify_writes(tmp_path: Path, controller: Path) -> None:
    assert certificate_path(controller) == Path("build", "certificates", "pi.certificate.json")
    beside = tmp_path / "pi.certificate.json"
    beside.write_text("", encoding="utf-8")
    assert certificate_path(controller) == beside
