"""All that a running loop remembers, to be resumed later or elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from softneck.core import DataError, FileFormatError, Matrix, Vector, read_archive, write_archive
from softneck.core._shown import Shown

_KIND = "loop_state"
# Raised whenever what a part saves stands in another order: lengths alone would not tell.
_PARTS_VERSION = 2


@runtime_checkable
class SaveablePart(Protocol):
    """A part that can save its state: what it returns must be enough for a new one of its kind to go on."""

    def get_state(self) -> bytes:
        """Return the whole state."""
        ...

    def set_state(self, state: bytes) -> None:
        """Go on from `state`; the part was started before."""
        ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class LoopState(Shown):
    """A loop between two steps.

    Attributes:
        row: the next row to run.
        order, step: of the loop; another loop refuses the state.
        bus, pending, memories: signals, outputs not yet valid, what faults remember.
        table: (row, n) what ran so far.
        parts: name -> its own state.
    """

    row: int
    order: str
    step: float
    bus: Vector
    pending: Mapping[str, Vector]
    memories: tuple[Matrix, ...]
    table: Matrix
    parts: Mapping[str, bytes]

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the state to an `.npz` file."""
        header = {
            "kind": _KIND, "parts_version": _PARTS_VERSION, "row": self.row, "order": self.order,
            "step": self.step.hex(), "faults": len(self.memories), "pending": list(self.pending),
            "parts": {name: base64.b64encode(state).decode() for name, state in self.parts.items()},
        }  # fmt: skip
        arrays = {"bus": self.bus, "table": self.table}
        arrays |= {f"pending_{i}": values for i, values in enumerate(self.pending.values())}
        arrays |= {f"memory_{i}": memory for i, memory in enumerate(self.memories)}
        write_archive(path, header, arrays, force=force)

    @staticmethod
    def load(path: str | Path) -> LoopState:
        """Read a state that `save` wrote; raise FileFormatError if it is something else."""
        header, arrays = read_archive(path)
        if header.get("kind") != _KIND:
            raise FileFormatError(f"{path}: does not hold the state of a loop.")
        if header.get("parts_version") != _PARTS_VERSION:
            raise FileFormatError(
                f"{path}: was saved by another version of softneck, whose parts keep their numbers in another order; "
                "run the loop from its start."
            )
        try:
            return LoopState(
                row=int(header["row"]),
                order=str(header["order"]),
                step=float.fromhex(header["step"]),
                bus=arrays["bus"],
                pending={name: arrays[f"pending_{i}"] for i, name in enumerate(header["pending"])},
                memories=tuple(arrays[f"memory_{i}"] for i in range(header["faults"])),
                table=arrays["table"],
                parts={name: base64.b64decode(text) for name, text in header["parts"].items()},
            )
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"{path}: its header and arrays do not fit together ({error}).") from error

    def check(self, *, order: str, step: float, bus: Vector, memories: tuple[Matrix, ...], parts: set[str]) -> None:
        """Raise DataError unless the state belongs to a loop like that."""
        shapes = [memory.shape for memory in self.memories]
        fits = (
            (self.order, self.step, set(self.parts)) == (order, step, parts)
            and self.bus.shape == np.shape(bus)
            and shapes == [memory.shape for memory in memories]
        )
        if not fits:
            raise DataError(
                f"the state is of another loop (parts {', '.join(self.parts)}, order {self.order}, step "
                f"{self.step:g} s, {len(shapes)} faults); resume it in the loop that saved it."
            )
