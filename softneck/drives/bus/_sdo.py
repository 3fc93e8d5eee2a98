"""Objects of a drive by SDO, through canopen's client, over any link.

What a run reads and writes has its type here and no EDS is read: no file can be missing once drives have power.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from softneck.core import SoftneckError

from ..master import Frame
from ._link import Link

if TYPE_CHECKING:
    from canopen.sdo.client import SdoClient


_T = TypeVar("_T")
# (index, subindex) -> type of each number (CiA 301, CiA 402; 207Eh and 207Fh: Technosoft's), as `struct` writes it.
NUMBERS: dict[tuple[int, int], str] = {
    **dict.fromkeys(((0x100D, 0), (0x1400, 2), (0x1600, 0), (0x1800, 2), (0x1A00, 0), (0x60C2, 1)), "B"),
    **dict.fromkeys(((0x6060, 0), (0x6061, 0), (0x6098, 0), (0x60C2, 2)), "b"),
    **dict.fromkeys(((0x100C, 0), (0x1017, 0), (0x207F, 0), (0x6040, 0), (0x6041, 0), (0x6066, 0), (0x6073, 0),
                     (0x60B8, 0)), "H"),
    **dict.fromkeys(((0x207E, 0), (0x6007, 0), (0x605A, 0), (0x605E, 0), (0x6078, 0)), "h"),
    **dict.fromkeys(((0x1000, 0), (0x1016, 1), *((0x1018, sub) for sub in range(1, 5)), (0x1400, 1), (0x1600, 1),
                     (0x1600, 2), (0x1800, 1), *((0x1A00, sub) for sub in range(1, 4)), (0x6065, 0), (0x6083, 0),
                     (0x6085, 0), *((index, sub) for index in (0x6093, 0x6094, 0x6097) for sub in (1, 2)),
                     (0x6502, 0)), "I"),
    **dict.fromkeys(((0x6064, 0), (0x606C, 0), (0x607A, 0), (0x607C, 0), (0x607D, 1), (0x607D, 2), (0x60BA, 0),
                     (0x60FF, 0)), "i"),
}  # fmt: skip
# A drive answers within some slow-loop samples; 0.3 s is canopen's own patience.
_ANSWER_TIME = 0.3
# Which of these a drive tells only hardware can say; that it took the value it did say, and none of them is a guard.
_MAY_BE_UNTOLD = frozenset({0x6060, 0x6098, 0x60C2, 0x60FF})
# First byte of an SDO frame: its command, of which these name index and subindex: download, upload, abort.
_COMMAND, _ABORT = 0xE0, 0x80
_NAMES_OBJECT, _SEGMENTS = (0x20, 0x40, _ABORT), (0x00, 0x20)
# canopen logs each abort as an error; here an abort becomes one line for the user.
logging.getLogger("canopen").addHandler(logging.NullHandler())


class SdoError(SoftneckError):
    """A drive refused an object or did not answer."""

    def __init__(self, message: str, *, aborted: bool = False, code: int = 0) -> None:
        """Create the error; `aborted` distinguishes a refusal from a time-out, `code` is the drive's reason."""
        super().__init__(message)
        self.aborted, self.code = aborted, code


def _number(index: int, subindex: int) -> struct.Struct:
    return struct.Struct("<" + NUMBERS[index, subindex])


class Objects:
    """The objects of one drive.

    `node`: its number. `untold`: objects that took a value and cannot be read.
    """

    def __init__(self, link: Link, node: int) -> None:
        """Talk to `node` over `link`."""
        from canopen.objectdictionary import ObjectDictionary
        from canopen.sdo.client import SdoClient

        self.node, self.untold = node, set[str]()
        self._client = SdoClient(0x600 + node, 0x580 + node, ObjectDictionary())
        # The network below has put the answer into the queue before canopen looks, or there is none.
        self._client.RESPONSE_TIMEOUT = 0.0
        self._client.network = _Network(link, self._client, 0x580 + node)  # pyright: ignore[reportAttributeAccessIssue]

    def read(self, index: int, subindex: int = 0) -> int:
        """Return a number. Raises SdoError: the drive has no such object or does not answer."""
        kind = _number(index, subindex)
        return self._call(index, subindex, lambda: kind.unpack(self._client.upload(index, subindex))[0])

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the drive has a number there. Raises SdoError: the drive does not answer."""
        try:
            self.read(index, subindex)
        except SdoError as error:
            if error.aborted:
                return False
            raise
        return True

    def read_text(self, index: int) -> str:
        """Return a text."""
        data = self._call(index, 0, lambda: self._client.upload(index, 0))
        return data.decode("ascii", "ignore").strip("\0 ")

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write a number. Raises SdoError: the drive refuses it or does not answer."""
        kind = _number(index, subindex)
        # A type without sign takes the bits of a negative number.
        data = (value & ((1 << 8 * kind.size) - 1)).to_bytes(kind.size, "little")
        self._call(index, subindex, lambda: self._client.download(index, subindex, data), value=value)

    def write_checked(self, index: int, subindex: int, value: int) -> int:
        """Write a number and return the drive's value read back; a write-only object returns the number written."""
        self.write(index, subindex, value)
        try:
            return self.read(index, subindex)
        except SdoError as error:
            if not error.aborted or index not in _MAY_BE_UNTOLD:
                raise
            self.untold.add(f"{index:04X}h")
            return value

    def _call(self, index: int, subindex: int, act: Callable[[], _T], *, value: int | None = None) -> _T:
        from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

        place = f"{index:04X}h" + (f":{subindex}" if subindex else "")
        try:
            return act()
        except SdoAbortedError as error:
            asked = "" if value is None else f" the value {value} for"
            raise SdoError(
                f"node {self.node} refuses{asked} object {place} ({error}).", aborted=True, code=error.code
            ) from error
        except SdoCommunicationError as error:
            raise SdoError(
                f"node {self.node} does not answer (object {place}); is it on, is its number right?"
            ) from error
        except (struct.error, ValueError, IndexError) as error:
            raise SdoError(f"node {self.node} sends an invalid answer (object {place}: {error}).") from error


class _Network:
    """The part of a network that canopen's client needs: sending, with the answer available afterwards.

    An answer that names another object is one to another client, as is its abort, and is ignored (CiA 301, 7.2.4.3).
    """

    def __init__(self, link: Link, client: SdoClient, answer: int) -> None:
        self._link, self._client, self._answer = link, client, answer
        self._object = b""

    def send_message(self, identifier: int, data: bytes, remote: bool = False) -> None:
        """Send and wait for the answer."""
        if data[0] & _COMMAND in _NAMES_OBJECT:
            self._object = bytes(data[1:4])
        self._link.receive(0.0)
        self._link.send([Frame(identifier, bytes(data), remote)])
        if data[0] == _ABORT:
            return
        segment = data[0] & _COMMAND not in _NAMES_OBJECT
        until = self._link.now + _ANSWER_TIME
        while self._link.now < until:
            for frame in self._link.receive(max(0.0, until - self._link.now)):
                if self._is_answer(frame, segment=segment):
                    self._client.on_response(frame.identifier, bytearray(frame.data), 0.0)
                    return

    def _is_answer(self, frame: Frame, *, segment: bool) -> bool:
        if frame.identifier != self._answer or frame.remote or frame.error or len(frame.data) != 8:
            return False
        # Only answers to the segments of a long value do not name their object.
        return (segment and frame.data[0] & _COMMAND in _SEGMENTS) or frame.data[1:4] == self._object
