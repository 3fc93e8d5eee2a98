"""Three simulated drives on the virtual neck, and its inclinometer: what hangs on the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_one_of
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState
from softneck.runtime import load_functions

from ._axis import Axis
from ._frame import CanFrame
from ._node import SimulatedDrive
from ._profiles import PROFILES
from ._servo_runtime import (
    SERVO_CURRENT_LIMIT,
    SERVO_LAG,
    SERVO_PLACE,
    SERVO_POSITION,
    SERVO_SCALE,
    SERVO_SIZE,
    SERVO_STUCK,
    SERVO_ZERO,
)

_TICK = 1e-3
# What the ring must hold: the upper end of `drive_latency`, 0.1 s, in ticks.
_RING = 128
_DISTURBANCES = ("payload", "push_x", "push_y", "base_tilt_pitch", "base_tilt_roll")
_OUTPUTS = 14


class TiltSample(NamedTuple):
    """One sample of the inclinometer, NaN and `valid` False where it dropped out."""

    time: float
    pitch: float
    roll: float
    pitch_rate: float
    roll_rate: float
    valid: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedSettings:
    """How the simulated drives are set up; given by whoever configured the real ones.

    Attributes:
        nodes: node numbers.
        profile: "ipos2015" or "ds402".
        gear, counts_per_turn: of each drive.
        reversed: whether the winch pulls when the counts fall, one each.
        peak_current: [A], one each.
        slow_loop: [s], one each.
        sample_time: of the inclinometer [s].
        cycle: time between SYNC messages [s].
        hold: time over which master and drives spread one move of the set-point [s]; half of it counts as part of
            the neck's drive latency.
        homed: the drives were zeroed with the neck at rest before.
        seed: of the inclinometer's noise.
    """

    nodes: tuple[int, int, int] = (1, 2, 3)
    profile: str = "ipos2015"
    gear: tuple[float, float, float] = (1539.0 / 65.0, 1539.0 / 65.0, 1539.0 / 65.0)
    counts_per_turn: tuple[float, float, float] = (2048.0, 2048.0, 2048.0)
    reversed: tuple[bool, bool, bool] = (False, False, False)
    peak_current: tuple[float, float, float] = (10.0, 10.0, 10.0)
    slow_loop: tuple[float, float, float] = (1e-3, 1e-3, 1e-3)
    sample_time: float = 0.02
    cycle: float = 0.01
    hold: float = 0.02
    homed: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        require_one_of("profile", self.profile, tuple(PROFILES))
        require_between("cycle", self.cycle, 0.001, 0.1, "s")


class SimulatedNeck:
    """The neck with its drives, stepped by whoever owns the time.

    Attributes:
        drives: the nodes on the bus.
        outputs: (14,) the neck's outputs at the inclinometer's last sample, in the order of its block.
        disturbance: (5,) payload [kg], pushes [N], tilt of the base [rad].
        sensor: "works", "drops", "freezes", "nan" or "jumps".
    """

    def __init__(self, parameters: NeckParameters, settings: SimulatedSettings) -> None:
        """Put the neck at rest; its drives are without power and, if `homed`, know their zero."""
        self.parameters, self.settings = parameters, settings
        block = VirtualNeck(parameters).block(noise_seed=settings.seed, sample_time=settings.sample_time)
        start = block.initial_state()
        self._arrays, self._q, self._x = block.arrays, start.parameters, start.values.copy()
        self._free = VirtualNeckState.parts(VirtualNeckArrays(block.arrays))["free"]
        self.outputs: Vector = start.outputs.copy()
        self.disturbance: Vector = np.zeros(len(_DISTURBANCES))
        self.motion: Matrix = np.zeros((3, SERVO_SIZE))
        self._ring: Matrix = np.zeros((3, _RING))
        self._functions: ModuleType = load_functions("softneck.drives.simulated._servo_runtime")
        self._ticks = max(1, round(settings.cycle / _TICK))
        self._h = settings.cycle / self._ticks
        self._samples = 0
        self.sensor = "works"
        pitch, roll, pitch_rate, roll_rate = (float(value) for value in self.outputs[2:6])
        self._last = TiltSample(0.0, pitch, roll, pitch_rate, roll_rate, True)
        lag = parameters.drive_latency - 0.5 * settings.hold
        for row in range(3):
            size = settings.gear[row] * settings.counts_per_turn[row] / (2.0 * math.pi)
            self.motion[row, SERVO_SCALE] = -size if settings.reversed[row] else size
            self.motion[row, SERVO_LAG] = max(0, round(lag / self._h))
            self.motion[row, SERVO_PLACE] = 0
        self._newest = self._last
        self.drives = tuple(self._drive(row) for row in range(3))

    def _drive(self, row: int) -> SimulatedDrive:
        s, m = self.settings, self.motion[row]
        axis = Axis(
            s.nodes[row], PROFILES[s.profile](), m, peak_current=s.peak_current[row], slow_loop=s.slow_loop[row]
        )
        axis.tick = self._h
        m[SERVO_CURRENT_LIMIT] = self.parameters.current_limit
        if s.homed:
            # As `drives zero` leaves it: home offset 1 count, which no drive has after a reset.
            axis.values[(0x607C, 0)] = 1
            m[SERVO_ZERO], m[SERVO_POSITION] = 1.0, 1.0
            axis.homed = True
        return SimulatedDrive(axis)

    def set(self, **disturbance: float) -> None:
        """Set payload [kg], push_x, push_y [N], base_tilt_pitch or base_tilt_roll [rad].

        Raises:
            SettingsError: another name.
        """
        for name, value in disturbance.items():
            if name not in _DISTURBANCES:
                raise SettingsError(f"`{name}` is not a disturbance; the neck has {', '.join(_DISTURBANCES)}.")
            self.disturbance[_DISTURBANCES.index(name)] = value

    def tear(self, tendon: int) -> None:
        """Let tendon 1, 2 or 3 hang: it is a metre too long."""
        self._x[self._free][tendon - 1] += 1.0

    def block(self, motor: int) -> None:
        """Hold winch 1, 2 or 3 where it is, whatever its motor does."""
        self.motion[motor - 1, SERVO_STUCK] = 1.0

    def run(self, frames: Sequence[CanFrame], now: float) -> list[CanFrame]:
        """Deliver `frames` at `now`, and return what the drives send in answer."""
        for frame in frames:
            for drive in self.drives:
                drive.receive(now, frame)
        return [frame for drive in self.drives for frame in drive.tick(now)]

    def move(self) -> None:
        """Let one cycle of time pass for drives and neck."""
        self._functions.servo_ticks(self._q, self._x, self.disturbance, self.motion, self._ring, self._ticks, self._h)

    def sample(self, now: float) -> TiltSample:
        """Take one sample of the inclinometer; to be called each `sample_time`."""
        self._newest = self._sampled(now)
        return self._newest

    def _sampled(self, now: float) -> TiltSample:
        if self._samples:
            self._functions.winch_sense(self._arrays, self._q, self._x, self.disturbance, self.outputs)
        self._samples += 1
        y = self.outputs
        valid = y[6] > 0.5
        if self.sensor == "freezes":
            return self._last._replace(time=now)
        if self.sensor == "nan":
            return TiltSample(now, math.nan, math.nan, math.nan, math.nan, True)
        jump = math.radians(60.0) if self.sensor == "jumps" else 0.0
        if self.sensor == "drops" or not valid:
            return TiltSample(now, math.nan, math.nan, math.nan, math.nan, False)
        self._last = TiltSample(now, float(y[2]) + jump, float(y[3]), float(y[4]), float(y[5]), True)
        return self._last

    @property
    def newest(self) -> TiltSample:
        """The last sample that was taken."""
        return self._newest

    def truth(self) -> Mapping[str, float]:
        """Return the neck's outputs at the last sample by name: true angles, tensions, compression."""
        names = (
            "pitch", "roll", "pitch_measured", "roll_measured", "pitch_rate_measured", "roll_rate_measured",
            "measurement_valid", "motor_position_1", "motor_position_2", "motor_position_3", "tension_1",
            "tension_2", "tension_3", "compression",
        )  # fmt: skip
        return dict(zip(names, (float(value) for value in self.outputs), strict=True))
