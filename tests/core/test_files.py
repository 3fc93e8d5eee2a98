"""A file is whole or absent, whatever happens while it is written."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from softneck.core import OutputFileError, atomic_write, file_hash, refuse_existing, write_archive
from softneck.signals import Recording, write_recording

from ..data import ROOT, neck_recording


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


def test_where_nothing_can_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    refuse_existing(tmp_path / "new" / "deep" / "x.npz", force=False)
    with pytest.raises(OutputFileError, match=r"x\.npz: cannot be written: Not a directory\. Choose another folder"):
        refuse_existing(tmp_path / "file" / "x.npz", force=True)
    # Root may write everywhere, so that modes of folders say nothing where tests run.
    monkeypatch.setattr(os, "access", lambda path, _mode: Path(path) != tmp_path)
    for target in (tmp_path / "x.npz", tmp_path / "new" / "deep" / "x.npz"):
        with pytest.raises(OutputFileError, match=r"x\.npz: cannot be written: Permission denied"):
            refuse_existing(target, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_that_takes_no_files_is_one_clear_error() -> None:
    # Root may write everywhere but not into /proc.
    with pytest.raises(OutputFileError, match="cannot be written"):
        write_archive("/proc/x.npz", {}, {})


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # The last thing every writer does before its file is renamed.
    monkeypatch.setattr(os, "fsync", full)
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


def test_a_writer_within_a_writer_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputFileError, match=re.escape(f"{tmp_path / 'm.npz'}: cannot be written: No space left")),
        atomic_write(tmp_path / "m.npz") as outer,
        atomic_write(outer, force=True),
    ):
        raise OSError(errno.ENOSPC, "No space left")
    assert list(tmp_path.iterdir()) == []


def test_a_new_file_obeys_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "a") as temporary:
            temporary.write_text("")
        # A mode of 0600 would hide the file from the user's group.
        assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


def test_the_hash_is_that_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"neck")
    assert file_hash(tmp_path / "a") == hashlib.sha256(b"neck").hexdigest()


def test_no_other_thread_ever_sees_another_umask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The umask is one for the process: a thread that makes a file meanwhile would make it for everybody."""
    monkeypatch.setattr(os, "umask", lambda _mask: pytest.fail("the umask was changed"))
    with atomic_write(tmp_path / "a") as temporary:
        temporary.write_text("")


def test_file_and_folder_are_on_the_disk_before_and_after_the_name_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, str]] = []
    sync = os.fsync

    def noted(descriptor: int) -> None:
        target = tmp_path / "a"
        seen.append(
            (str(Path(f"/proc/self/fd/{descriptor}").readlink()), target.read_text() if target.exists() else "absent")
        )
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", noted)
    with atomic_write(tmp_path / "a") as temporary:
        temporary.write_text("whole")
    assert seen == [(str(temporary), "absent"), (str(tmp_path), "whole")]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_is_followed_and_stays(tmp_path: Path, there: bool) -> None:
    (tmp_path / "far").mkdir()
    real, link = tmp_path / "far" / "real.txt", tmp_path / "link.txt"
    link.symlink_to("far/real.txt")
    if there:
        real.write_text("old")
        with pytest.raises(OutputFileError, match=r"link\.txt: exists already"), atomic_write(link):
            pytest.fail("the body must not run")
    with atomic_write(link, force=there) as temporary:
        assert temporary.parent == real.parent, "renaming is atomic within one folder only"
        temporary.write_text("new")
    assert link.is_symlink()
    assert (real.read_text(), real.is_symlink()) == ("new", False)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["far", "link.txt", "real.txt"]


def test_links_in_a_circle_and_to_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OutputFileError, match=r"a: cannot be written"), atomic_write(tmp_path / "a", force=True):
        pytest.fail("the body must not run")
    (tmp_path / "folder").symlink_to(tmp_path)
    with pytest.raises(OutputFileError, match="is a folder; name a file"), atomic_write(tmp_path / "folder"):
        pytest.fail("the body must not run")


_KILLED = """
import os, signal, sys
from softneck.core import atomic_write
with atomic_write(sys.argv[1], force=True) as temporary:
    temporary.write_text("half a fi")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_is_swept_by_the_next_write_and_nothing_else_is(tmp_path: Path) -> None:
    target = tmp_path / "model.npz"
    target.write_text("old")
    for _ in range(2):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", _KILLED, target], env=environment, check=False)
        assert done.returncode == -signal.SIGKILL
        # The target is as it was; the second process swept what the first one left.
        assert target.read_text() == "old"
        assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / ".hidden-softneck.npz").write_text("somebody's")
    (tmp_path / "seen-softneck-1.npz").write_text("somebody's")
    with atomic_write(tmp_path / "one") as one:
        one.write_text("still at work")
        with atomic_write(tmp_path / "two") as two:  # a file of any other name in that folder
            two.write_text("")
        assert one.read_text() == "still at work"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".hidden-softneck.npz", "model.npz", "one", "seen-softneck-1.npz", "two",
    ]  # fmt: skip


def test_a_temporary_that_is_swept_while_it_begins_begins_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, swept = fcntl.flock, []

    def late(descriptor: int, how: int) -> None:
        lock(descriptor, how)
        if not swept:  # another process had the lock first
            swept.extend(tmp_path.iterdir())
            swept[0].unlink()

    monkeypatch.setattr(fcntl, "flock", late)
    with atomic_write(tmp_path / "a") as temporary:
        temporary.write_text("whole")
    assert swept != [temporary]
    assert (tmp_path / "a").read_text() == "whole"


def test_many_processes_may_write_one_file_at_once(tmp_path: Path) -> None:
    """Each sweeps while the others begin: none loses its temporary file, and the last whole one stands."""
    code = (
        "import sys; from softneck.core import atomic_write\n"
        "for k in range(60):\n"
        "    with atomic_write(sys.argv[1], force=True) as t: t.write_text(sys.argv[2] * 1000)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    runs = [subprocess.Popen([sys.executable, "-c", code, tmp_path / "a", letter], env=environment) for letter in "xyz"]
    assert [run.wait() for run in runs] == [0, 0, 0]
    assert (tmp_path / "a").read_text() in {letter * 1000 for letter in "xyz"}
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_link_that_waits_under_the_temporary_s_name_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder that others may write to: what it points to is not ours."""
    monkeypatch.setattr("secrets.token_hex", lambda _size: "00000000")
    (tmp_path / "theirs").write_text("somebody's")
    (tmp_path / ".a-softneck-00000000").symlink_to("theirs")
    with pytest.raises(OutputFileError, match="a: cannot be written: File exists"), atomic_write(tmp_path / "a"):
        pytest.fail("the body must not run")
    assert (tmp_path / "theirs").read_text() == "somebody's"


def test_ctrl_c_while_a_temporary_file_is_made_leaves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen at the first file of a project: the next run refused its folder as not empty."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(fcntl, "flock", interrupted)
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.json"):
        pass
    assert list(tmp_path.iterdir()) == []
