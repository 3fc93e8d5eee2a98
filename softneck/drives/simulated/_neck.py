"""Three simulated drives on the virtual neck, and its inclinometer: what hangs on the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import NamedTuple

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState
from softneck.runtime import load_functions

from ._drives import SimulatedDrives, SimulatedSettings, sensed
from ._frame import CanFrame
from ._servo_runtime import SERVO_STUCK

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

    @property
    def values(self) -> tuple[float, ...]:
        """Both angles [rad]."""
        return self.pitch, self.roll

    @property
    def rates(self) -> tuple[float, ...]:
        """Both rates [rad/s]."""
        return self.pitch_rate, self.roll_rate


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
        self._on_bus = SimulatedDrives(
            settings, current_limit=parameters.current_limit, latency=parameters.drive_latency
        )
        self.drives = self._on_bus.nodes
        self.motion: Matrix = self._on_bus.motion
        self._functions: ModuleType = load_functions("softneck.drives.simulated._servo_runtime")
        self._samples = 0
        self.sensor = "works"
        pitch, roll, pitch_rate, roll_rate = (float(value) for value in self.outputs[2:6])
        self._last = TiltSample(0.0, pitch, roll, pitch_rate, roll_rate, True)
        self._newest = self._last

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
        return self._on_bus.run(frames, now)

    def move(self) -> None:
        """Let one cycle of time pass for drives and neck."""
        bus = self._on_bus
        self._functions.servo_ticks(self._q, self._x, self.disturbance, bus.motion, bus.ring, bus.ticks, bus.h)

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
        values, rates = tuple(y[2:4].tolist()), tuple(y[4:6].tolist())
        (pitch, roll), (pitch_rate, roll_rate), valid = sensed(self.sensor, values, rates, valid=bool(valid))
        taken = TiltSample(now, pitch, roll, pitch_rate, roll_rate, valid)
        if not math.isnan(pitch):
            self._last = taken
        return taken

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
