"""Run a loop: the actions of a row in their order, and all rows on one bus of signals."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeGuard

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, require_steps, to_si
from softneck.robot import is_set_point
from softneck.runtime import Port, load_linked, load_runtime

from ._disturbed_bus import FaultStages, place_faults
from ._loop import BlockPart, EndedError, Loop, Part, System
from ._references import reference_ports
from ._result import LoopResult
from ._rows_runtime import ROWS_DISTURB, ROWS_RECORD, ROWS_REFER, ROWS_SHOW, ROWS_STEP, run_rows
from ._wiring import BusSignal, Tap, Wiring, wire

# (action, part or place of faults, period in rows)
Action = tuple[int, int, int]


def has_delayed_outputs(part: Part) -> bool:
    """Return whether the outputs of a step of `part` are valid one sample later, which breaks algebraic loops."""
    return part.role in ("plant", "reference")


def row_actions(
    parts: Mapping[str, Part],
    taps: Mapping[str, Tap],
    ratios: Mapping[str, int],
    *,
    order: str,
    disturbed: bool,
    closed: bool = True,
) -> list[Action]:
    """Return the actions of a row: the values at t_k are put on the bus, the parts step, the row is recorded.

    Sequential, as on the hardware: the plant is read, then observer and controller step, each with the outputs of the
    earlier ones, then the plant. Jacobi: all parts step with the bus at t_k, and their outputs are read at t_k+1.

    `ratios` are the sample times of the parts in rows; `closed` loops have a reference. Raises SettingsError: an
    algebraic loop.
    """
    numbers = {name: i for i, name in enumerate(parts)}

    def each(action: int, names: Iterable[str]) -> list[Action]:
        return [(action, numbers[name], ratios[name]) for name in names]

    waiting = [name for name, part in parts.items() if has_delayed_outputs(part)]
    refer = [] if "reference" in parts or not closed else [(ROWS_REFER, len(parts), 1)]
    # Faults of sensors act on the outputs that arrive, the others on the inputs that the plant is about to read.
    at_sensors, at_plant = ([(ROWS_DISTURB, place, 1)] if disturbed else [] for place in (0, 1))
    arrive = [*each(ROWS_SHOW, waiting), *refer, *at_sensors]
    leave = [*at_plant, (ROWS_RECORD, 0, 1)]
    if order == "jacobi":
        return [*arrive, *leave, *each(ROWS_STEP, parts), *each(ROWS_SHOW, [n for n in parts if n not in waiting])]
    ordered = [
        action for name in step_order(parts, taps) for what in (ROWS_STEP, ROWS_SHOW) for action in each(what, [name])
    ]
    return [*arrive, *ordered, *leave, *each(ROWS_STEP, waiting)]


def step_order(parts: Mapping[str, Part], taps: Mapping[str, Tap]) -> tuple[str, ...]:
    """Return the names of the parts without delayed outputs, each after those that feed it.

    An observer reads the set-points of the last row (docs, "Timing"), so it waits for no controller. Raises
    SettingsError: an algebraic loop; the message names its parts and variables.
    """
    waits = {name: _feeders(name, parts, taps[name]) for name, part in parts.items() if not has_delayed_outputs(part)}
    done: list[str] = []
    while len(done) < len(waits):
        ready = [name for name in waits if name not in done and all(feeder in done for feeder in waits[name])]
        if not ready:
            raise SettingsError(_algebraic_loop({name: waits[name] for name in waits if name not in done}))
        # An observer steps before the part that moves the motors, or it would read set-points of its future.
        done.append(min(ready, key=lambda name: parts[name].role != "observer"))
    return tuple(done)


def _feeders(name: str, parts: Mapping[str, Part], tap: Tap) -> dict[str, str]:
    """Return part -> variable of the outputs that are needed before `name` steps."""
    feeders = {}
    for owner, port in zip(tap.owners, tap.ports, strict=True):
        held = parts[name].role == "observer" and is_set_point(port.name)
        if owner in parts and not has_delayed_outputs(parts[owner]) and not held:
            feeders.setdefault(owner, port.name)
    return feeders


def _algebraic_loop(waits: Mapping[str, Mapping[str, str]]) -> str:
    path = [next(iter(waits))]
    while path.count(path[-1]) < 2:
        path.append(next(feeder for feeder in waits[path[-1]] if feeder in waits))
    path = path[path.index(path[-1]) :][::-1]
    links = [f"{a} -> {b} `{waits[b][a]}`" for a, b in pairwise(path)]
    return (
        f"an algebraic loop: {', '.join(links)}. Each needs the other's output of the same instant; "
        'use order = "jacobi", which puts a sample between them, or break a connection.'
    )


_ROWS_RUNTIME = "softneck.loop._rows_runtime"


class LoopRows:
    """The rows of one run; its parts have started.

    `names`: of the parts, by the number that `run` returns. `bus`: the current values of all signals. `held`: the last
    outputs of each part, put on the bus by an action, and the reference at the end.
    """

    def __init__(
        self,
        parts: Mapping[str, Part],
        wiring: Wiring,
        actions: list[Action],
        *,
        step: float,
        starts: Mapping[str, Vector],
        faults: FaultStages | None = None,
        reference: Matrix | None = None,
        checked: bool = True,
    ) -> None:
        """Lay out the signals of a loop with this `step` [s] of a row.

        `starts` are the outputs of the parts that have started, `reference` (rows, outputs + 2) is one that is no part.
        `checked` stops the run where an output becomes NaN or infinite.
        """
        self.names, self._parts = tuple(parts), tuple(parts.values())
        self._actions, self._faults = tuple(zip(*actions, strict=True)), faults or FaultStages([[]] * 4, [], [], 0)
        self.bus = wiring.start.copy()
        for name, outputs in starts.items():
            self.bus[wiring.spans[name]] = outputs
        shown = [self.bus[wiring.spans[name]] for name in (*self.names, "reference")]
        # Outputs of blocks are a part of their memory, which compiled rows read and write.
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
            self._actions,
            step,
            (
                tuple(tap.slots for tap in taps),
                tuple(np.zeros((2, 0)) if tap.scales is None else tap.scales for tap in taps),
                tuple(tap.fragile for tap in taps),
                tuple(np.array(flags, dtype=np.bool_) for flags in missing),
                tuple(np.empty(tap.slots.size) for tap in taps),
            ),
            table,
        )
        # Blocks are stepped in place, without copies of their outputs.
        self._steps = tuple(part.step if _is_its_block(part) else part.advance for part in self._parts)

    def run(self, first: int, stop: int, table: Matrix, *, compiled: bool = False) -> tuple[int, int]:
        """Run rows `first` to `stop` into `table`; return 0 or the code of the problem, and the part."""
        faults = self._faults
        self._following[0] = first
        faults.draw(first, stop)
        if compiled:
            function, plan, parts = self._linked
            return function(first, stop, plan, self._signals, faults.arrays, parts, table)
        return run_rows(first, stop, self._plan, self._signals, faults.lists, self._steps, table)

    @property
    def row(self) -> int:
        """The next row, also after an error of a part."""
        return int(self._following[0])

    @cached_property
    def _linked(self) -> tuple[Callable[..., tuple[int, int]], tuple, tuple]:
        """The compiled rows, and their plan and parts."""
        parts = [part for part in self._parts if _is_its_block(part)]
        function = load_linked(_ROWS_RUNTIME, "run_rows", [part.block.runtime for part in parts])
        memories = tuple(zip(*(part.memory[:2] for part in parts), strict=True))
        actions = tuple(np.array(column, dtype=np.int64) for column in self._actions)
        return function, (actions, *self._plan[1:]), (tuple(part.block.arrays for part in parts), *memories)


def _is_its_block(part: Part) -> TypeGuard[BlockPart]:
    """Return whether a part only steps its block; a subclass may override `advance`."""
    return isinstance(part, BlockPart) and type(part).advance is BlockPart.advance


# Ratio of two sample times that should be whole; 1e-6 allows 0.02 / 0.01 in binary and nothing else.
_RATIO_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class LoopStep:
    """The signals of one row, for a step callback."""

    index: int
    time: float
    values: Vector
    columns: Mapping[str, int]

    def __getitem__(self, name: str) -> float:
        """Return a signal by its name in the result; raise DataError with the known names if there is none."""
        try:
            return float(self.values[self.columns[name]])
        except KeyError:
            raise DataError(f"the loop has no signal `{name}`; it has {', '.join(self.columns)}.") from None


# Called after each row; returning True stops the run there.
StepCallback = Callable[[LoopStep], bool | None]


def run_loop(
    loop: Loop | System,
    report: Callable[[float], None] | None = None,
    *,
    on_step: StepCallback | None = None,
    pace: float | None = None,
    keep: bool = False,
    compiled: bool = False,
) -> LoopResult:
    """Run `loop` from t = 0 and return its signals, one row for each sample of the fastest part.

    Args:
        loop: to run.
        report: called regularly with the done fraction, 0 to 1.
        on_step: called after each row; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        keep: leave the parts loaded for the next run; `loop.close()` releases them.
        compiled: run all rows as one compiled function if all parts are blocks and there is neither `on_step` nor
            `pace`; the results are the same to the bit.

    Raises:
        SettingsError: sample times that do not divide, inputs without a source, algebraic loops.
        DataError: a part returned NaN or infinity; the message names part, variable and time.
    """
    run = LoopRun(loop, compiled=compiled)
    try:
        run.advance(report=report, on_step=on_step, pace=pace)
    except BaseException:
        run.close()
        raise
    if not keep:
        run.close()
    return run.result()


class LoopRun:
    """A loop that is running; use it in a `with` statement, which releases the parts at the end.

    Attributes:
        loop: that runs.
        row, rows: the next row and the number of rows.
        step: base step [s], the shortest sample time.
    """

    def __init__(self, loop: Loop | System, *, compiled: bool = False) -> None:
        """Connect the parts of `loop`, which start with the first `advance`; `compiled` as in `run_loop`."""
        self.loop, self._parts = loop, dict(loop.parts)
        closed = isinstance(loop, Loop)
        self.step, ratios = _schedule(self._parts)
        wiring = wire(self._parts, loop.constants, loop.connections, loop.robot, closed=closed)
        self._actions = row_actions(
            self._parts, wiring.taps, ratios, order=loop.order, disturbed=bool(loop.faults), closed=closed
        )  # fmt: skip
        self.row = 0
        self.rows = max(1, require_steps("duration_s", loop.duration, self.step, wiring.start.size))
        self._wiring, self._faults = place_faults(
            loop.faults, wiring, self._parts, step=self.step, rows=self.rows, robot=loop.robot
        )  # fmt: skip
        plain = {f"{item.part}.{item.port.name}": item.slot for item in self._wiring.named}
        self._columns = _columns(self._wiring) if closed else plain
        self._table = np.empty((self.rows, self._wiring.start.size))
        self._reference = _reference_table(loop, self.step, self.rows) if isinstance(loop, Loop) else None
        self._compile = compiled and all(
            _is_its_block(part) and load_runtime(part.block.runtime).compiled for part in self._parts.values()
        )
        self._running: LoopRows | None = None
        self._ended = ""

    def __enter__(self) -> LoopRun:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the parts."""
        self._running = None
        self.loop.close()

    def advance(
        self,
        rows: int | None = None,
        *,
        report: Callable[[float], None] | None = None,
        on_step: StepCallback | None = None,
        pace: float | None = None,
    ) -> bool:
        """Run `rows` more rows, or all that are left; return whether the end is reached.

        Raises:
            DataError: a part returned NaN or infinity; the message names part, variable and time.
        """
        running = self._start()
        stop = self.rows if rows is None else min(self.rows, self.row + rows)
        stride = max(1, self.rows // 100)
        if pace is not None and not pace > 0.0:
            raise SettingsError(f"`pace` must be positive (1 is real time); got {pace}.")
        watched = on_step is not None or pace is not None
        begin, first = clock.perf_counter(), self.row
        while self.row < stop:
            # LoopRows run in one call until the next callback.
            end = self.row + 1 if watched else stop if report is None else (self.row // stride + 1) * stride
            try:
                problem, part = running.run(
                    self.row, min(stop, end), self._table, compiled=self._compile and not watched
                )
            except EndedError as error:
                if running.row == 0:
                    raise
                self.row = running.row
                self._cut(str(error))
                break
            finally:
                self.row = running.row
            if problem:  # raises the DataError of the part's inputs or outputs
                name, time = running.names[part], self.row * self.step
                self._wiring.taps[name].read(running.bus, time)
                self._require_finite(name, running.held[part], time)
            if report is not None and self.row % stride == 0:
                report(self.row / self.rows)
            if pace is not None:
                rest = begin + (self.row - first) * self.step / pace - clock.perf_counter()
                if rest > 0.0:
                    clock.sleep(rest)
            k = self.row - 1
            if on_step is not None and on_step(LoopStep(k, k * self.step, self._table[k], self._columns)):
                self._cut("")
                break
        return self.row == self.rows

    def _cut(self, reason: str) -> None:
        """End the run with the rows so far."""
        self._table, self.rows, self._ended = self._table[: self.row], self.row, reason

    def result(self) -> LoopResult:
        """Return the signals of all rows so far."""
        signals, units = {}, {}
        by_slot = {item.slot: item for item in self._wiring.named}
        for name, slot in self._columns.items():
            signals[name], units[name] = _in_si(self._table[: self.row, slot], by_slot[slot].port)
        time = np.arange(self.row) * self.step
        return LoopResult(time, signals, units, self.step, self.loop.robot, self._ended)

    def _start(self) -> LoopRows:
        if self._running is None:
            outputs = {}
            for name, part in self._parts.items():
                outputs[name] = part.start(0.0, self.loop.parameters.get(name, {}))
                self._require_finite(name, outputs[name], 0.0)
            self._running = LoopRows(
                self._parts, self._wiring, self._actions, step=self.step, starts=outputs, reference=self._reference,
                faults=self._faults,
            )  # fmt: skip
        return self._running

    def _require_finite(self, name: str, outputs: Vector, time: float) -> None:
        for port, value in zip(self._parts[name].outputs, outputs, strict=True):
            if not math.isfinite(value) and not (port.missing and math.isnan(value)):
                raise DataError(f"output `{port.name}` of the {name} became {value} in the step at t = {time:g} s.")


def _schedule(parts: Mapping[str, Part]) -> tuple[float, dict[str, int]]:
    """Return the base step [s] (the shortest sample time) and each part's multiple of it."""
    step = min(part.sample_time for part in parts.values())
    ratios = {}
    for name, part in parts.items():
        ratio = part.sample_time / step
        if not math.isclose(ratio, round(ratio), rel_tol=_RATIO_TOLERANCE):
            listed = ", ".join(f"{other} {item.sample_time:g} s" for other, item in parts.items())
            raise SettingsError(f"the sample times do not divide: {listed}; each must be a multiple of the shortest.")
        ratios[name] = round(ratio)
    return step, ratios


def _reference_table(loop: Loop, step: float, rows: int) -> Matrix | None:
    """Return (rows, outputs + 2) all samples of a reference that is a function; None for one that is a part."""
    if hasattr(loop.reference, "advance"):
        return None
    function: Callable[[float], tuple[float, ...]] = loop.reference  # pyright: ignore[reportAssignmentType]
    sample = _kept_samples if getattr(function, "repeats", False) else _samples
    return sample(function, step, rows, len(reference_ports(loop.robot)))


def _samples(function: Callable[[float], tuple[float, ...]], step: float, rows: int, columns: int) -> Matrix:
    table = np.ones((rows, columns))
    table[:, :-1] = [function(k * step) for k in range(rows)]
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if bad.size:
        k = int(bad[0])
        raise DataError(f"the reference is {table[k, :-1].tolist()} at t = {k * step:g} s; it must be finite.")
    return table


# Of a search and its certificate most loops have the same few references.
_kept_samples = lru_cache(maxsize=64)(_samples)


def _columns(wiring: Wiring) -> dict[str, int]:
    """Return name in the result -> position on the bus; a sensor's signal takes the name of the plant's."""
    faulty = {item.port.name for item in wiring.named if item.part == "sensor"}
    columns: dict[str, int] = {}
    for item in wiring.named:
        columns[_signal_name(item, columns, faulty)] = item.slot
    return columns


def _in_si(values: Vector, port: Port) -> tuple[Vector, str]:
    """Return a signal (N,) in SI with its unit; a signal with an unknown unit stays unchanged."""
    try:
        factor, unit = to_si(port.unit or "1")
    except DataError:
        return values.copy(), port.unit
    return (values.copy(), port.unit) if factor == 1.0 else (values * factor, unit)


def _signal_name(item: BusSignal, taken: Mapping[str, int], faulty: set[str]) -> str:
    name = item.port.name
    if item.part == "observer" and name not in ("innovation", "healthy"):
        return f"{name}_estimate"
    if item.part == "plant" and name in faulty:
        return f"plant_{name}"
    return name if name not in taken else f"{item.part}_{name}"
