"""ROS 2 bags in MCAP format as a sparse table: a row for each message, columns `topic.field[0]`.

`mcap-ros2-support` (MIT, pure Python) decodes messages; JSON ones are read directly.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import MOST_UNPACKED, DataError, FileFormatError, error_reason, require_package, require_unpacked

if TYPE_CHECKING:
    import pandas as pd
    from mcap.records import Chunk

# Name of `softneck drives run --log` in the header of its logs.
OURS = b"softneck"
#: The time column of such a table [s].
TIME = "time"
_MAX_DEPTH, _MOST_NUMBERS = 6, 64
# [ns] A message clock that differs more from the logger's is simulated or was never set.
_SAME_CLOCK = 10**9
_MOST_CELLS = 50_000_000
# [bytes] Only pictures are larger; a damaged length must not allocate the machine's memory.
LARGEST_RECORD = 1 << 26


def is_run_log(source: Path) -> bool:
    """Return whether softneck's drives wrote an MCAP file, by its first record."""
    try:
        with source.open("rb") as file:
            return OURS in file.read(256)
    except OSError:
        return False


def require_chunks(source: Path) -> None:
    """Raise FileFormatError if compressed chunks unpack to more than declared or than a log may hold.

    The reader reports other damage.
    """
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    size = source.stat().st_size
    with source.open("rb") as file:
        pieces = (record for record in StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_RECORD).records)
        total = 0
        while True:
            try:
                piece = next(pieces, None)
            except Exception:  # whatever damaged bytes lead to
                return
            if piece is None:
                return
            if isinstance(piece, Chunk):
                total += piece.uncompressed_size
                # Check the declared size first: verifying it takes that much memory.
                require_unpacked(source, total, size)
                require_unpacked(source, total if _is_true(piece) else MOST_UNPACKED + 1, size)


def _is_true(piece: Chunk) -> bool:
    """Return whether a compressed chunk holds no more than declared, as far as it can be read."""
    from lz4.frame import LZ4FrameDecompressor
    from zstandard import CONTENTSIZE_UNKNOWN, get_frame_parameters

    declared = piece.uncompressed_size
    try:
        if piece.compression == "lz4":
            return len(LZ4FrameDecompressor().decompress(piece.data, max_length=declared + 1)) <= declared
        # Without a size in the frame, zstd stops at the chunk's declared size.
        holds = get_frame_parameters(piece.data).content_size if piece.compression == "zstd" else declared
        return holds in (declared, CONTENTSIZE_UNKNOWN)
    except Exception:  # the reader reports the damage
        return True


def mcap_table(source: Path) -> pd.DataFrame:
    """Return one row for each message in order of time; NaN in columns of other topics.

    Time is that of the messages' headers if they follow the logger's clock, else the logger's.
    """
    for package in ("mcap", "mcap_ros2"):
        require_package(package)
    import pandas as pd

    require_chunks(source)
    rows: list[dict[str, float]] = []
    clocks: list[tuple[int, int]] = []
    skipped: set[str] = set()
    cells = 0
    try:
        for topic, logged, content in _messages(source, skipped):
            row = dict(_numbers(content, topic, 0))
            row.pop(f"{topic}.header.stamp", None)
            cells += len(row)
            if cells > _MOST_CELLS:
                raise DataError(f"{source}: holds more than {_MOST_CELLS} numbers; cut it by `ros2 bag filter`.")
            rows.append(row)
            clocks.append((logged, _stamp(content, logged)))
    except (DataError, FileFormatError):
        raise
    except Exception as error:  # readers and decoders raise anything for damaged bytes
        raise FileFormatError(f"{source}: cannot be read as MCAP ({error_reason(error)}).") from error
    frame = pd.DataFrame(rows)
    if frame.empty or not len(frame.columns):
        also = f" (not decoded: {', '.join(sorted(skipped))})" if skipped else ""
        raise DataError(
            f"{source}: no message of ROS 2 or JSON holds numbers{also}; record topics of set-points and angles."
        )
    # Whole nanoseconds: a double of seconds since 1970 is off by 1e-7 s, which would reorder simultaneous messages.
    logged, stamped = np.array(clocks, dtype=np.int64).T
    time = np.where(np.abs(stamped - logged) < _SAME_CLOCK, stamped, logged)
    frame.insert(0, TIME, (time - time.min()) / 1e9)
    return frame.sort_values(TIME, kind="stable").reset_index(drop=True)


def _stamp(content: Any, logged: int) -> int:
    """Return the time in a message's header [ns], else the logger's."""
    stamp = getattr(getattr(content, "header", None), "stamp", None)
    if stamp is None or not hasattr(stamp, "sec") or not hasattr(stamp, "nanosec"):
        return logged
    return 10**9 * int(stamp.sec) + int(stamp.nanosec)


def _messages(source: Path, skipped: set[str]) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, logger's time [ns], message) of all messages that can be decoded."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    ros, decoders = DecoderFactory(), {}
    with source.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            topic = channel.topic.strip("/").replace("/", ".")
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                if channel.id not in decoders:
                    decoders[channel.id] = ros.decoder_for(channel.message_encoding, schema)
                if decoders[channel.id] is None:
                    skipped.add(f"{channel.topic} is {channel.message_encoding}")
                    continue
                content = decoders[channel.id](message.data)
            yield topic, message.log_time, content


def _numbers(content: Any, name: str, depth: int) -> Iterator[tuple[str, float]]:
    """Yield (name, number) of all numbers in a message; a header becomes its stamp [s]."""
    if isinstance(content, bool | int | float):
        yield name, float(content)
    elif depth > _MAX_DEPTH or isinstance(content, str | bytes) or content is None:
        return
    elif hasattr(content, "sec") and hasattr(content, "nanosec"):
        yield name, float(content.sec) + 1e-9 * float(content.nanosec)
    elif isinstance(content, Mapping) or hasattr(content, "__slots__") or hasattr(content, "__dict__"):
        fields = content
        if not isinstance(content, Mapping):
            keys = getattr(content, "__slots__", None) or vars(content)
            fields = {key: getattr(content, key) for key in keys if not key.startswith("_")}
        for key, value in fields.items():
            yield from _numbers(value, f"{name}.{key}", depth + 1)
    else:
        try:
            items = list(content)
        except TypeError:
            return
        if len(items) <= _MOST_NUMBERS:  # longer lists are pictures, clouds and maps
            for place, item in enumerate(items):
                yield from _numbers(item, f"{name}[{place}]", depth + 1)
