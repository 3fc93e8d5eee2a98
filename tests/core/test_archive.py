"""Our binary file form: what goes in comes out, and nothing else is taken for it."""

from __future__ import annotations

import contextlib
import json
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from softneck.core import FileFormatError, load, read_archive, write_archive
from softneck.core._archive import FORMAT_VERSION
from softneck.core._kinds import KINDS, REMOVED

NAMES = st.text("abcdefgh_", min_size=1, max_size=8).filter(lambda name: name != "header")
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


def archive(folder: Path, header: dict[str, Any] | None = None) -> Path:
    path = folder / "a.npz"
    write_archive(
        path, header or {"kind": "rls"}, {"a": np.arange(300.0).reshape(3, 100), "b": np.zeros(0)}, force=True
    )
    return path


@given(
    header=st.dictionaries(NAMES, JSON, max_size=4),
    contents=st.dictionaries(
        NAMES,
        arrays(st.sampled_from([np.float64, np.uint64, np.int64]), array_shapes(min_dims=0, max_dims=3, min_side=0)),
        max_size=3,
    ),
)
@settings(max_examples=30)
def test_header_and_arrays_come_back_bit_by_bit(
    tmp_path: Path, header: dict[str, Any], contents: dict[str, np.ndarray]
) -> None:
    path = tmp_path / "a.npz"
    write_archive(path, header, contents, force=True)
    read_header, read = read_archive(path)
    assert read_header == {"format": "softneck", "format_version": FORMAT_VERSION, **header}
    assert read.keys() == contents.keys()
    for name, array in contents.items():
        assert read[name].dtype == array.dtype
        assert read[name].shape == array.shape
        assert read[name].tobytes() == array.tobytes()


def test_another_version_is_named(tmp_path: Path) -> None:
    path = archive(tmp_path, {"kind": "rls", "format_version": 99})
    with pytest.raises(FileFormatError, match=rf"a\.npz: has format version 99; this softneck reads {FORMAT_VERSION}"):
        read_archive(path)
    with pytest.raises(FileFormatError, match="has format version 99"):
        load(path)


@pytest.mark.parametrize("header", [{"format": "other"}, {"format": None}])
def test_an_archive_that_is_not_ours_is_refused(tmp_path: Path, header: dict[str, Any]) -> None:
    with pytest.raises(FileFormatError, match="is not a softneck file; expected one that softneck wrote"):
        read_archive(archive(tmp_path, header))


def test_numpys_own_archives_are_not_ours(tmp_path: Path) -> None:
    np.savez(tmp_path / "plain.npz", a=np.zeros(3))
    np.savez(tmp_path / "list.npz", header=np.frombuffer(b"[1, 2]", dtype=np.uint8))
    for name in ("plain", "list"):
        with pytest.raises(FileFormatError, match="is not a softneck file"):
            read_archive(tmp_path / f"{name}.npz")


def test_a_pickle_is_never_opened(tmp_path: Path) -> None:
    text = json.dumps({"format": "softneck", "format_version": FORMAT_VERSION}).encode()
    np.savez(tmp_path / "a.npz", header=np.frombuffer(text, dtype=np.uint8), a=np.array([print], dtype=object))
    with pytest.raises(FileFormatError, match="Object arrays cannot be loaded"):
        read_archive(tmp_path / "a.npz")


def test_no_object_array_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        write_archive(tmp_path / "a.npz", {}, {"a": np.array([print], dtype=object)})
    assert list(tmp_path.iterdir()) == []


def test_a_member_that_is_no_array_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("header", b"{}")
    with pytest.raises(FileFormatError, match="is not a softneck file or is damaged"):
        read_archive(tmp_path / "a.npz")


def test_a_file_that_is_absent_or_empty_or_a_folder(tmp_path: Path) -> None:
    (tmp_path / "empty.npz").write_bytes(b"")
    with pytest.raises(FileFormatError, match="no such file"):
        read_archive(tmp_path / "none.npz")
    with pytest.raises(FileFormatError, match="is a folder; name a file in it"):
        read_archive(tmp_path)
    with pytest.raises(FileFormatError, match="is damaged"):
        read_archive(tmp_path / "empty.npz")


@pytest.mark.slow
@given(cut=st.floats(0, 1), flips=st.lists(st.tuples(st.floats(0, 0.9999), st.integers(1, 255)), max_size=4))
@settings(max_examples=300)
def test_damaged_bytes_are_a_format_error_and_nothing_else(
    tmp_path: Path, cut: float, flips: list[tuple[float, int]]
) -> None:
    source = archive(tmp_path)
    content = bytearray(source.read_bytes())
    for where, change in flips:
        content[int(where * len(content))] ^= change
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(content[: max(1, int(cut * len(content)))] if cut < 0.5 else content)
    with contextlib.suppress(FileFormatError):  # anything else fails the test
        header, _ = read_archive(damaged)
        assert header["format"] == "softneck"


