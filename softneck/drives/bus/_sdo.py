"""Objects of a drive by SDO, through canopen, over any link."""

from __future__ import annotations

import logging
import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softneck.core import FileFormatError, SoftneckError
from softneck.core._budget import MOST_EDS, settings_text

from ..master import Frame
from ._link import Link

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary
    from canopen.sdo.client import SdoClient


# A drive answers within some slow-loop samples; 0.3 s is canopen's own patience.
_ANSWER_TIME = 0.3
# Which of these a drive tells only hardware can say; that it took the value it did say, and none of them is a guard.
_MAY_BE_UNTOLD = frozenset({0x6060, 0x6098, 0x60C2, 0x60FF})
# canopen logs each abort as an error; here an abort becomes one line for the user.
logging.getLogger("canopen").addHandler(logging.NullHandler())


# An object has subindices up to FEh (CiA 301, 7.4.1).
_MOST_ENTRIES = 254
_ENTRIES = re.compile(r"^\s*NrOfEntries\s*[=:]\s*\+?(\d+)", re.IGNORECASE | re.MULTILINE)


class SdoError(SoftneckError):
    """A drive refused an object or did not answer."""

    def __init__(self, message: str, *, aborted: bool = False, code: int = 0) -> None:
        """Say what happened; `aborted` tells a refusal from silence, `code` is the drive's reason."""
        super().__init__(message)
        self.aborted, self.code = aborted, code


def load_eds(profile: str, path: Path | None = None) -> ObjectDictionary:
    """Return our EDS of `profile`, or the one at `path`.

    Raises:
        FileFormatError: no EDS.
    """
    import canopen
    from canopen.objectdictionary import ObjectDictionary

    source = path or Path(__file__).parent / "eds" / f"{profile}.eds"
    try:
        many = [int(said) for said in _ENTRIES.findall(settings_text(source, MOST_EDS))]
        if any(count > _MOST_ENTRIES for count in many):  # each of them is looked for
            raise ValueError(f"NrOfEntries of {max(many)}, where an object has {_MOST_ENTRIES} at most")
        dictionary = canopen.import_od(str(source))
    except Exception as error:  # canopen raises what its parser meets: KeyError, ValueError, configparser's
        raise FileFormatError(
            f"{source}: is not an EDS ({type(error).__name__}: {' '.join(str(error).split())})."
        ) from error
    if not isinstance(dictionary, ObjectDictionary) or not len(dictionary):
        raise FileFormatError(f"{source}: has no objects; is it an EDS?")
    return dictionary


class Objects:
    """The objects of one drive.

    Attributes:
        node: its number.
        untold: objects that took a value and cannot be read.
    """

    def __init__(self, link: Link, node: int, dictionary: ObjectDictionary) -> None:
        """Talk to `node` over `link`, with names and types of `dictionary`."""
        from canopen.sdo.client import SdoClient

        self.node, self.untold = node, set[str]()
        self._client = SdoClient(0x600 + node, 0x580 + node, dictionary)
        # The network below has put the answer into the queue before canopen looks, or there is none.
        self._client.RESPONSE_TIMEOUT = 0.0
        self._client.network = _Network(link, self._client, 0x580 + node)  # pyright: ignore[reportAttributeAccessIssue]
        self._dictionary = dictionary

    def read(self, index: int, subindex: int = 0) -> int:
        """Return a number.

        Raises:
            SdoError: the drive has no such object or does not answer.
        """
        return int(self._call(index, subindex, lambda item: item.raw))

    def has(self, index: int, subindex: int = 0) -> bool:
        """Return whether the drive, and its EDS, have a number there.

        Raises:
            SdoError: the drive does not answer.
        """
        if index not in self._dictionary:
            return False
        try:
            self.read(index, subindex)
        except SdoError as error:
            if error.aborted:
                return False
            raise
        return True

    def read_text(self, index: int, subindex: int = 0) -> str:
        """Return a text."""
        return str(self._call(index, subindex, lambda item: item.raw)).strip("\0 ")

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write a number.

        Raises:
            SdoError: the drive refuses it or does not answer.
        """

        def put(item: Any) -> None:
            item.raw = value

        self._call(index, subindex, put, value=value)

    def written(self, index: int, subindex: int, value: int) -> int:
        """Write a number and return what the drive says that it has now: what was written where it may keep silent."""
        self.write(index, subindex, value)
        try:
            return self.read(index, subindex)
        except SdoError as error:
            if not error.aborted or index not in _MAY_BE_UNTOLD:
                raise
            self.untold.add(f"{index:04X}h")
            return value

    def _call(self, index: int, subindex: int, act: Any, *, value: int | None = None) -> Any:
        from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

        place = f"{index:04X}h" + (f":{subindex}" if subindex else "")
        try:
            entry = self._client[index]
            return act(entry if _plain(self._dictionary, index) else entry[subindex])  # pyright: ignore[reportIndexIssue]
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
        except KeyError as error:
            raise SdoError(f"the EDS has no object {place}; it does not fit the drive's profile.") from error


class _Network:
    """What canopen's client needs of a network: sending, and the answer being there afterwards."""

    def __init__(self, link: Link, client: SdoClient, answer: int) -> None:
        self._link, self._client, self._answer = link, client, answer

    def send_message(self, identifier: int, data: bytes, remote: bool = False) -> None:
        """Send and wait for the answer."""
        self._link.receive(0.0)
        self._link.send([Frame(identifier, bytes(data), remote)])
        if data[0] == 0x80:
            return
        until = self._link.now + _ANSWER_TIME
        while self._link.now < until:
            for frame in self._link.receive(max(0.0, until - self._link.now)):
                if frame.identifier == self._answer and not frame.remote and not frame.error and len(frame.data) == 8:
                    self._client.on_response(frame.identifier, bytearray(frame.data), 0.0)
                    return


def _plain(dictionary: ObjectDictionary, index: int) -> bool:
    from canopen.objectdictionary import ODVariable

    return isinstance(dictionary[index], ODVariable)


def is_integer(dictionary: ObjectDictionary, index: int, subindex: int) -> tuple[bool, int]:
    """Return whether an object is an integer there, and its size in bytes."""
    from canopen.objectdictionary.datatypes import INTEGER_TYPES

    variable = dictionary.get_variable(index, subindex)
    if variable is None or variable.data_type not in INTEGER_TYPES:
        return False, 0
    return True, len(variable) // 8
