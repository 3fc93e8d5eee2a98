"""The rows of a loop on one bus: what happens in one, in which order, and why there may be none.

Parts, wiring, order and faults become the arrays that `_rows_runtime` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from itertools import pairwise
from typing import TypeGuard

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.robot import is_set_point
from softneck.runtime import load_linked, load_runtime

from ._disturbed_bus import FaultStages
from ._part import BlockPart, Part
from ._rows_runtime import ROWS_DISTURB, ROWS_RECORD, ROWS_REFER, ROWS_SHOW, ROWS_STEP, run_rows
from ._wiring import Tap, Wiring

# What to do, the part or place that it is about, every how many rows.
Action = tuple[int, int, int]

# Their outputs are valid one sample after the step: they break every loop of dependencies.
LATE_ROLES = ("plant", "reference")


def late(part: Part) -> bool:
    """Return whether what a step of `part` returns is valid one sample later."""
    return part.role in LATE_ROLES


def cycle(
    parts: Mapping[str, Part],
    taps: Mapping[str, Tap],
    ratios: Mapping[str, int],
    *,
    order: str,
    disturbed: bool,
    closed: bool = True,
) -> list[Action]:
    """Return the actions of a row: what is valid at t_k comes to the bus, the parts step, the row is recorded.

    Sequential, as on the hardware: the plant is read, then observer and controller step, each seeing what those
    before it say, then the plant. Jacobi: all step with what is on the bus at t_k; the outputs are seen at t_k+1.

    Args:
        parts: name -> part.
        taps: part -> its inputs.
        ratios: part -> its sample time in rows.
        order: "sequential" or "jacobi".
        disturbed: whether faults act.
        closed: whether there is a reference.

    Raises:
        SettingsError: an algebraic loop.
    """
    numbers = {name: i for i, name in enumerate(parts)}

    def each(what: int, names: Iterable[str]) -> list[Action]:
        return [(what, numbers[name], ratios[name]) for name in names]

    waiting = [name for name, part in parts.items() if late(part)]
    refer = [] if "reference" in parts or not closed else [(ROWS_REFER, len(parts), 1)]
    # Sensors' faults act on what arrives, the others on what the plant is about to read.
    at_sensors, at_plant = ([(ROWS_DISTURB, place, 1)] if disturbed else [] for place in (0, 1))
    arrive = [*each(ROWS_SHOW, waiting), *refer, *at_sensors]
    leave = [*at_plant, (ROWS_RECORD, 0, 1)]
    if order == "jacobi":
        return [*arrive, *leave, *each(ROWS_STEP, parts), *each(ROWS_SHOW, [n for n in parts if n not in waiting])]
    ordered = [
        (what, numbers[name], ratios[name]) for name in step_order(parts, taps) for what in (ROWS_STEP, ROWS_SHOW)
    ]
    return [*arrive, *ordered, *leave, *each(ROWS_STEP, waiting)]


def step_order(parts: Mapping[str, Part], taps: Mapping[str, Tap]) -> tuple[str, ...]:
    """Return the names of the parts whose outputs hold at once, each after those that feed it.

    An observer's set-points are those held until now (docs, "Timing"): they wait for no controller.

    Raises:
        SettingsError: an algebraic loop; the line names its parts and variables.
    """
    waits = {name: _feeders(name, parts, taps[name]) for name, part in parts.items() if not late(part)}
    done: list[str] = []
    while len(done) < len(waits):
        ready = [name for name in waits if name not in done and all(feeder in done for feeder in waits[name])]
        if not ready:
            raise SettingsError(_circle({name: waits[name] for name in waits if name not in done}))
        # An observer before whoever moves the motors, wherever it stands: else it would know set-points of its future.
        done.append(min(ready, key=lambda name: parts[name].role != "observer"))
    return tuple(done)


def _feeders(name: str, parts: Mapping[str, Part], tap: Tap) -> dict[str, str]:
    """Return the part -> variable that must be known before `name` steps."""
    feeders = {}
    for owner, port in zip(tap.owners, tap.ports, strict=True):
        held = parts[name].role == "observer" and is_set_point(port.name)
        if owner in parts and not late(parts[owner]) and not held:
            feeders.setdefault(owner, port.name)
    return feeders


def _circle(waits: Mapping[str, Mapping[str, str]]) -> str:
    path = [next(iter(waits))]
    while path.count(path[-1]) < 2:
        path.append(next(feeder for feeder in waits[path[-1]] if feeder in waits))
    path = path[path.index(path[-1]) :][::-1]
    links = [f"{a} -> {b} `{waits[b][a]}`" for a, b in pairwise(path)]
    return (
        f"an algebraic loop: {', '.join(links)}. Each needs the other's output of the same instant; "
        'use order = "jacobi", which puts a sample between them, or break a connection.'
    )


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
        table = np.zeros((0, shown[-1].size)) if reference is None else reference
        self._plan = (
            self._cycle,
            step,
            (
                tuple(tap.slots for tap in taps),
                tuple(np.zeros((2, 0)) if tap.scales is None else tap.scales for tap in taps),
                tuple(tap.fragile for tap in taps),
                tuple(np.array(flags, dtype=np.bool_) for flags in missing),
            ),
            table,
        )
        # A block is stepped in place; whoever else calls it gets a copy of its outputs.
        self._steps = tuple(part.step if _is_its_block(part) else part.advance for part in self._parts)

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
        parts = [part for part in self._parts if _is_its_block(part)]
        function = load_linked(_MODULE, [part.block.runtime for part in parts]).run_rows
        memories = tuple(zip(*(part.memory[:2] for part in parts), strict=True))
        actions = tuple(np.array(column, dtype=np.int64) for column in self._cycle)
        return function, (actions, *self._plan[1:]), (tuple(part.block.arrays for part in parts), *memories)


def _is_its_block(part: Part) -> TypeGuard[BlockPart]:
    """Return whether a part does what its block does; not where it has an `advance` of its own."""
    return isinstance(part, BlockPart) and type(part).advance is BlockPart.advance


def can_compile(parts: Mapping[str, Part]) -> bool:
    """Return whether all parts are blocks whose runtimes numba compiled."""
    return all(_is_its_block(part) and load_runtime(part.block.runtime).compiled for part in parts.values())
