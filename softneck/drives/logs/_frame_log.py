"""Raw frames in files that other tools read: candump's `.log` (`candump -L`) and Vector's `.blf`."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from softneck.core import FileFormatError
from softneck.core._budget import require_lines, require_size, require_unpacked

from ..master import Frame

FRAME_LOGS = (".log", ".blf")
# Bytes in one compressed piece of a BLF file: what a killed process may lose. 10 ms of a bus of three drives are some
# 500 bytes, so that this is a tenth of a second, and less than one at 20 Hz.
_BLF_PIECE = 4096
# Of a BLF file: bytes of an object's head and of a container's, the kind of a container, and how it is packed (zlib).
_OBJECT, _CONTAINER, _PACKED = 16, 10, b"\2\0"
# Bytes that are unpacked at once to see how many there are.
_WINDOW = 2**17


class CandumpSink:
    """Writes `(seconds) can0 ID#DATA`. python-can's own writer adds " R" and " T", which Wireshark does not read."""

    def __init__(self, stream: BinaryIO) -> None:
        """Write to the open file `stream`."""
        self._stream = stream

    def add(self, time: float, from_master: bool, frame: Frame) -> None:
        """Write one frame; the format has no place for its direction."""
        del from_master
        if frame.error:
            body = "20000080#"  # CAN_ERR_FLAG and "bus error", as candump shows it.
        elif frame.remote:
            body = f"{frame.identifier:03X}#R1"
        else:
            body = f"{frame.identifier:03X}#{frame.data.hex().upper()}"
        self._stream.write(f"({time:.6f}) can0 {body}\n".encode("ascii"))

    def close(self) -> None:
        """Nothing is left to write."""


class BlfSink:
    """Writes BLF by python-can, in small pieces."""

    def __init__(self, stream: BinaryIO) -> None:
        """Write to the open file `stream`."""
        from can.io.blf import BLFWriter

        # The writer closes its stream; flushing and renaming are ours.
        self._writer = BLFWriter(_UnclosableStream(stream), max_container_size=_BLF_PIECE)  # pyright: ignore[reportArgumentType]

    def add(self, time: float, from_master: bool, frame: Frame) -> None:
        """Write one frame."""
        import can

        self._writer.on_message_received(
            can.Message(
                timestamp=time,
                arbitration_id=frame.identifier,
                data=None if frame.remote else frame.data,
                dlc=1 if frame.remote else len(frame.data),
                is_remote_frame=frame.remote and not frame.error,
                is_error_frame=frame.error,
                is_extended_id=False,
                is_rx=not from_master,
                channel=0,
            )
        )

    def close(self) -> None:
        """Write what is left and the header's counts."""
        self._writer.stop()


class _UnclosableStream(io.BufferedIOBase):
    """A stream that python-can may not close."""

    def __init__(self, stream: BinaryIO) -> None:
        self._inner = stream

    def write(self, data: Any) -> int:
        return self._inner.write(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._inner.seek(offset, whence)

    def tell(self) -> int:
        return self._inner.tell()

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True


class FrameLog:
    """Frames of a `.log` or `.blf` file.

    Attributes:
        cut: why reading ended early, "" if it did not.
    """

    def __init__(self, path: str | Path) -> None:
        """Look at the file when it is asked for."""
        self.path = Path(path)
        self.cut = ""

    def __iter__(self) -> Iterator[tuple[float, bool, Frame]]:
        """Yield (time [s], whether the master sent it, frame), up to where the file is cut.

        Raises:
            FileFormatError: no such file, or no frame log.
        """
        from can.io.blf import BLFParseError, BLFReader
        from can.io.canutils import CanutilsLogReader

        binary = self.path.suffix.lower() == ".blf"
        reader: Any = BLFReader if binary else CanutilsLogReader
        self.cut = ""
        count = 0
        if self.path.is_file():
            require_size(self.path)
            (_require_containers if binary else require_lines)(self.path)
        try:
            # Opened here, for the readers leave the file open where it is damaged.
            with self.path.open("rb" if binary else "r", encoding=None if binary else "ascii") as stream:
                for message in reader(stream):
                    yield message.timestamp, not message.is_rx, _frame(message)
                    count += 1
        except OSError as error:
            raise FileFormatError(f"{self.path}: cannot be read ({error.strerror}).") from error
        except (ValueError, IndexError, struct.error, zlib.error, BLFParseError, UnicodeDecodeError) as error:
            if not count:
                raise FileFormatError(
                    f"{self.path}: holds no frames of `candump -L` or BLF ({' '.join(str(error).split())})."
                ) from error
            self.cut = f"ends in the middle of frame {count + 1}"


def _require_containers(path: Path) -> None:
    """Raise FileFormatError where the packed containers of a BLF file hold more than a log of its size.

    What is damaged otherwise the reader says.
    """
    size, total = path.stat().st_size, 0
    with path.open("rb") as stream:
        stream.seek(int.from_bytes(stream.read(8)[4:], "little"))
        while len(head := stream.read(_OBJECT)) == _OBJECT and head.startswith(b"LOBJ"):
            length, kind = struct.unpack_from("<II", head, 8)
            body = stream.read(max(length - _OBJECT, 0))
            stream.read(length % 4)  # objects begin at multiples of four
            if kind != _CONTAINER or body[:2] != _PACKED:
                continue
            unpacker, left = zlib.decompressobj(), body[_OBJECT:]
            with contextlib.suppress(zlib.error):
                while part := unpacker.decompress(left, _WINDOW):
                    total, left = total + len(part), unpacker.unconsumed_tail
                    require_unpacked(path, total, size)


def _frame(message: Any) -> Frame:
    if message.is_error_frame:
        return Frame(0, b"", error=True)
    if message.is_remote_frame:
        return Frame(message.arbitration_id, b"\0", remote=True)
    return Frame(message.arbitration_id, bytes(message.data))
