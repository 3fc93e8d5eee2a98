"""MCAP whose pieces are packed by lz4, by zstd or not at all: the same content, and the same refusals."""

from __future__ import annotations

import dataclasses
import io
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from softneck.core import FileFormatError
from softneck.drives.logs._log_file import read_run_log
from softneck.signals.importing.formats._mcap import mcap_table

from ..fuzz.targets import columns, run_log
from . import log_writers as write

KINDS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]
PACK: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "lz4": lz4.frame.compress,
    "zstd": zstandard.ZstdCompressor().compress,
    # As a stream writes it: the frame does not say how much it holds.
    "zstd, unsaid": zstandard.ZstdCompressor(write_content_size=False).compress,
}
PACKED = pytest.mark.parametrize("packed", ["lz4", "zstd", "zstd, unsaid"])


@pytest.mark.parametrize("piece", [200, 2**20], ids=["many pieces", "one piece"])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_bag_says_the_same_however_it_is_packed(tmp_path: Path, kind: CompressionType, piece: int) -> None:
    path, plain = tmp_path / "bag.mcap", tmp_path / "plain.mcap"
    write.write_mcap(path, columns(), compression=kind, piece=piece)
    write.write_mcap(plain, columns(), compression=CompressionType.NONE)
    assert (kind.name.lower().encode() in path.read_bytes()) is (kind is not CompressionType.NONE)
    found, wanted = mcap_table(path), mcap_table(plain)
    assert list(found) == list(wanted)
    np.testing.assert_array_equal(found.to_numpy(), wanted.to_numpy())


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_run_s_log_says_the_same_however_another_tool_packs_it(tmp_path: Path, kind: CompressionType) -> None:
    ours, theirs = tmp_path / "run.mcap", tmp_path / "again.mcap"
    run_log(ours)
    with ours.open("rb") as stream, theirs.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out, compression=kind, chunk_size=500)
        writer.start(reader.get_header().profile, reader.get_header().library)
        for entry in reader.iter_metadata():
            writer.add_metadata(entry.name, dict(entry.metadata))
        numbers: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in numbers:
                about = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                numbers[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, about)
            writer.add_message(numbers[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    one, two = read_run_log(ours), read_run_log(theirs)
    for field in dataclasses.fields(one):
        assert field.name == "path" or getattr(two, field.name) == getattr(one, field.name), field.name
    assert len(two.cycles) == 20


# -- pieces that are not what they say --------------------------------------------------------------------------------

READERS = pytest.mark.parametrize("read", [mcap_table, read_run_log], ids=["bag", "log of a run"])


@READERS
@PACKED
def test_pieces_that_each_would_fit_are_refused_together(
    tmp_path: Path, read: Callable[[Path], Any], packed: str
) -> None:
    """Each holds the 20 MB that it says, of the 34 MB that a small file may unpack to."""
    path = tmp_path / "a.mcap"
    bag(path, packed, bytes(20 * 10**6), pieces=2)
    with pytest.raises(FileFormatError, match=r"a\.mcap: unpacks to 40 MB"):
        read(path)


def bag(path: Path, packed: str, content: bytes, says: int | None = None, *, pieces: int = 1) -> None:
    """Pieces of a bag: each `content` packed, said to be `says` bytes."""
    name = packed.partition(",")[0].encode()
    inside = PACK[packed](content)
    body = struct.pack("<QQQI", 0, 0, len(content) if says is None else says, 0)
    body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(inside)) + inside
    out = io.BytesIO()
    writer = Writer(out, use_chunking=False)
    writer.start()
    writer.finish()
    whole = out.getvalue()
    at = 8 + 9 + struct.unpack_from("<Q", whole, 9)[0]  # behind the header
    path.write_bytes(whole[:at] + pieces * (struct.pack("<BQ", 6, len(body)) + body) + whole[at:])


@READERS
@PACKED
@pytest.mark.parametrize("says", [16, 10**10, 2**62])
def test_a_piece_that_unpacks_to_more_than_it_says_or_than_fits_is_refused(
    tmp_path: Path, read: Callable[[Path], Any], packed: str, says: int
) -> None:
    """64 MB of zeros in some kB: what is refused is refused before that much memory is taken."""
    path = tmp_path / "a.mcap"
    bag(path, packed, bytes(2**26), says)
    tracemalloc.start()
    begun = tracemalloc.get_traced_memory()[0]
    with pytest.raises(FileFormatError, match=r"a\.mcap: ") as refused:
        read(path)
    most = tracemalloc.get_traced_memory()[1] - begun
    tracemalloc.stop()
    assert len(str(refused.value).splitlines()) == 1
    assert most < 2**25  # without the 64 MB; the packed pieces are below 300 kB


@READERS
@PACKED
def test_a_damaged_piece_is_one_line(tmp_path: Path, read: Callable[[Path], Any], packed: str) -> None:
    path = tmp_path / "a.mcap"
    bag(path, packed, b"no records at all, but a text that packs" * 20)
    content = bytearray(path.read_bytes())
    at = content.index(PACK[packed](b"no records at all, but a text that packs" * 20)[:4])
    for place in (at, at + 9, at + 12):
        changed = bytearray(content)
        changed[place] ^= 0xFF
        path.write_bytes(changed)
        with pytest.raises(FileFormatError, match=r"^[^\n]*a\.mcap: [^\n]*$"):
            read(path)


@READERS
def test_a_packer_that_nobody_knows_is_one_line(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    path = tmp_path / "a.mcap"
    bag(path, "lz4", bytes(100))
    path.write_bytes(path.read_bytes().replace(b"lz4", b"lzx"))
    with pytest.raises(FileFormatError, match=r"^[^\n]*a\.mcap: [^\n]*$"):
        read(path)
