"""What reading may cost is decided before it is paid, by sizes that the file cannot lie about."""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import FileFormatError, SettingsError
from softneck.core._files import (
    MOST_COLUMNS,
    MOST_LOG,
    MOST_NUMBERS,
    MOST_TOML,
    largest_unpacked,
    open_zip,
    require_numbers,
    require_size,
    require_steps,
    require_table,
    settings_text,
)


def packed(path: Path, content: bytes, *, says: int | None = None) -> Path:
    """An archive of one member that says it has `says` bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", content)
    if says is not None:
        raw = bytearray(path.read_bytes())
        at = raw.rfind(b"PK\1\2")
        # The sum of what a reader that stops there has read: it sees nothing wrong.
        struct.pack_into("<L", raw, at + 16, zlib.crc32(content[:says]))
        struct.pack_into("<L", raw, at + 24, says)
        path.write_bytes(raw)
    return path


def sparse(path: Path, begin: bytes, size: int) -> Path:
    path.write_bytes(begin)
    os.truncate(path, size)
    return path


@given(content=st.binary(max_size=5000), less=st.integers(1, 100))
def test_a_member_that_holds_more_than_it_says_is_refused_and_a_true_one_is_not(
    tmp_path: Path, content: bytes, less: int
) -> None:
    open_zip(packed(tmp_path / "a.zip", content), verify=True).close()
    if len(content) >= less:
        liar = packed(tmp_path / "liar.zip", content, says=len(content) - less)
        with zipfile.ZipFile(liar) as archive:
            assert archive.read("a") == content[:-less], "Python's own reader notices nothing"
        with pytest.raises(FileFormatError, match="unpacks to more than it declares"):
            open_zip(liar, verify=True)


def test_zeros_are_refused_by_what_they_unpack_to_and_small_ones_are_not(tmp_path: Path) -> None:
    limit = largest_unpacked(0)
    open_zip(packed(tmp_path / "small.zip", bytes(limit))).close()
    with pytest.raises(FileFormatError, match=r"bomb\.zip: unpacks to 0\.0336 GB|33\.6 MB"):
        open_zip(packed(tmp_path / "bomb.zip", bytes(limit + 1)))


def test_noise_of_any_size_is_no_bomb() -> None:
    noise = zlib.compress(np.random.default_rng(0).standard_normal(100_000).tobytes())
    # Measured numbers shrink by a tenth; the limit is a hundred times that far away.
    assert largest_unpacked(1000 * len(noise)) > 100_000 * 8 * 1000 * 2


def test_a_directory_of_a_million_members_is_not_read(tmp_path: Path) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for k in range(20_000):
            archive.writestr(f"member number {k:040d}", b"")
    (tmp_path / "many.zip").write_bytes(file.getvalue())
    with pytest.raises(FileFormatError, match="an archive with more members"):
        open_zip(tmp_path / "many.zip")


def test_the_same_archive_with_64_bit_sizes_is_not_read_either(tmp_path: Path) -> None:
    path = packed(tmp_path / "a.zip", b"content")
    raw = path.read_bytes()
    path.write_bytes(raw[:-22] + b"PK\6\7" + bytes(16) + raw[-22:])
    with pytest.raises(FileFormatError, match="an archive with more members"):
        open_zip(path)


def test_a_file_of_holes_is_refused_whatever_its_begin(tmp_path: Path) -> None:
    begin = b"a,b\n" + 1000 * b"1,2\n"
    with pytest.raises(FileFormatError, match=r"log\.csv: has 4\.29 GB; softneck reads at most 1\.07 GB here"):
        require_size(sparse(tmp_path / "log.csv", begin, 4 * 2**30))
    with pytest.raises(FileFormatError, match=r"a sparse file"):
        require_size(sparse(tmp_path / "log.csv", begin, MOST_LOG))
    require_size(sparse(tmp_path / "log.csv", begin, largest_unpacked(0)))  # at most so much: no harm


@pytest.mark.parametrize("mark", [",", ";", "\t", " "])
def test_a_million_columns_are_refused_and_ten_thousand_are_not(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(mark.join("1" * MOST_COLUMNS) + "\n")
    require_table(path)
    path.write_text(mark.join("1" * (MOST_COLUMNS + 1)) + "\n")
    with pytest.raises(FileFormatError, match=f"has {MOST_COLUMNS + 1} columns"):
        require_table(path)


def test_a_line_without_end_and_zero_bytes_are_no_table_wherever_they_stand(tmp_path: Path) -> None:
    path, begin = tmp_path / "a.csv", 100_000 * b"1,2\n"
    path.write_bytes(begin + 300_000 * b"1" + b"\n")
    with pytest.raises(FileFormatError, match=r"has a line of more than 0\.131 MB"):
        require_table(path)
    path.write_bytes(begin + b"\0" + begin)
    with pytest.raises(FileFormatError, match="it holds zero bytes"):
        require_table(path)
    require_table(path, zeros=True)  # UTF-16 has them


def test_memory_that_is_not_there_is_not_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.core._files.available_bytes", lambda: 2**26)
    require_numbers(tmp_path / "a", 2**23 // 10, 10)
    with pytest.raises(FileFormatError, match=r"needs about 80 MB of memory, and 67\.1 MB are free"):
        require_numbers(tmp_path / "a", 10**6, 10)


def test_declared_numbers_have_an_end(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="declares 1000000000 x 2 numbers; that is not a log"):
        require_numbers(tmp_path / "a", 10**9, 2)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("#" * (MOST_TOML + 1), "has 1.05 MB; softneck reads at most"), ("a." * 33 + "a = 1", "more than 32 parts")],
)
def test_settings_that_nobody_writes_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=reason):
        settings_text(path)
    path.write_text(text.replace("#" * 2, "#").removeprefix("a."))  # half as much, and one part less
    settings_text(path)


@pytest.mark.parametrize("duration", [1e12, float("inf"), float("nan"), 0.02 * (MOST_NUMBERS / 20 + 2)])
def test_a_duration_without_end_is_one_line(duration: float) -> None:
    with pytest.raises(SettingsError, match=r"`duration_s` of .* rows; at most 6710886 rows of 20 numbers fit"):
        require_steps("duration_s", duration, 0.02, 20)
    assert require_steps("duration_s", 26.0, 0.02, 20) == 1300
