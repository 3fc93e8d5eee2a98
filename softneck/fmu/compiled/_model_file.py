"""`resources/model.bin`: the model file of the compiled library; `c/sn_model.h` reads it and checks every length.

Little-endian, as are all five platforms. Head (32 bytes): magic, format, byte-order mark, length, CRC-32 of the rest.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError
from softneck.runtime import PREFIX, Block, Port, split_members

from ..describe._description import NO_LOOK_AHEAD, LookAhead
from .translate._kinds import is_known, module_of, ranks_of

_MAGIC_BYTES = b"SNMODEL\0"
FORMAT = 3
_BYTE_ORDER_MARK = 0x01020304
_HEAD_BYTES = 32
_BOOLEAN, _MISSING, _INTEGER, _TUNABLE = 1, 2, 4, 8


@dataclass(frozen=True, slots=True)
class Node:
    """A runtime module, its own arrays, and its members."""

    module: str
    arrays: tuple[Matrix, ...]
    members: tuple[Node, ...] = ()

    @property
    def modules(self) -> set[str]:
        """The modules of this node and its members."""
        return {self.module}.union(*(member.modules for member in self.members))


def node_of(runtime: str, arrays: tuple[Matrix, ...]) -> Node:
    """Return the tree for the runtime name `outer(inner:11,other:13)` and its arrays.

    Raises SettingsError: a runtime that is not in the table, or arrays of other ranks than declared.
    """
    outer, _, inner = runtime.partition("(")
    pairs = [part.rpartition(":") for part in split_members(inner[:-1])] if inner else []
    if outer.startswith(PREFIX):
        raise SettingsError("a Python object cannot be in a compiled FMU; use `--backend python`.")
    runs = module_of(outer)
    if not is_known(runs):
        kind = outer.rpartition(".")[2].partition("@")[0].strip("_").removesuffix("_runtime")
        raise SettingsError(f"`{kind}` cannot be in a compiled FMU; use `--backend python`.")
    own = len(arrays) - sum(int(count) for _, _, count in pairs)
    ranks = tuple(array.ndim for array in arrays[: max(own, 0)])
    if ranks != ranks_of(runs):
        raise SettingsError(
            f"`{outer}` has arrays of ranks {ranks} and the compiled library expects {ranks_of(runs)}; "
            "use `--backend python`, or correct its declaration."
        )
    members, first = [], own
    for name, _, count in pairs:
        members.append(node_of(name, arrays[first : first + int(count)]))
        first += int(count)
    return Node(runs, arrays[:own], tuple(members))


def model_bytes(block: Block, name: str, guid: str, *, looks: LookAhead = NO_LOOK_AHEAD) -> bytes:
    """Return the model file of `block`; by `guid` the library checks that it belongs to the model description.

    `looks`: which of the last outputs are the first ones at later samples.
    Raises SettingsError: the block's kind is not in the library.
    """
    writer = _Writer()
    writer.text(name)
    writer.text(guid)
    writer.plain("<d", float(block.sample_time))
    ports = (block.inputs, block.outputs, block.parameters)
    # A reference steps like a plant: sample k gives the outputs at k + 1.
    later = (looks.next, looks.ahead, looks.horizon)
    writer.plain("<7I", block.role in ("plant", "reference"), *map(len, ports), *later)
    for port in (port for group in ports for port in group):
        writer.port(port)
    writer.node(node_of(block.runtime, block.arrays))
    body = b"".join(writer.parts)
    head = _MAGIC_BYTES + struct.pack("<IIQII", FORMAT, _BYTE_ORDER_MARK, _HEAD_BYTES + len(body), zlib.crc32(body), 0)
    return head + body


class _Writer:
    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self._size = _HEAD_BYTES

    def add(self, data: bytes) -> None:
        """Append bytes."""
        self.parts.append(data)
        self._size += len(data)

    def plain(self, form: str, *values: float) -> None:
        """Append numbers."""
        self.add(struct.pack(form, *values))

    def text(self, text: str) -> None:
        """Append a text with its length and a zero."""
        data = text.encode() + b"\0"
        self.plain("<I", len(data))
        self.add(data)

    def port(self, port: Port) -> None:
        """Append a port."""
        self.text(port.name)
        self.text("1" if port.boolean else port.unit)
        low = -np.inf if port.minimum is None else float(port.minimum)
        high = np.inf if port.maximum is None else float(port.maximum)
        flags = _BOOLEAN * port.boolean | _MISSING * port.missing | _INTEGER * port.integer | _TUNABLE * port.tunable
        self.plain("<3dI", float(port.start), low, high, flags)

    def node(self, node: Node) -> None:
        """Append a tree of runtimes with their arrays."""
        self.text(node.module)
        self.plain("<I", len(node.arrays))
        for array in node.arrays:
            self.plain(f"<I{array.ndim}Q", array.ndim, *array.shape)
            self.add(bytes(-self._size % 8))
            self.add(np.ascontiguousarray(array, dtype="<f8").tobytes())
        self.plain("<I", len(node.members))
        for member in node.members:
            self.node(member)
