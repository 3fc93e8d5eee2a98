"""A file is whole or absent, whatever happens while it is written."""

from __future__ import annotations

import errno
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from softneck.core import OutputFileError, atomic_write, file_hash, refuse_existing, write_archive
from softneck.signals import Recording, write_recording

from ..data import neck_recording


def test_the_file_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "folder" / "a.txt"
    with atomic_write(target) as temporary:
        temporary.write_text("half")
        assert not target.exists()
        assert temporary.parent == target.parent, "renaming is atomic within one folder only"
    assert target.read_text() == "half"
    assert [path.name for path in target.parent.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("failure", [ValueError("wrong"), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left")])
@pytest.mark.parametrize("existing", [True, False])
def test_a_failure_leaves_the_folder_as_it_was(tmp_path: Path, failure: BaseException, existing: bool) -> None:
    target = tmp_path / "a.txt"
    if existing:
        target.write_text("old")
    with pytest.raises((ValueError, KeyboardInterrupt, OutputFileError), match=r"wrong|^$|No space left"):
        _fail_halfway(target, failure)
    assert [path.name for path in tmp_path.iterdir()] == (["a.txt"] if existing else [])
    assert not existing or target.read_text() == "old"


def test_an_existing_file_is_replaced_by_force_only(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(OutputFileError, match=r"a\.txt: exists already; use --force"), atomic_write(target):
        pytest.fail("the body must not run")
    assert target.read_text() == "old"
    with atomic_write(target, force=True) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_a_folder_is_no_target_even_by_force(tmp_path: Path) -> None:
    with pytest.raises(OutputFileError, match="is a folder; name a file"):
        refuse_existing(tmp_path, force=True)


def test_a_path_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputFileError, match=r"x\.npz: cannot be written: .*Choose another folder"):
        write_archive(tmp_path / "file" / "x.npz", {}, {})


def test_a_folder_that_takes_no_files_is_one_clear_error() -> None:
    # Root may write everywhere but not into /proc.
    with pytest.raises(OutputFileError, match="cannot be written"):
        write_archive("/proc/x.npz", {}, {})


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # The last thing every writer does before its file is renamed.
    monkeypatch.setattr(Path, "chmod", full)
    target = tmp_path / f"a{suffix}"
    with pytest.raises(OutputFileError, match=r"No space left on device\. Nothing was left behind"):
        _write(target, neck_recording(120))
    assert list(tmp_path.iterdir()) == []


def _fail_halfway(target: Path, failure: BaseException) -> None:
    with atomic_write(target, force=True) as temporary:
        temporary.write_text("half a fi")
        raise failure


def _write(target: Path, recording: Recording) -> None:
    if target.suffix == ".npz":
        write_archive(target, {}, {"a": np.zeros(3)})
    else:
        write_recording(target, recording)


def test_a_new_file_obeys_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "a") as temporary:
            temporary.write_text("")
        # mkstemp's own mode, 0600, would hide the file from the user's group.
        assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


def test_the_hash_is_that_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"neck")
    assert file_hash(tmp_path / "a") == hashlib.sha256(b"neck").hexdigest()
