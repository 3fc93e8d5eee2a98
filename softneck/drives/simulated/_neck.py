"""Simulated drives on the virtual neck, or on a robot built like it, and its inclinometer: what hangs on the bus."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import ModuleType

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._neck_runtime import VirtualNeckArrays, VirtualNeckState
from softneck.robot import Robot
from softneck.runtime import load_functions
from softneck.runtime._bundle import sized

from ._drives import Sample, SimulatedDrives, SimulatedSettings, sensed
from ._node import CanFrame
from ._servo_runtime import SERVO_GEARING, SERVO_STUCK


class SimulatedNeck:
    """The neck with its drives, stepped by whoever owns the time.

    Attributes:
        drives: the nodes on the bus.
        outputs: the neck's outputs at the inclinometer's last sample, in the order of its block; of a neck (14,).
        disturbance: payload [kg], pushes [N], tilt of the base [rad]; of a neck (5,).
        sensor: "works", "drops", "freezes", "nan", "jumps", or "silent" on a bus.
    """

    def __init__(self, parameters: NeckParameters, settings: SimulatedSettings, robot: Robot | None = None) -> None:
        """Put the neck, or `robot`, at rest; its drives are without power and, if `homed`, know their zero."""
        self.parameters, self.settings = parameters, settings
        robot = Robot.preset() if robot is None else robot
        neck = VirtualNeck(parameters, robot)
        block = neck.block(noise_seed=settings.seed, sample_time=settings.sample_time)
        motors, self._angles = len(robot.motors.names), len(robot.outputs.names)
        self._names = tuple(port.name for port in block.outputs)
        self._disturbances = tuple(port.name for port in block.inputs[motors:])
        start = block.initial_state()
        self._arrays, self._q, self._x = block.arrays, start.parameters, start.values.copy()
        self._free = VirtualNeckState.parts(VirtualNeckArrays(block.arrays))["free"]
        self.outputs: Vector = start.outputs.copy()
        self.disturbance: Vector = np.zeros(len(self._disturbances))
        self._on_bus = SimulatedDrives(
            settings, current_limit=parameters.current_limit, latency=parameters.drive_latency
        )
        self.drives = self._on_bus.nodes
        self.motion: Matrix = self._on_bus.motion
        # A drive with another gear than the neck's pulls with that one; what it has to accelerate stays the neck's.
        self.motion[:, SERVO_GEARING] = np.array(settings.gear) / parameters.gear_ratio
        self._functions: ModuleType = load_functions(
            sized("softneck.drives.simulated._servo_runtime", motors, self._angles)
        )
        self._samples = 0
        self.sensor = "works"
        self._last = self._newest = Sample(0.0, *self._measured(), valid=True)

    def set(self, **disturbance: float) -> None:
        """Set payload [kg], push_x, push_y [N], base_tilt_pitch or base_tilt_roll [rad], as far as the neck has them.

        Raises:
            SettingsError: another name.
        """
        for name, value in disturbance.items():
            if name not in self._disturbances:
                raise SettingsError(f"`{name}` is not a disturbance; the neck has {', '.join(self._disturbances)}.")
            self.disturbance[self._disturbances.index(name)] = value

    def tear(self, tendon: int) -> None:
        """Let a tendon, from 1 on, hang: it is a metre too long."""
        self._x[self._free][tendon - 1] += 1.0

    def block(self, motor: int) -> None:
        """Hold a winch, from 1 on, where it is, whatever its motor does."""
        self.motion[motor - 1, SERVO_STUCK] = 1.0

    def run(self, frames: Sequence[CanFrame], now: float) -> list[CanFrame]:
        """Deliver `frames` at `now`, and return what the drives send in answer."""
        return self._on_bus.exchange((*self.drives, *self._on_bus.twins), frames, now)

    def move(self) -> None:
        """Let one cycle of time pass for drives and neck."""
        bus = self._on_bus
        self._functions.servo_ticks(self._q, self._x, self.disturbance, bus.motion, bus.ring, bus.ticks, bus.h)

    def sample(self, now: float) -> Sample:
        """Take one sample of the inclinometer; to be called each `sample_time`."""
        self._newest = self._sampled(now)
        return self._newest

    def _measured(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return what the inclinometer gives, and its gyro: behind the true angles."""
        m = self._angles
        return tuple(self.outputs[m : 2 * m].tolist()), tuple(self.outputs[2 * m : 3 * m].tolist())

    def _sampled(self, now: float) -> Sample:
        if self._samples:
            self._functions.winch_sense(self._arrays, self._q, self._x, self.disturbance, self.outputs)
        self._samples += 1
        valid = bool(self.outputs[3 * self._angles] > 0.5)
        if self.sensor == "freezes":
            return self._last._replace(time=now)
        values, rates, valid = sensed(self.sensor, *self._measured(), valid=valid)
        taken = Sample(now, values, rates, valid=valid)
        if not math.isnan(values[0]):
            self._last = taken
        return taken

    @property
    def newest(self) -> Sample:
        """The last sample that was taken."""
        return self._newest

    def truth(self) -> Mapping[str, float]:
        """Return the neck's outputs at the last sample by name: true angles, tensions, compression."""
        return dict(zip(self._names, (float(value) for value in self.outputs), strict=True))
