"""MATLAB logs, Parquet logs and hostile files: the same recording as from text, or one clear line."""

from __future__ import annotations

import contextlib
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from softneck.core import DataError, FileFormatError, SettingsError, SoftneckError
from softneck.signals import Recording, guess_layout, import_log, read_layout
from softneck.signals.importing.formats._mat import mat_arrays

CHANNELS = ("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "pitch", "roll")
K = np.arange(30.0)
TABLE = np.column_stack([0.02 * K, np.sin(K), np.cos(K), 0.1 * K, 0.01 * K, -0.02 * K])
NAMES = ("t", "a", "b", "c", "p", "r")


def layout_text(by_name: bool, head: str = "") -> str:
    key = [f'"{name}"' if by_name else str(place) for place, name in enumerate(NAMES)]
    lines = [f"{channel} = {{ column = {key[j + 1]}, unit = 'rad' }}" for j, channel in enumerate(CHANNELS)]
    return "\n".join([head, "[time]", f"column = {key[0]}", "[channels]", *lines])


def load(folder: Path, log: str, layout: str) -> Recording:
    (folder / "layout.toml").write_text(layout)
    return import_log(folder / log, read_layout(folder / "layout.toml")).recording


def write_v73(path: Path, content: dict[str, np.ndarray]) -> None:
    """As MATLAB does: a user block of 512 bytes, shapes transposed, the class as an attribute."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in content.items():
            file[name] = np.atleast_2d(array).T if array.ndim == 2 else array[None, :]
            file[name].attrs["MATLAB_class"] = np.bytes_("char" if array.dtype == np.uint16 else "double")
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    path.write_bytes(head.ljust(512, b"\0") + path.read_bytes()[512:])


def write_log(path: Path, version: str, *, by_name: bool) -> None:
    content = dict(zip(NAMES, TABLE.T, strict=True)) if by_name else {"log": TABLE}
    content |= {"gain": np.array([[3.0]]), "note": np.array([1, 2, 3], dtype=np.uint16)}
    if version == "v5":
        savemat(path, {**content, "title": "a word"}, oned_as="column", do_compression=True)
    else:
        write_v73(path, content)


@pytest.mark.parametrize("by_name", [True, False], ids=["vectors", "matrix"])
@pytest.mark.parametrize("version", ["v5", "v7.3"])
def test_a_mat_file_gives_its_numbers(tmp_path: Path, version: str, by_name: bool) -> None:
    write_log(tmp_path / "log.mat", version, by_name=by_name)
    r = load(tmp_path, "log.mat", layout_text(by_name, "" if by_name else '[file]\nvariable = "log"'))
    np.testing.assert_array_equal(np.column_stack([r.time, r.set_points, r.outputs]), TABLE)


def test_fields_of_a_structure_are_variables(tmp_path: Path) -> None:
    savemat(tmp_path / "five.mat", {"run": {"log": TABLE}})
    with h5py.File(tmp_path / "seven.mat", "w") as file:
        file["run/log"] = TABLE.T
    layout = layout_text(False, '[file]\nvariable = "run.log"')
    for name in ("five.mat", "seven.mat"):
        np.testing.assert_array_equal(load(tmp_path, name, layout).outputs, TABLE[:, 4:])


@pytest.mark.parametrize("by_name", [True, False], ids=["names", "indices"])
def test_a_parquet_log_gives_its_numbers(tmp_path: Path, by_name: bool) -> None:
    pd.DataFrame(TABLE, columns=list(NAMES)).to_parquet(tmp_path / "log.parquet")
    r = load(tmp_path, "log.parquet", layout_text(by_name))
    np.testing.assert_array_equal(np.column_stack([r.time, r.set_points, r.outputs]), TABLE)


@pytest.mark.parametrize("version", ["v5", "v7.3"])
@pytest.mark.parametrize(
    ("by_name", "head", "message"),
    [
        (False, '[file]\nvariable = "lag"', r"no variable `lag` with numbers; the file has .*log \(30 x 6\)"),
        (False, '[file]\nvariable = "title"', "no variable `title` with numbers"),
        (True, "", r"column `r` for `roll` is not in the file; it has .*t"),
    ],
    ids=["absent", "text", "vector absent"],
)
def test_a_mat_file_without_the_variable(tmp_path: Path, version: str, by_name: bool, head: str, message: str) -> None:
    write_log(tmp_path / "log.mat", version, by_name=by_name)
    if by_name:
        content: dict[str, np.ndarray] = dict(zip(NAMES[:-1], TABLE.T[:-1], strict=True))
        savemat(tmp_path / "log.mat", content) if version == "v5" else write_v73(tmp_path / "log.mat", content)
    with pytest.raises(DataError, match=message) as caught:
        load(tmp_path, "log.mat", layout_text(by_name, head))
    assert str(caught.value).startswith(str(tmp_path / "log.mat"))


def test_vectors_of_different_length_and_a_matrix_without_a_name(tmp_path: Path) -> None:
    content = dict(zip(NAMES, TABLE.T, strict=True)) | {"p": K[:-1]}
    savemat(tmp_path / "a.mat", content)
    with pytest.raises(DataError, match=r"differ in length: .*p \(29\)"):
        load(tmp_path, "a.mat", layout_text(True))
    savemat(tmp_path / "a.mat", {"log": TABLE})
    with pytest.raises(DataError, match=r"no vectors of numbers; name the matrix by `\[file\] variable`"):
        load(tmp_path, "a.mat", layout_text(True))
    pd.DataFrame(TABLE).to_csv(tmp_path / "a.csv")
    with pytest.raises(DataError, match=r"`variable` is for a `\.mat` file"):
        load(tmp_path, "a.csv", layout_text(False, '[file]\nvariable = "log"'))


def test_a_link_to_another_file_is_not_followed(tmp_path: Path) -> None:
    write_v73(tmp_path / "secret.mat", {"log": TABLE})
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file["log"] = h5py.ExternalLink("secret.mat", "/log")
    with pytest.raises(DataError, match="no variable `log`"):
        load(tmp_path, "a.mat", layout_text(False, '[file]\nvariable = "log"'))
    (tmp_path / "raw").write_bytes(TABLE.tobytes())
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file.create_dataset("log", TABLE.shape, "f8", external=[(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)])
    with pytest.raises(DataError, match="variable `log` is in another file"):
        load(tmp_path, "a.mat", layout_text(False, '[file]\nvariable = "log"'))


def test_a_small_file_that_declares_a_huge_table(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file.create_dataset("log", (2**40, 6), "f8", chunks=(1024, 6))
    with pytest.raises(DataError, match=r"declares \d+ numbers; that is not a log"):
        load(tmp_path, "a.mat", layout_text(False, '[file]\nvariable = "log"'))


def test_a_member_that_is_no_array_is_left_out(tmp_path: Path) -> None:
    log = tmp_path / "log.npz"
    with zipfile.ZipFile(log, "w") as archive:
        archive.writestr("../evil.npy", b"no array")
    with pytest.raises(DataError, match=r"log\.npz: has no vectors of numbers"):
        guess_layout(log)
    assert list(tmp_path.iterdir()) == [log]


def test_what_is_no_mat_file(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        load(tmp_path, "none.mat", layout_text(True))
    for content in (b"", b"t,a\n1,2\n" * 50, bytes(range(256)) * 9, b"\x89HDF\r\n\x1a\n" + bytes(600)):
        (tmp_path / "a.mat").write_bytes(content)
        with pytest.raises(FileFormatError, match=r"cannot be read as a (MAT file|table .it is empty)"):
            load(tmp_path, "a.mat", layout_text(True))


def test_a_run_column_numbers_the_runs(tmp_path: Path) -> None:
    frame = pd.DataFrame(TABLE, columns=list(NAMES)).assign(n=np.repeat([4, 2, 4], 10))
    frame.to_csv(tmp_path / "a.csv", index=False)
    layout = layout_text(True).replace("[time]", '[time]\nrun_column = "n"')
    assert [len(run) for run in load(tmp_path, "a.csv", layout).runs()] == [10, 10, 10]
    with pytest.raises(DataError, match="column `run` must hold integers"):
        load(tmp_path, "a.csv", layout.replace('"n"', '"a"'))
    with pytest.raises(SettingsError, match="run_column must be a name or an index"):
        load(tmp_path, "a.csv", layout.replace('"n"', "[1]"))


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v5", "v7.3"])
@given(data=st.data())
@settings(max_examples=100)
def test_damaged_bytes_are_a_clear_error_and_nothing_else(tmp_path: Path, version: str, data: st.DataObject) -> None:
    whole = tmp_path / f"{version}.mat"
    if not whole.exists():
        write_log(whole, version, by_name=True)
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    (tmp_path / "damaged.mat").write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    with contextlib.suppress(SoftneckError):  # anything else fails the test
        load(tmp_path, "damaged.mat", layout_text(True))


@given(data=st.data())
@settings(max_examples=40)
def test_version_5_is_read_as_scipy_wrote_it(tmp_path: Path, data: st.DataObject) -> None:
    """Two independent ends: scipy's writer and our reader, over types, shapes, structures and compression."""
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8", "?"]
    content: dict[str, np.ndarray] = {}
    for name in data.draw(st.lists(st.from_regex(r"[a-z][a-z0-9_]{0,9}", fullmatch=True), max_size=4, unique=True)):
        shape = data.draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
        kind = data.draw(st.sampled_from(kinds))
        content[name] = np.random.default_rng(len(name)).integers(0, 100, shape).astype(kind)
    extra = {
        "word": "abc",
        "cell": np.array([[1, "x"]], dtype=object),
        "wave": np.array([1 + 2j]),
        "none": np.zeros((0, 3)),
    }
    savemat(
        tmp_path / "a.mat",
        {**content, **extra, "deep": {"inner": content, "number": 3.0}} | ({} if content else {"x0": np.ones((2, 2))}),
        do_compression=data.draw(st.booleans()),
    )
    found = mat_arrays(tmp_path / "a.mat")
    assert found.pop("deep.number") == 3.0
    assert found.pop("cell{1}") == 1.0
    expected = {**content, **{f"deep.inner.{name}": array for name, array in content.items()}}
    expected |= {} if content else {"x0": np.ones((2, 2))}
    assert set(found) == set(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array.astype(np.float64))


def test_version_4_and_two_variables_of_one_name_are_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "four.mat", {"log": TABLE}, format="4")
    with pytest.raises(FileFormatError, match=r"neither version 5 nor 7\.3; save it with -v7"):
        mat_arrays(tmp_path / "four.mat")
    savemat(tmp_path / "a.mat", {"log": TABLE})
    whole = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "a.mat").write_bytes(whole + whole[128:])
    with pytest.raises(FileFormatError, match="the variable `log` occurs twice"):
        mat_arrays(tmp_path / "a.mat")


def test_a_small_file_that_unpacks_to_a_huge_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.core._files.MOST_UNPACKED", 10_000)
    savemat(tmp_path / "a.mat", {"log": np.zeros((2000, 6))}, do_compression=True)
    with pytest.raises(FileFormatError, match="a compressed variable is cut off or too large"):
        mat_arrays(tmp_path / "a.mat")


def test_hdf5_that_matlab_did_not_write_has_arrays_of_one_dimension(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"], file["u"] = np.arange(5.0), np.ones((5, 2))
    found = mat_arrays(tmp_path / "log.h5")
    assert {name: array.shape for name, array in found.items()} == {"t": (1, 5), "u": (2, 5)}