@pytest.mark.parametrize("at", range(0, 60))
def test_every_byte_of_the_first_member_may_be_wrong(tmp_path: Path, at: int) -> None:
    """The local file header and the start of the compressed data: where a flip changes method, size and stream."""
    source = archive(tmp_path)
    content = source.read_bytes()
    start = content.rindex(b"PK\x01\x02") if at % 2 else 0  # the directory's last entry as well
    for change in (0x01, 0x08, 0xFF):
        damaged = bytearray(content)
        damaged[start + at // 2] ^= change
        (tmp_path / "damaged.npz").write_bytes(damaged)
        with contextlib.suppress(FileFormatError):
            read_archive(tmp_path / "damaged.npz")


def test_an_archive_that_would_fill_the_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.core._files.MOST_UNPACKED", 1000)
    with pytest.raises(FileFormatError, match="unpacks to"):
        read_archive(archive(tmp_path))


@pytest.mark.parametrize("drop", ["a", "training_rows", "drive"])
def test_a_model_file_without_an_array_is_refused(tmp_path: Path, models: dict, drop: str) -> None:
    models["rls"].save(tmp_path / "m.npz")
    header, contents = read_archive(tmp_path / "m.npz")
    del contents[drop]
    write_archive(tmp_path / "m.npz", header, contents, force=True)
    with pytest.raises(FileFormatError, match="its header and arrays do not fit together"):
        load(tmp_path / "m.npz")


def test_a_file_of_another_role_or_kind_is_refused(tmp_path: Path, models: dict) -> None:
    models["rls"].save(tmp_path / "m.npz")
    with pytest.raises(FileFormatError, match=r"m\.npz: is a model \(rls\), not a controller"):
        load(tmp_path / "m.npz", role="controller")
    with pytest.raises(FileFormatError, match="holds the unknown kind `magic`"):
        load(archive(tmp_path, {"kind": "magic"}))
    for name, instead in REMOVED.items():
        assert name not in KINDS
        with pytest.raises(FileFormatError, match=rf"`{name}` was removed after softneck 0\.2\.0.*use `{instead}`"):
            load(archive(tmp_path, {"kind": name}))


def with_member(folder: Path, name: str, change: Callable[[bytes], bytes]) -> Path:
    """The archive with one member changed and all sums of the zip file right."""
    source = archive(folder)
    with zipfile.ZipFile(source) as file:
        members = {item: file.read(item) for item in file.namelist()}
    with zipfile.ZipFile(source, "w") as file:
        for item, content in members.items():
            file.writestr(item, change(content) if item == name else content)
    return source


def with_header(text: str) -> Callable[[bytes], bytes]:
    """Replace the text in which numpy says what follows."""
    head = text.encode("latin1")
    return lambda content: content[:8] + struct.pack("<H", len(head)) + head + content[128:]


# What fuzzing found that numpy's reader raises, beside ValueError.
@pytest.mark.parametrize(
    "text",
    ["{'descr': (", "'''", "{'a'", "1+1", "(" * 3000, "-" * 3000 + "1", "\\", "\x00", "  x\n y", "{'descr': zz}",
     "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
     "{'descr': '<f8', 'fortran_order': False, 'shape': (10**30,)}",
     "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999999999,)}",
     "{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000000000000, 9000000000000000000)}",
     "{'descr': '|O', 'fortran_order': False, 'shape': (300,)}",
     "{'descr': 3, 'fortran_order': False, 'shape': (300,)}"],
)  # fmt: skip
def test_any_text_in_an_array_s_header_is_a_format_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(FileFormatError, match=r"a\.npz: is not a softneck file or is damaged"):
        read_archive(with_member(tmp_path, "a.npy", with_header(text)))


@pytest.mark.parametrize("descr", ["<c16", "<U2", "|S8", "<M8[ns]", "|V8"])
def test_an_array_of_anything_but_numbers_is_a_format_error(tmp_path: Path, descr: str) -> None:
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': (100,)}}"
    with pytest.raises(FileFormatError, match="its member `a` is not an array of numbers"):
        read_archive(with_member(tmp_path, "a.npy", with_header(text)))


def test_a_member_without_numpy_s_magic_is_a_format_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="its member `a` is not an array of numbers"):
        read_archive(with_member(tmp_path, "a.npy", lambda content: b"\x00" + content[1:]))


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=150)
def test_damaged_headers_of_arrays_are_a_format_error_and_nothing_else(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)

    def damaged(content: bytes) -> bytes:
        changed = bytearray(content)
        for at in rng.integers(128, size=rng.integers(1, 6)):
            changed[at] = int(rng.choice(np.frombuffer(b"(){}[]'\\,:0x9-+\x00\xff\n#", dtype=np.uint8)))
        return bytes(changed)

    with contextlib.suppress(FileFormatError):
        read_archive(with_member(tmp_path, str(rng.choice(["a.npy", "header.npy"])), damaged))


@pytest.mark.parametrize("value", [None, 10**400, "x", [], {}, [[]], True, -1, 1e300])
@pytest.mark.parametrize("key", ["kind", "sample_time", "settings", "findings"])
def test_a_header_of_any_values_is_a_model_or_a_format_error(
    tmp_path: Path, models: dict, key: str, value: object
) -> None:
    models["rls"].save(tmp_path / "m.npz")
    header, contents = read_archive(tmp_path / "m.npz")
    header.update({key: value})
    with unlimited_digits():
        write_archive(tmp_path / "m.npz", header, contents, force=True)
    with contextlib.suppress(FileFormatError):
        load(tmp_path / "m.npz")


@contextlib.contextmanager
def unlimited_digits() -> Iterator[None]:
    """Write integers that Python refuses to read."""
    limit = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)
    try:
        yield
    finally:
        sys.set_int_max_str_digits(limit)
