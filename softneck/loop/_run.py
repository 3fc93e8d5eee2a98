"""One run of a loop: started, advanced row by row."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector, require_steps, to_si
from softneck.runtime import Port

from ._disturbed_bus import place_faults
from ._loop import Loop, System
from ._part import Part
from ._result import LoopResult
from ._rows import Rows, can_compile, cycle
from ._wiring import BusSignal, Wiring, reference_ports, wire

# Ratio of two sample times that should be whole; 1e-6 allows 0.02 / 0.01 in binary and nothing else.
_RATIO_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class LoopStep:
    """What a step callback sees: the signals of one row."""

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
        loop: what to run.
        report: called now and then with the done fraction, 0 to 1.
        on_step: called after each row; it stops the run by returning True.
        pace: run at this multiple of real time; as fast as possible if not given.
        keep: leave the parts loaded for the next run; `loop.close()` releases them.
        compiled: run all rows as one compiled function where all parts are blocks and nobody watches the steps: the
            same bits, much sooner once it is compiled; other loops run as always.

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
        loop: what runs.
        row, rows: the next row and their number in all.
        step: base step [s], the shortest sample time.
    """

    def __init__(self, loop: Loop | System, *, compiled: bool = False) -> None:
        """Wire `loop`; the parts start with the first `advance`.

        `compiled` takes compiled rows where all parts are blocks.
        """
        self.loop, self._parts = loop, dict(loop.parts)
        closed = isinstance(loop, Loop)
        self.step, ratios = _schedule(self._parts)
        wiring = wire(self._parts, loop.constants, loop.connections, loop.robot, closed=closed)
        self._cycle = cycle(
            self._parts, wiring.taps, ratios, order=loop.order, disturbed=bool(loop.faults), closed=closed
        )  # fmt: skip
        self.row = 0
        self.rows = max(1, require_steps("duration_s", loop.duration, self.step, wiring.start.size))
        self._wiring, self._faults = place_faults(
            loop.faults, wiring, self._parts, step=self.step, rows=self.rows, robot=loop.robot
        )  # fmt: skip
        self._columns = _columns(self._wiring) if closed else _plain_columns(self._wiring)
        self._table = np.empty((self.rows, self._wiring.start.size))
        self._reference = _reference_table(loop, self.step, self.rows) if isinstance(loop, Loop) else None
        self._compile = compiled and can_compile(self._parts)
        self._begun: Rows | None = None

    def __enter__(self) -> LoopRun:
        """Return the run itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release the parts."""
        self.close()

    def close(self) -> None:
        """Release the parts."""
        self._begun = None
        self.loop.close()

    def advance(
        self,
        rows: int | None = None,
        *,
        report: Callable[[float], None] | None = None,
        on_step: StepCallback | None = None,
        pace: float | None = None,
    ) -> bool:
        """Run `rows` more rows, all that are left if not given; return whether the end is reached.

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
            # Rows run until somebody wants to know of them.
            end = self.row + 1 if watched else stop if report is None else (self.row // stride + 1) * stride
            try:
                problem, part = running.run(
                    self.row, min(stop, end), self._table, compiled=self._compile and not watched
                )
            finally:
                self.row = running.row
            if problem:
                self._explain(running, part)
            if report is not None and self.row % stride == 0:
                report(self.row / self.rows)
            if pace is not None:
                _wait_until(begin + (self.row - first) * self.step / pace)
            k = self.row - 1
            if on_step is not None and on_step(LoopStep(k, k * self.step, self._table[k], self._columns)):
                self._table = self._table[: self.row]
                self.rows = self.row
                break
        return self.row == self.rows

    def _explain(self, running: Rows, part: int) -> None:
        """Raise what is wrong with the inputs or outputs of a part that stopped the rows."""
        name, time = running.names[part], self.row * self.step
        self._wiring.taps[name].read(running.bus, time)
        self._require_finite(name, running.held[part], time)

    def result(self) -> LoopResult:
        """Return the signals of all rows so far."""
        signals, units = {}, {}
        by_slot = {item.slot: item for item in self._wiring.named}
        for name, slot in self._columns.items():
            signals[name], units[name] = _in_si(self._table[: self.row, slot], by_slot[slot].port)
        return LoopResult(np.arange(self.row) * self.step, signals, units, self.step, self.loop.robot)

    def _start(self) -> Rows:
        if self._begun is None:
            outputs = {}
            for name, part in self._parts.items():
                outputs[name] = part.start(0.0, self.loop.parameters.get(name, {}))
                self._require_finite(name, outputs[name], 0.0)
            self._begun = Rows(
                self._parts, self._wiring, self._cycle, step=self.step, starts=outputs, reference=self._reference,
                faults=self._faults,
            )  # fmt: skip
        return self._begun

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
    table = np.ones((rows, len(reference_ports(loop.robot))))
    for k in range(rows):
        table[k, :-1] = function(k * step)
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if bad.size:
        k = int(bad[0])
        raise DataError(f"the reference is {table[k, :-1].tolist()} at t = {k * step:g} s; it must be finite.")
    return table


def _columns(wiring: Wiring) -> dict[str, int]:
    """Return name in the result -> place on the bus; what a sensor says goes before what the plant meant."""
    faulty = {item.port.name for item in wiring.named if item.part == "sensor"}
    columns: dict[str, int] = {}
    for item in wiring.named:
        name = _signal_name(item, columns, faulty)
        columns[name] = item.slot
    return columns


def _plain_columns(wiring: Wiring) -> dict[str, int]:
    """Return "part.output" -> place on the bus."""
    return {f"{item.part}.{item.port.name}": item.slot for item in wiring.named}


def _in_si(values: Vector, port: Port) -> tuple[Vector, str]:
    """Return a signal (N,) in SI with its unit; one of a unit that nobody knows stays as it is."""
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


def _wait_until(moment: float) -> None:
    rest = moment - clock.perf_counter()
    if rest > 0.0:
        clock.sleep(rest)
