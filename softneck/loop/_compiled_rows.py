"""A loop of blocks as arrays, for the compiled rows of `_rows_runtime`; the Python master stays the reference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_runtime
from softneck.runtime._compile import load_linked

from ._disturbed_bus import ActiveFault, FaultStages
from ._part import BlockPart, Part
from ._wiring import REFERENCE_PORTS, Wiring

if TYPE_CHECKING:
    from collections.abc import Callable

_MODULE = "softneck.loop._compiled_rows_runtime"
_KINDS = {
    "dropout": 0, "freeze": 1, "stuck": 1, "bias": 2, "offset": 2, "add": 2, "delay": 3, "noise": 4, "outlier": 4,
    "slow": 5,
}  # fmt: skip
_RANDOM = 4
_EMPTY = np.zeros(0, dtype=np.int64)


class CompiledRows:
    """The rows of one run as a compiled function; see `_rows_runtime` for what it does.

    Attributes:
        names: of the parts, by the number that `run` returns.
    """

    def __init__(
        self,
        parts: Mapping[str, BlockPart],
        wiring: Wiring,
        *,
        sequential: bool,
        order: tuple[str, ...],
        late: tuple[str, ...],
        ratios: Mapping[str, int],
        reference: Matrix | None,
        stages: FaultStages | None,
        rows: int,
    ) -> None:
        """Compile, or take from the cache, the rows of a loop of these parts; all of them have started."""
        self.names = tuple(parts)
        number = {name: i for i, name in enumerate(self.names)}
        self._run: Callable[..., tuple[int, int, int]] = load_linked(
            _MODULE, [part.block.runtime for part in parts.values()]
        ).run_rows
        self._acting = (*stages.sensors, *stages.plant) if stages is not None else ()
        self._memory, faults = _faults(stages, rows)
        places = [wiring.spans[name].start for name in self.names]
        at = wiring.spans["reference"].start
        # One column of the table for each port of the reference.
        table = np.zeros((0, len(REFERENCE_PORTS))) if reference is None else reference
        self._plan = (
            sequential, _whole([number[name] for name in order]), _whole([ratios[name] for name in self.names]),
            np.array([name in late for name in self.names]), _whole(places), _taps(self.names, wiring),
            (at, table), _detours(stages), faults,
        )  # fmt: skip
        self._parts = list(parts.values())

    def run(self, first: int, stop: int, pending: Mapping[str, Vector], bus: Vector, table: Matrix) -> tuple:
        """Run rows `first` to `stop`; return (next row, 0 or what went wrong, part)."""
        for acting, (begin, end) in zip(self._acting, self._spans(), strict=True):
            self._memory[begin:end] = acting.memory.ravel()
        held = [part.memory for part in self._parts]
        parts = (
            tuple(part.block.arrays for part in self._parts),
            tuple(parameters for parameters, _, _ in held),
            tuple(state for _, state, _ in held),
            tuple(outputs for _, _, outputs in held),
            tuple(pending.get(name, np.zeros(0)) for name in self.names),
            tuple(np.array([port.missing for port in part.outputs], dtype=np.bool_) for part in self._parts),
        )
        found = self._run(first, stop, self._plan, parts, bus, table)
        for acting, (begin, end) in zip(self._acting, self._spans(), strict=True):
            acting.memory[:] = self._memory[begin:end].reshape(acting.memory.shape)
        return found

    def _spans(self) -> list[tuple[int, int]]:
        ends = np.cumsum([0, *(acting.memory.size for acting in self._acting)])
        return [(int(ends[i]), int(ends[i + 1])) for i in range(len(self._acting))]


def can_compile(parts: Mapping[str, Part]) -> bool:
    """Return whether all parts are blocks whose runtimes numba compiled."""
    return all(isinstance(part, BlockPart) and load_runtime(part.block.runtime).compiled for part in parts.values())


def _taps(names: tuple[str, ...], wiring: Wiring) -> tuple[np.ndarray, ...]:
    taps = [wiring.taps[name] for name in names]
    begins = np.cumsum([0, *(tap.slots.size for tap in taps)])
    factors = [np.ones(tap.slots.size) if tap.factors is None else tap.factors for tap in taps]
    fragile = [np.isin(np.arange(tap.slots.size), tap.fragile) for tap in taps]
    slots = np.concatenate([tap.slots for tap in taps])
    return _whole(begins), _whole(slots), np.concatenate(factors).astype(np.float64), np.concatenate(fragile)


def _detours(stages: FaultStages | None) -> tuple[np.ndarray, ...]:
    if stages is None:
        return (_EMPTY,) * 4
    return tuple(_whole(x) for x in (stages.sensor_from, stages.sensor_to, stages.plant_from, stages.plant_to))


def _faults(stages: FaultStages | None, rows: int) -> tuple[Vector, tuple[Any, ...]]:
    """Return the memory of all faults, and the arrays that `rows_fault` reads."""
    placed = [] if stages is None else [(0, a) for a in stages.sensors] + [(1, a) for a in stages.plant]
    codes, slots, values, at, held = [], [], [], 0, 0
    for place, acting in placed:
        kind = _KINDS[acting.what]
        n, m = acting.slots.size, acting.flags.size
        codes.append([place, kind, acting.first, acting.last, at, at + n, at + n + m, held, acting.memory.shape[0]])
        slots += [*acting.slots.tolist(), *acting.flags.tolist()]
        fixed = acting.most if acting.what == "slow" else np.zeros(n) if kind == _RANDOM else acting.amount(0)
        values += [*fixed.tolist(), *[0.0] * m]
        at, held = at + n + m, held + acting.memory.size
    memory = np.zeros(held)
    added = np.zeros((rows, at)) if any(row[1] == _RANDOM for row in codes) else np.zeros((0, at))
    for (_, acting), row in zip(placed, codes, strict=True):
        if row[1] == _RANDOM:
            _draw(acting, added[:, row[4] : row[5]])
    table = np.array(codes, dtype=np.int64).reshape(-1, 9)
    return memory, (table, _whole(slots), np.array(values, dtype=np.float64), added, memory)


def _draw(acting: ActiveFault, added: Matrix) -> None:
    for k in range(min(acting.first, len(added)), min(acting.last, len(added))):
        added[k] = acting.amount(k)


def _whole(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.int64)
