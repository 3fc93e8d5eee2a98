"""FMUs are unpacked to plain paths, and archives that reach out of their folder are not unpacked at all."""

from __future__ import annotations

import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import pytest

from softneck.core import FileFormatError
from softneck.fmu import unpack, unpacked


@pytest.mark.parametrize("folder", ["with space", "a+b", "a#b", "50%", "100%20", "é", "(x)", "[y]"])
def test_the_fmu_s_own_path_does_not_matter(folder: str, lag_fmu: Path, tmp_path: Path, running: Any) -> None:
    place = tmp_path / folder
    place.mkdir()
    path = place / "Lag.fmu"
    path.write_bytes(lag_fmu.read_bytes())
    with running(path) as fmu:
        fmu.begin(pitch_start=0.2)
        assert fmu.get("pitch") == [0.2]


@pytest.mark.parametrize("bad", ["a b", "é", "x+y", "p%q"])
def test_a_temporary_folder_with_an_unsafe_path_is_not_used(
    bad: str, lag_fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / bad).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / bad))
    with unpacked(lag_fmu) as folder:
        assert re.fullmatch(r"[A-Za-z0-9_./-]+", str(folder))
        assert (folder / "modelDescription.xml").is_file()
    assert not folder.exists()


@pytest.mark.parametrize("name", ["../evil.txt", "a/../../evil.txt", "/etc/evil", "C:/evil", "a\\..\\evil"])
def test_members_that_reach_out_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "Evil.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<x/>")
        archive.writestr(name, "evil")
    with pytest.raises(FileFormatError, match="would be outside the folder"):
        unpack(path)


def test_an_archive_that_would_fill_the_disk_is_refused(lag_fmu: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.core._files.MOST_UNPACKED", 1000)
    with pytest.raises(FileFormatError, match="unpacks to"):
        unpack(lag_fmu)


def test_what_is_no_fmu_is_said_so(lag_fmu: Path, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        unpack(tmp_path / "absent.fmu")
    text = tmp_path / "text.fmu"
    text.write_text("no zip")
    with pytest.raises(FileFormatError, match="is not an FMU or is damaged"):
        unpack(text)
    other = tmp_path / "other.fmu"
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FileFormatError, match=r"has no modelDescription\.xml"):
        unpack(other)
    cut = tmp_path / "cut.fmu"
    cut.write_bytes(lag_fmu.read_bytes()[:-2000])
    with pytest.raises(FileFormatError, match="is not an FMU or is damaged"):
        unpack(cut)
    flipped = bytearray(lag_fmu.read_bytes())
    flipped[5000:5100] = bytes(100)
    cut.write_bytes(bytes(flipped))
    before = set(Path(tempfile.gettempdir()).glob("softneck-unpacked-*"))
    with pytest.raises(FileFormatError, match="is not an FMU or is damaged"):
        unpack(cut)
    assert set(Path(tempfile.gettempdir()).glob("softneck-unpacked-*")) == before
