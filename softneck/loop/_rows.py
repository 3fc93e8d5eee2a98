"""The rows of a loop on one bus: parts, wiring, order and faults as the arrays that `_rows_runtime` reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_runtime
from softneck.runtime._compile import load_linked

from ._disturbed_bus import FaultStages
from ._order import Action
from ._part import BlockPart, Part
from ._rows_runtime import run_rows
from ._wiring import REFERENCE_PORTS, Wiring

_MODULE = "softneck.loop._rows_runtime"


class Rows:
    """The rows of one run; its parts have started.

    Attributes:
        names: of the parts, by the number that `run` returns.
        bus: all signals as they are now.
        held: what each part returned last, shown on the bus when the cycle says so; behind them the reference.
    """

    def __init__(
        self,
        parts: Mapping[str, Part],
        wiring: Wiring,
        cycle: list[Action],
        *,
        step: float,
        starts: Mapping[str, Vector],
        faults: FaultStages | None = None,
        reference: Matrix | None = None,
        checked: bool = True,
    ) -> None:
        """Lay out the signals of a loop.

        Args:
            parts: name -> part.
            wiring: who feeds whom.
            cycle: the actions of a row, see `_order.cycle`.
            step: time of a row [s].
            starts: name -> outputs at the start, of those that have started.
            faults: what goes wrong.
            reference: (rows, 4) of a reference that is no part.
            checked: stop where an output becomes NaN or infinite.
        """
        self.names, self._parts = tuple(parts), tuple(parts.values())
        self._cycle, self._faults = tuple(zip(*cycle, strict=True)), faults or FaultStages([[]] * 4, [], [], 0)
        self.bus = wiring.start.copy()
        for name, outputs in starts.items():
            self.bus[wiring.spans[name]] = outputs
        shown = [self.bus[wiring.spans[name]] for name in (*self.names, "reference")]
        # A block's outputs are a part of its memory, where compiled rows find and leave them.
        self.held = tuple(
            part.memory[2] if isinstance(part, BlockPart) and name in starts else places.copy()
            for name, part, places in zip((*self.names, "reference"), (*self._parts, None), shown, strict=True)
        )
        self._following = np.zeros(1, dtype=np.int64)
        self._signals = (self.bus, self.held, tuple(shown), self._following)
        taps = [wiring.taps[name] for name in self.names]
        missing = [[port.missing for port in part.outputs] if checked else [] for part in self._parts]
        table = np.zeros((0, len(REFERENCE_PORTS))) if reference is None else reference
        self._plan = (
            self._cycle,
            step,
            (
                tuple(tap.slots for tap in taps),
                tuple(np.zeros(0) if tap.factors is None else tap.factors for tap in taps),
                tuple(tap.fragile for tap in taps),
                tuple(np.array(flags, dtype=np.bool_) for flags in missing),
            ),
            table,
        )
        # A block is stepped in place; whoever else calls it gets a copy of its outputs.
        self._steps = tuple(part.step if isinstance(part, BlockPart) else part.advance for part in self._parts)

    def run(self, first: int, stop: int, table: Matrix, *, compiled: bool = False) -> tuple[int, int]:
        """Run rows `first` to `stop`, noted in `table`; return 0 or what went wrong, and the part."""
        faults = self._faults
        self._following[0] = first
        faults.draw(first, stop)
        if compiled:
            function, plan, parts = self._linked
            return function(first, stop, plan, self._signals, faults.arrays, parts, table)
        return run_rows(first, stop, self._plan, self._signals, faults.lists, self._steps, table)

    @property
    def row(self) -> int:
        """The next row, also where a part broke off with an error."""
        return int(self._following[0])

    @cached_property
    def _linked(self) -> tuple[Callable[..., tuple[int, int]], tuple, tuple]:
        """The compiled rows, and their plan and parts."""
        parts = [part for part in self._parts if isinstance(part, BlockPart)]
        function = load_linked(_MODULE, [part.block.runtime for part in parts]).run_rows
        memories = tuple(zip(*(part.memory[:2] for part in parts), strict=True))
        actions = tuple(np.array(column, dtype=np.int64) for column in self._cycle)
        return function, (actions, *self._plan[1:]), (tuple(part.block.arrays for part in parts), *memories)


def can_compile(parts: Mapping[str, Part]) -> bool:
    """Return whether all parts are blocks whose runtimes numba compiled."""
    return all(isinstance(part, BlockPart) and load_runtime(part.block.runtime).compiled for part in parts.values())
