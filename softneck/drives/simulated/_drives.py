"""Simulated drives of any plant: nodes on the bus, motion table, and faults of the sensor."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, require_between, require_one_of

from . import _servo_runtime as servo
from ._axis import Axis
from ._node import CanFrame, SimulatedDrive
from ._profiles import PROFILES
from ._quirks import DriveQuirks

_TICK_S = 1e-3
# Length of the ring buffer [ticks]: longer than the largest `drive_latency`, 0.1 s.
_RING_TICKS = 128


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SimulatedSettings(ReprMixin):
    """Settings of the simulated drives, as configured on the real ones.

    Attributes:
        nodes: node numbers, one for each motor.
        profile: "ipos2015" or "ds402".
        gear, counts_per_turn: of each drive.
        reversed: whether the winch pulls when the counts fall, one each.
        peak_current: [A], one each.
        slow_loop: [s], one each.
        sample_time: of the inclinometer [s].
        cycle: time between SYNC messages [s].
        hold: time over which master and drives spread one change of the set-point [s]; half of it counts as part of
            the neck's drive latency.
        homed: whether the drives were zeroed with the neck at rest before.
        seed: of the inclinometer's noise.
        quirks: restrictions of the drives.
    """

    nodes: tuple[int, ...] = (1, 2, 3)
    profile: str = "ipos2015"
    gear: tuple[float, ...] = (1539.0 / 65.0, 1539.0 / 65.0, 1539.0 / 65.0)
    counts_per_turn: tuple[float, ...] = (2048.0, 2048.0, 2048.0)
    reversed: tuple[bool, ...] = (False, False, False)
    peak_current: tuple[float, ...] = (10.0, 10.0, 10.0)
    slow_loop: tuple[float, ...] = (1e-3, 1e-3, 1e-3)
    sample_time: float = 0.02
    cycle: float = 0.01
    hold: float = 0.02
    homed: bool = True
    seed: int = 0
    quirks: DriveQuirks = field(default_factory=DriveQuirks)

    def __post_init__(self) -> None:
        require_one_of("profile", self.profile, tuple(PROFILES))
        require_between("cycle", self.cycle, 0.001, 0.1, "s")
        for name in ("gear", "counts_per_turn", "reversed", "peak_current", "slow_loop"):
            if len(getattr(self, name)) != len(self.nodes):
                raise SettingsError(f"`{name}` must have one value for each of the {len(self.nodes)} nodes.")


class SimulatedDrives(abc.ABC):
    """All drives of a robot with their plant and sensor; the caller advances the time.

    Attributes:
        settings: of the drives.
        drives: the nodes on the bus; twins: further nodes with the number of one of them.
        motion: (motors, SERVO_SIZE), see the servo runtime; ring: (motors, n) past demands.
        ticks: of the servo loops in one bus cycle; h: length of a tick [s].
        sensor: "works", "drops", "freezes", "nan", "jumps", or "silent" on a bus.
        newest: the last sample.
    """

    def __init__(self, settings: SimulatedSettings, *, current_limit: float, latency: float) -> None:
        """Make drives without power; `homed` ones have their zero.

        `settings`: of the drives. `current_limit`: initial current limit [A]. `latency`: of the cyclic mode [s].
        """
        count = len(settings.nodes)
        self.settings = settings
        self.motion: Matrix = np.zeros((count, servo.SERVO_SIZE))
        self.ring: Matrix = np.zeros((count, _RING_TICKS))
        self.ticks = max(1, round(settings.cycle / _TICK_S))
        self.h = settings.cycle / self.ticks
        lag = latency - 0.5 * settings.hold
        for row in range(count):
            size = settings.gear[row] * settings.counts_per_turn[row] / (2.0 * math.pi)
            self.motion[row, servo.SERVO_SCALE] = -size if settings.reversed[row] else size
            self.motion[row, servo.SERVO_LAG] = max(0, round(lag / self.h))
            self.motion[row, servo.SERVO_PLACE], self.motion[row, servo.SERVO_GEARING] = 0, 1.0
        self.drives = tuple(self._drive(settings, row, current_limit) for row in range(count))
        # A second device with a used node number has no plant; its boot-up message was earlier.
        self.twins = tuple(twin(node, settings) for node in (settings.quirks.twin,) if node)
        self._latency = settings.quirks.sdo_latency
        self._late: list[tuple[float, CanFrame]] = []
        self.sensor = "works"
        self.newest = self._last = Sample(0.0, (), (), valid=True)

    @abc.abstractmethod
    def set(self, **disturbance: float) -> None:
        """Set disturbances by name."""

    @abc.abstractmethod
    def move(self) -> None:
        """Advance drives and plant by one bus cycle."""

    @abc.abstractmethod
    def truth(self) -> Mapping[str, float]:
        """Return the true values at the last sample by name: outputs [rad], tensions [N]."""

    @abc.abstractmethod
    def _measure(self) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
        """Return values [rad], rates [rad/s] and validity of a new sample of a healthy sensor."""

    def block(self, motor: int) -> None:
        """Block a winch at its position; the first has number 1."""
        self.motion[motor - 1, servo.SERVO_STUCK] = 1.0

    def sample(self, now: float) -> Sample:
        """Take one sample of the sensor; to be called each `sample_time`."""
        values, rates, valid = self._measure()
        if self.sensor == "freezes":
            self.newest = self._last._replace(time=now)
            return self.newest
        values, rates, valid = sensor_channels(self.sensor, values, rates, valid=valid)
        self.newest = Sample(now, values, rates, valid=valid)
        if not math.isnan(values[0]):
            self._last = self.newest
        return self.newest

    def run(self, frames: Sequence[CanFrame], now: float) -> list[CanFrame]:
        """Deliver `frames` at `now` [s] and return the frames of the drives; SDO answers after their latency."""
        drives = (*self.drives, *self.twins)
        for frame in frames:
            for drive in drives:
                drive.receive(now, frame)
        said = [frame for drive in drives for frame in drive.tick(now)]
        if not self._latency:
            return said
        answers = [frame for frame in said if 0x580 <= frame.identifier < 0x600]
        self._late += [(now + self._latency, frame) for frame in answers]
        due = [frame for time, frame in self._late if time <= now + 1e-9]
        self._late = [entry for entry in self._late if entry[0] > now + 1e-9]
        return [*(frame for frame in said if frame not in answers), *due]

    def _drive(self, s: SimulatedSettings, row: int, current_limit: float) -> SimulatedDrive:
        m = self.motion[row]
        axis = Axis(
            s.nodes[row], PROFILES[s.profile](), m, peak_current=s.peak_current[row], slow_loop=s.slow_loop[row],
            quirks=s.quirks,
        )  # fmt: skip
        axis.tick, axis.counts_per_turn = self.h, s.counts_per_turn[row]
        m[servo.SERVO_CURRENT_LIMIT] = current_limit
        if s.homed:
            # As after `drives commission --only zero`: home offset 1 count, which no drive has after a reset.
            axis.values[(0x607C, 0)] = 1
            m[servo.SERVO_ZERO], m[servo.SERVO_POSITION] = 1.0, 1.0
            axis.homed = True
        return SimulatedDrive(axis)


def twin(node: int, settings: SimulatedSettings) -> SimulatedDrive:
    """Return a drive with number `node` without a plant, like one left on the bus by mistake."""
    axis = Axis(
        node, PROFILES[settings.profile](), np.zeros(servo.SERVO_SIZE), peak_current=10.0, slow_loop=1e-3,
        quirks=settings.quirks,
    )  # fmt: skip
    axis.values[(0x1018, 4)] = 2000 + node
    drive = SimulatedDrive(axis)
    drive.tick(0.0)
    return drive


def sensor_channels(
    kind: str, values: tuple[float, ...], rates: tuple[float, ...], *, valid: bool
) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
    """Return values, rates and validity from a sensor that "works", "drops", gives "nan" or "jumps" by 60 deg."""
    nothing = (math.nan,) * len(values)
    if kind == "nan":
        return nothing, nothing, True
    if kind == "drops" or not valid:
        return nothing, nothing, False
    jump = math.radians(60.0) if kind == "jumps" else 0.0
    return (values[0] + jump, *values[1:]), rates, True


class Sample(NamedTuple):
    """One sample of the sensor: values [rad] and rates [rad/s] of all outputs; NaN and not `valid` if dropped."""

    time: float
    values: tuple[float, ...]
    rates: tuple[float, ...]
    valid: bool
