"""Result of a run on drives: its signals, named as by `softneck simulate`, and its events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softneck.core import CheckFailedError, Matrix, ReprMixin
from softneck.loop import LoopResult, metrics
from softneck.robot import Robot
from softneck.signals import NECK, Recording, known_channels

from ..master import Event

# Width [s] and number of the bins of a histogram up to 200 ms; longer periods are in the last bin.
_BIN_S = 1e-5
_BIN_COUNT = 20_000


class CycleTimes:
    """Statistics of the periods between cycles and of the computing times.

    `count`: number of periods. `late`: number of periods beyond 1.5 cycles. `missed`: cycles without a step: a period
    of n cycles misses n - 1. `longest_period`, `longest_step`: [s].
    """

    def __init__(self, cycle: float) -> None:
        """Start empty; `cycle` is the nominal period [s]."""
        self.cycle = cycle
        self.count = self.late = self.missed = 0
        self.longest_period = self.longest_step = 0.0
        self._bins = [0] * _BIN_COUNT
        self._last: float | None = None

    def take(self, now: float, step: float) -> None:
        """Add a cycle with start time `now` [s] and computing time `step` [s]."""
        self.longest_step = max(self.longest_step, step)
        if self._last is not None:
            period = now - self._last
            self.longest_period = max(self.longest_period, period)
            self.late += period > 1.5 * self.cycle
            self.missed += max(0, round(period / self.cycle) - 1)
            self.count += 1
            self._bins[min(_BIN_COUNT - 1, max(0, int(period / _BIN_S)))] += 1
        self._last = now

    def quantile(self, share: float) -> float:
        """Return the quantile `share` of the periods [s], to 10 us; 0 without periods."""
        wanted, seen = share * self.count, 0
        for index, number in enumerate(self._bins):
            seen += number
            if number and seen >= wanted:
                return (index + 1) * _BIN_S
        return 0.0

    def __str__(self) -> str:
        """Return quantiles of the periods in ms."""
        p50, p99 = 1e3 * self.quantile(0.5), 1e3 * self.quantile(0.99)
        return f"p50 {p50:.2f}   p99 {p99:.2f}   max {1e3 * self.longest_period:.2f}"

    def table(self) -> dict[str, float | int]:
        """Return the JSON values."""
        return {
            "cycles": self.count,
            "late": self.late,
            "missed": self.missed,
            "missed_share": self.missed / max(1, self.count + self.missed),
            "p50_s": self.quantile(0.5),
            "p99_s": self.quantile(0.99),
            "longest_s": self.longest_period,
            "longest_step_s": self.longest_step,
        }


def signal_units(names: Iterable[str]) -> dict[str, str]:
    """Return the unit of each signal of a run."""
    units = {name: "N" if "tension" in name else "1" if name == "healthy" else "rad" for name in names}
    return units | ({"compression": "m"} if "compression" in units else {})


def recording_of(signals: LoopResult, speeds: Matrix, robot: Robot = NECK) -> Recording:
    """Return a run as a recording: measured values, with true angles and tensions from simulated drives.

    `signals`: of the run. `speeds`: of the motors at its samples, (time, motors) [rad/s]. `robot`: of the run.
    """
    known = set(known_channels(robot))
    channels = {name: values for name, values in signals.signals.items() if name in known}
    for axis in robot.outputs.names:
        channels.setdefault(axis, signals[f"{axis}_measured"])
    for j in range(1, len(robot.motors.names) + 1):
        channels.setdefault(f"tension_{j}", signals[f"tension_estimate_{j}"])
    for rate in (f"{axis}_rate_measured" for axis in robot.outputs.names):
        if not np.isfinite(channels.get(rate, np.nan)).any():
            channels.pop(rate, None)
    if np.isfinite(speeds).any():
        channels |= dict(zip(robot.motor_velocities, speeds.T, strict=True))
    return Recording(signals.time, signals.sample_time, channels, robot=robot)


_NO_CONTACT = "The drives cannot be reached; their own guarding stops them within 0.1 s"
# Event -> text on the power of the drives after it; after other events they are off.
_POWER = {
    "bus_off": _NO_CONTACT,
    "bus_silent": _NO_CONTACT,
    "not_off": "If it may still have power, press the hardware stop (Enable input)",
}


def require_unstopped(fault: Event | None, *, rehome: bool = False) -> None:
    """Raise CheckFailedError if `fault` ended a run early."""
    if fault is None:
        return
    after = " Run `softneck drives commission --only zero` before the next run." if rehome else ""
    if fault.name == "operator":
        raise CheckFailedError(f"stopped at t = {fault.time:.3f} s by the operator. The drives are off.{after}")
    # If the drives cannot be reached, their state is unknown.
    off = _POWER.get(fault.name, "The drives are off")
    raise CheckFailedError(
        f"stopped at t = {fault.time:.3f} s: {fault}. {off}; look for the cause, then `softneck drives reset`.{after}"
    )


def fault_table(fault: Event | None) -> dict[str, Any] | None:
    """Return the JSON values of the event that ended a run early; None without one."""
    if fault is None:
        return None
    return {"time_s": fault.time, "event": fault.name, "node": fault.node, "text": str(fault)}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DrivesResult(ReprMixin):
    """Result of one run on the drives.

    Attributes:
        signals: one row for each sample of the controller while it ran.
        phase: last phase of the run: "done" or "stopped".
        fault: event that ended it early, or None.
        counts: number of occurrences of each event.
        events: the last ones.
        rehome: whether a drive lost its zero.
        cycles: of the bus.
        cycle: bus period [s].
        wall_time: [s].
        simulated: whether the drives were simulated.
        times: of the cycles, in real time.
        terminated: whether SIGTERM ended it.
        speeds: of the motors at the rows of `signals`, (rows, motors) [rad/s].
        robot: of the run.
        error: which ended the loop, or kept the drives from being switched off; None without one.
    """

    signals: LoopResult
    phase: str
    fault: Event | None
    counts: Mapping[str, int]
    events: tuple[Event, ...]
    rehome: bool
    cycles: int
    cycle: float
    wall_time: float
    simulated: bool
    times: CycleTimes
    notes: tuple[str, ...] = field(default=())
    terminated: bool = False
    speeds: Matrix = field(default_factory=lambda: np.zeros((0, 3)))
    robot: Robot = NECK
    error: Exception | None = None

    @property
    def completed(self) -> bool:
        """Whether the loop ran to its end without a stop."""
        return self.fault is None and self.phase == "done" and not self.terminated

    @property
    def real_time_factor(self) -> float:
        """Ratio of the time on the bus to the wall-clock time."""
        return self.cycles * self.cycle / max(self.wall_time, 1e-9)

    def require(self) -> None:
        """Raise the error that ended the loop, or CheckFailedError if a fault ended the run early."""
        if self.error is not None:
            raise self.error
        require_unstopped(self.fault, rehome=self.rehome)

    def recording(self) -> Recording:
        """Return the run as a recording: measured values, with true angles from simulated drives."""
        return recording_of(self.signals, self.speeds, self.robot)

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck drives run`."""
        return {
            "completed": self.completed,
            "phase": self.phase,
            "fault": fault_table(self.fault),
            "rehome": self.rehome,
            "events": dict(self.counts),
            "simulated": self.simulated,
            "cycles": self.cycles,
            "cycle_s": self.cycle,
            "real_time_factor": self.real_time_factor,
            "longest_step_s": self.times.longest_step,
            "times": None if self.simulated else self.times.table(),
            "terminated": self.terminated,
            "metrics": metrics(self.signals) if len(self.signals.time) > 1 else None,
            "notes": list(self.notes),
        }  # fmt: skip
